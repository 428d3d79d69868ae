"""A recording through the libraries that Foxglove opens files with; runs where node and these are
installed.

npm install --prefix /tmp/foxglove @mcap/core@2.2.2 @mcap/nodejs@1.0.2 @mcap/support@1.1.0
npm install --prefix /tmp/foxglove @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2   #
the application
NODE_PATH=/tmp/foxglove/node_modules pytest tests/oracles/test_data_foxglove.py
"""

import json
import os
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.signals import Channel

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "plants_foxglove.cjs"


STUDIO = SCRIPT.with_name("plants_foxglove_studio.py")


def node(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["node", *words], capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture(scope="module", autouse=True)
def foxglove() -> None:
    if (
        shutil.which("node") is None
        or node("-e", "require('@mcap/core'); require('@mcap/support')").returncode != 0
    ):
        pytest.skip("needs node and Foxglove's packages in NODE_PATH, see above")


def as_foxglove_reads(path: Path) -> Any:
    read = node(str(SCRIPT), str(path))
    assert read.returncode == 0, read.stderr
    return json.loads(read.stdout)


def test_foxglove_reads_what_was_written(tmp_path: Path) -> None:
    """Topics, protobuf schemas, units, metadata, log times of the sampling clock, and every double
    to its last bit."""
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((3000, 2))
    values = np.concatenate([[[0.0, -0.0], [np.inf, 5e-324]], white_noise])
    channels = (Channel(name="speed", unit="rad/s"), Channel(name="torque", unit="Nm"))
    time_s = np.arange(3002) * 0.01
    output = SignalGroup(topic="/output", time_s=time_s, channels=channels, values=values)
    time_s = np.arange(9) * 0.5
    signal_group_channels = channels[:1]
    signal_group_values = values[:9, :1]
    slow = SignalGroup(
        topic="/input", time_s=time_s, channels=signal_group_channels, values=signal_group_values
    )
    groups = (output, slow)
    metadata = {"plant": "DCMotor", "seed": "0"}
    write_mcap(tmp_path / "a.mcap", groups, metadata)
    seen = as_foxglove_reads(tmp_path / "a.mcap")
    expected = {"ssm-study": {"plant": "DCMotor", "seed": "0"}}
    assert seen["metadata"] == expected
    expected = {"/output", "/input"}
    assert set(seen["topics"]) == expected
    topic = seen["topics"]["/output"]
    assert topic["message_encoding"] == "protobuf"
    assert topic["schema_encoding"] == "protobuf"
    expected = {"unit.speed": "rad/s", "unit.torque": "Nm"}
    assert topic["metadata"] == expected
    assert (
        topic["log_times_ns"]
        == topic["publish_times_ns"]
        == [str(k * 10_000_000) for k in range(3002)]
    )
    digits = [[message[channel.name] for channel in channels] for message in topic["messages"]]
    expected = [[struct.pack(">d", value).hex() for value in row] for row in values]
    assert digits == expected
    expected = [str(k * 500_000_000) for k in range(9)]
    assert seen["topics"]["/input"]["log_times_ns"] == expected
    expected = ["3011", "0", "30010000000"]
    assert seen["statistics"] == expected
    assert seen["chunks"] > 1


def test_every_recording_of_a_run_opens(smoke_run: Path) -> None:
    paths = smoke_run.glob("*.mcap")
    for path in sorted(paths):
        seen = as_foxglove_reads(path)
        topics = seen["topics"].values()
        assert all(topic["messages"] for topic in topics), path.name
        assert seen["metadata"]["ssm-study"], path.name


def test_foxglove_refuses_a_flipped_bit(tmp_path: Path) -> None:
    """The check sums are there and are right: a damaged chunk does not pass for another number."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((100, 1))
    channel = Channel(name="speed", unit="rad/s")
    time_s = np.arange(100) * 0.01
    group = SignalGroup(topic="/output", time_s=time_s, channels=(channel,), values=values)
    write_mcap(tmp_path / "a.mcap", (group,), {})
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    content[len(content) // 3] ^= 1
    (tmp_path / "a.mcap").write_bytes(content)
    a_path = str(tmp_path / "a.mcap")
    returncode = node(str(SCRIPT), a_path).returncode
    assert returncode != 0


def test_the_application_shows_a_recording(smoke_run: Path) -> None:
    """Foxglove Studio itself: topics with schemas and counts, times, nothing failed, and the
    numbers of one sample."""
    places = os.environ["NODE_PATH"].split(os.pathsep)
    modules = [Path(place) for place in places]
    holding = [place for place in modules if (place / "@foxglove" / "studio-base").is_dir()]
    if not holding or shutil.which("chromedriver") is None:
        pytest.skip("needs Foxglove Studio in NODE_PATH and chromium with chromedriver")
    recording = smoke_run / "closed_loop.mcap"
    words = [
        sys.executable,
        str(STUDIO),
        str(recording),
        "--modules",
        str(holding[0]),
        "--beside",
        "/case_0.states",
    ]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    seen = json.loads(ran.stdout)
    assert seen["failures"] == []
    groups, _ = read_mcap(recording)
    for topic in {
        group.topic.rpartition("/")[0] for group in groups
    }:  # the groups of a case are fields of its topic
        assert re.search(rf"{topic}\nssm_study\.\w+\n{len(groups[0].values):,}\n", seen["text"]), (
            topic
        )
    states = next(group for group in groups if group.topic == "/case_0/states")
    assert f"END TIME\n{states.time_s[-1]:.9f}" in seen["text"]
    at = float(re.findall(r" @ ([0-9.]+) sec", seen["text"])[0])
    difference = np.abs(states.time_s - at)
    position_of_smallest = int(np.argmin(difference))
    row = states.values[position_of_smallest]
    tail = seen["text"][seen["text"].rindex(" sec") :]
    for channel, value in zip(states.channels, row, strict=True):
        assert float(re.findall(rf"{channel.name}\s+(\S+)", tail)[0]) == value, channel.name
