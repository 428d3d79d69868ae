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
    seeds = (3, 3, 4)
    first, again, other = (kind.log(seed, samples=600) for seed in seeds)
    assert first.equals(again)
    assert not np.array_equal(first["y"], other["y"])
    assert np.isfinite(first.to_numpy()).all()
    differences = np.diff(first["time_s"])
    assert np.allclose(differences, kind.step_s)
    standard_deviation = first["y"].std()
    assert standard_deviation > 0


def first_lag_that_answers(table):
    """Lag from the input's change to the output's, by least squares on 40 lags of the input."""
    u = table["u"].to_numpy()
    change = np.diff(u)
    dy = np.diff(table["y"].to_numpy())
    lags = np.stack([np.roll(change, lag)[40:] for lag in range(40)], axis=1)
    least_squares = np.linalg.lstsq(lags, dy[40:], rcond=None)
    response = least_squares[0]
    largest = np.abs(response).max()
    lower_limit = 0.15 * largest
    indices = np.flatnonzero(np.abs(response) > lower_limit)
    return int(indices[0])


def test_delays_are_what_the_names_say():
    table = kind_named("same_sample").log(0)
    assert first_lag_that_answers(table) == 0
    table = kind_named("direction").log(0)
    assert first_lag_that_answers(table) == 1
    table = kind_named("dead_time").log(0)
    assert first_lag_that_answers(table) >= 6


def test_the_position_is_a_running_sum_that_stands_still_in_the_dead_zone():
    table = kind_named("position_dead_zone").log(1)
    largest = table["u"].abs().rolling(30).max()
    still = largest < 0.15
    differences = table["y"].diff()
    moves = differences.abs()
    expected = table["y"].round()
    assert (table["y"] == expected).all()
    largest = moves[still].max()
    assert largest <= 1.0 < moves.max()


def test_one_input_of_two_is_missing_and_the_sensor_ends():
    expected = ["time_s", "u", "y"]
    actual = list(kind_named("unmeasured").log(0))
    assert actual == expected
    y = kind_named("saturating").log(0)["y"]
    expected = y.max()
    mean = (y == expected).mean()
    assert mean > 0.03
