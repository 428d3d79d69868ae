"""The generators of `benchmarks/log_kinds.py`: equal seeds give equal logs, and each kind has the
property it is named for."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import KINDS, kind_named


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_equal_seeds_give_equal_logs(kind):
    first, again, other = (kind.log(seed, samples=600) for seed in (3, 3, 4))
    assert first.equals(again)
    assert not np.array_equal(first["y"], other["y"])
    assert np.isfinite(first.to_numpy()).all()
    assert np.allclose(np.diff(first["time_s"]), kind.step_s)
    assert first["y"].std() > 0


def first_lag_that_answers(table):
    """Lag from the input's change to the output's, by least squares on 40 lags of the input."""
    u = table["u"].to_numpy()
    change = np.diff(u)
    dy = np.diff(table["y"].to_numpy())
    lags = np.stack([np.roll(change, lag)[40:] for lag in range(40)], axis=1)
    response = np.linalg.lstsq(lags, dy[40:], rcond=None)[0]
    return int(np.flatnonzero(np.abs(response) > 0.15 * np.abs(response).max())[0])


def test_delays_are_what_the_names_say():
    assert first_lag_that_answers(kind_named("same_sample").log(0)) == 0
    assert first_lag_that_answers(kind_named("direction").log(0)) == 1
    assert first_lag_that_answers(kind_named("dead_time").log(0)) >= 6


def test_the_position_is_a_running_sum_that_stands_still_in_the_dead_zone():
    table = kind_named("position_dead_zone").log(1)
    still = table["u"].abs().rolling(30).max() < 0.15
    moves = table["y"].diff().abs()
    assert (table["y"] == table["y"].round()).all()
    assert moves[still].max() <= 1.0 < moves.max()


def test_one_input_of_two_is_missing_and_the_sensor_ends():
    assert list(kind_named("unmeasured").log(0)) == ["time_s", "u", "y"]
    y = kind_named("saturating").log(0)["y"]
    assert (y == y.max()).mean() > 0.03
