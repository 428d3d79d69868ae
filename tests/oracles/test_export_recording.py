"""One recording of a study says what its runs' recordings say."""

from pathlib import Path

import numpy as np
import pytest

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel
from ssm_study.table import one_recording

RUNS = {"order4-seed0-0a1b2c3d4e": 30, "order4-seed1-9f8e7d6c5b": 40}  # name: samples


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Two runs with two cases each, one run that failed, and a folder that is no run."""
    runs = RUNS.items()
    for seed, (name, samples) in enumerate(runs):
        rng = np.random.default_rng(seed)
        values = rng.standard_normal((2, 2, samples, 1))
        time_s = 0.01 * np.arange(samples)
        groups = [
            SignalGroup(
                topic=f"/case_{k}/{what}",
                time_s=time_s,
                channels=(Channel(name=what, unit="V"),),
                values=one,
            )
            for k in range(2)
            for what, one in zip(("input", "output"), values[k], strict=True)
        ]
        (tmp_path / name).mkdir()
        record = {"run": name, "status": "ok"}
        write_record(tmp_path / name, record)
        path = tmp_path / name / one_recording.LOOP
        write_mcap(path, tuple(groups), {})
    (tmp_path / "failed").mkdir()
    record = {"run": "failed", "status": "failed"}
    write_record(tmp_path / "failed", record)
    (tmp_path / "figures").mkdir()
    return tmp_path


def test_every_signal_of_every_run_is_read_back_under_its_run(study: Path) -> None:
    path = one_recording.export_closed_loop_recordings(study)
    groups, about = read_mcap(path)
    expected = {f"run_{name[-10:]}": name for name in RUNS}
    assert about == expected
    found = {group.topic: group for group in groups}
    for name in RUNS:
        path = study / name / one_recording.LOOP
        mcap = read_mcap(path)
        for own in mcap[0]:
            copied = found.pop(f"/run_{name[-10:]}{own.topic}")
            assert (copied.values == own.values).all()
            assert (copied.time_s == own.time_s).all()
            assert copied.channels == own.channels
    assert not found


def test_runs_whose_names_end_alike_are_all_there(study: Path) -> None:
    for name, short in zip(RUNS, ("a-1", "b-1"), strict=True):
        (study / name).rename(study / short)
    path = one_recording.export_closed_loop_recordings(study)
    groups, about = read_mcap(path)
    expected = {"run_a-1": "a-1", "run_b-1": "b-1"}
    assert about == expected
    topics = {group.topic for group in groups}
    assert len(topics) == len(groups) == 8


def test_refusals(
    study: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadRequest, match="no run closed a loop"):
        one_recording.export_closed_loop_recordings(tmp_path_factory.mktemp("empty"))
    monkeypatch.setattr(one_recording, "MOST", 1)
    with pytest.raises(BadRequest, match="2 runs are more than 1"):
        one_recording.export_closed_loop_recordings(study)
    recording = next(study.glob(f"*/{one_recording.LOOP}"))
    recording.write_bytes(recording.read_bytes()[:200])
    monkeypatch.setattr(one_recording, "MOST", 2)
    with pytest.raises(BadRequest, match="not a complete MCAP recording"):
        one_recording.export_closed_loop_recordings(study)
