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

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "benchmarks" / "plants_foxglove.cjs"
STUDIO = SCRIPT.with_name("plants_foxglove_studio.py")
PACKAGES = "require('@mcap/core'); require('@mcap/support')"


def node(*words: str) -> subprocess.CompletedProcess[str]:
    command = ["node", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture(scope="module", autouse=True)
def foxglove() -> None:
    if shutil.which("node") is None or node("-e", PACKAGES).returncode != 0:
        pytest.skip("needs node and Foxglove's packages in NODE_PATH, see above")


def as_foxglove_reads(path: Path) -> Any:
    read = node(str(SCRIPT), str(path))
    assert read.returncode == 0, read.stderr
    return json.loads(read.stdout)


def encode_double(value: float) -> str:
    """The bits of a double, in hexadecimal digits."""
    return struct.pack(">d", value).hex()


def test_foxglove_reads_what_was_written(tmp_path: Path) -> None:
    """Topics, protobuf schemas, units, metadata, log times of the sampling clock, and every double
    to its last bit."""
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((3000, 2))
    extremes = [[0.0, -0.0], [np.inf, 5e-324]]
    values = np.concatenate([extremes, white_noise])
    speed = Channel(name="speed", unit="rad/s")
    torque = Channel(name="torque", unit="Nm")
    channels = (speed, torque)
    time_s = np.arange(3002) * 0.01
    output = SignalGroup(topic="/output", time_s=time_s, channels=channels, values=values)
    time_s = np.arange(9) * 0.5
    first_values = values[:9, :1]
    slow = SignalGroup(topic="/input", time_s=time_s, channels=(speed,), values=first_values)
    groups = (output, slow)
    metadata = {"plant": "DCMotor", "seed": "0"}
    path = tmp_path / "a.mcap"
    write_mcap(path, groups, metadata)
    seen = as_foxglove_reads(path)
    assert seen["metadata"] == {"ssm-study": metadata}
    expected = {"/output", "/input"}
    assert set(seen["topics"]) == expected
    topic = seen["topics"]["/output"]
    assert topic["message_encoding"] == "protobuf"
    assert topic["schema_encoding"] == "protobuf"
    expected = {"unit.speed": "rad/s", "unit.torque": "Nm"}
    assert topic["metadata"] == expected
    expected = [str(k * 10_000_000) for k in range(3002)]
    assert topic["log_times_ns"] == expected
    assert topic["publish_times_ns"] == expected
    digits = [[message["speed"], message["torque"]] for message in topic["messages"]]
    expected = []
    for of_speed, of_torque in values:
        row = [encode_double(of_speed), encode_double(of_torque)]
        expected.append(row)
    assert digits == expected
    expected = [str(k * 500_000_000) for k in range(9)]
    slow_topic = seen["topics"]["/input"]
    assert slow_topic["log_times_ns"] == expected
    expected = ["3011", "0", "30010000000"]
    assert seen["statistics"] == expected
    assert seen["chunks"] > 1


def test_every_recording_of_a_run_opens(smoke_run: Path) -> None:
    paths = smoke_run.glob("*.mcap")
    for path in sorted(paths):
        seen = as_foxglove_reads(path)
        topics = seen["topics"].values()
        messages = [topic["messages"] for topic in topics]
        assert all(messages), path.name
        assert seen["metadata"]["ssm-study"], path.name


def test_foxglove_refuses_a_flipped_bit(tmp_path: Path) -> None:
    """The check sums are there and are right: a damaged chunk does not pass for another number."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((100, 1))
    channel = Channel(name="speed", unit="rad/s")
    time_s = np.arange(100) * 0.01
    signals = {"channels": (channel,), "values": values}
    group = SignalGroup(topic="/output", time_s=time_s, **signals)
    path = tmp_path / "a.mcap"
    write_mcap(path, (group,), {})
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    returncode = node(str(SCRIPT), str(path)).returncode
    assert returncode != 0


def find_studio() -> Path | None:
    """The folder of modules that holds the application, if there is one."""
    places = os.environ["NODE_PATH"].split(os.pathsep)
    modules = [Path(place) for place in places]
    holding = [place for place in modules if (place / "@foxglove" / "studio-base").is_dir()]
    return holding[0] if holding else None


def test_the_application_shows_a_recording(smoke_run: Path) -> None:
    """Foxglove Studio itself: topics with schemas and counts, times, nothing failed, and the
    numbers of one sample."""
    modules = find_studio()
    if modules is None or shutil.which("chromedriver") is None:
        pytest.skip("needs Foxglove Studio in NODE_PATH and chromium with chromedriver")
    recording = smoke_run / "closed_loop.mcap"
    command = [sys.executable, str(STUDIO), str(recording)]
    command += ["--modules", str(modules), "--beside", "/case_0.states"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    seen = json.loads(ran.stdout)
    assert seen["failures"] == []
    text = seen["text"]
    groups, _ = read_mcap(recording)
    count = len(groups[0].values)
    # The groups of a case are fields of its topic.
    topics = {group.topic.rpartition("/")[0] for group in groups}
    for topic in topics:
        row = rf"{topic}\nssm_study\.\w+\n{count:,}\n"
        assert re.search(row, text), topic
    states = next(group for group in groups if group.topic == "/case_0/states")
    assert f"END TIME\n{states.time_s[-1]:.9f}" in text
    shown_times = re.findall(r" @ ([0-9.]+) sec", text)
    difference = np.abs(states.time_s - float(shown_times[0]))
    position_of_smallest = int(np.argmin(difference))
    sample = states.values[position_of_smallest]
    start = text.rindex(" sec")
    tail = text[start:]
    for channel, value in zip(states.channels, sample, strict=True):
        shown_values = re.findall(rf"{channel.name}\s+(\S+)", tail)
        assert float(shown_values[0]) == value, channel.name
