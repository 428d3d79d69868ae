"""Outputs that integrate their input are told from outputs that settle."""

import sys
from pathlib import Path

import pytest

from ssm_study.data.recorded import RecordedData
from ssm_study.evidence import feedback
from ssm_study.signals import DataSet

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import kind_named


@pytest.mark.parametrize("seed", range(6))
def test_a_position_behind_a_dead_zone_integrates_whatever_the_seed(tmp_path: Path, seed: int):
    """An operator turns the motor round at its ends, so that a mode alone does not show the sum."""
    data_set = kind_of_log(tmp_path, "position_dead_zone", seed)
    sums = list(feedback.judge_instability(data_set, is_closed_loop=False))
    assert [finding.level for finding in sums] == ["doubt"]
    assert "integrates its input" in sums[0].sentence
    assert "model.integrating_output=true" in sums[0].sentence


NAMES_OF_LOGS = ["slow_coarse", "bilinear", "dead_time", "saturating", "drifting"]


@pytest.mark.parametrize("name", NAMES_OF_LOGS)
def test_what_settles_does_not_integrate(tmp_path: Path, name: str):
    data_set = kind_of_log(tmp_path, name, 0)
    doubts = list(feedback.judge_instability(data_set, is_closed_loop=False))
    assert not doubts


def kind_of_log(folder: Path, name: str, seed: int) -> DataSet:
    """A log of `benchmarks/log_kinds.py`, read as a run reads it."""
    path = folder / "log.csv"
    kind_named(name).log(seed).to_csv(path, index=False)
    recorded_data = RecordedData(path=str(path), input="u", output="y", start_up_samples=20)
    return recorded_data.build(0)
