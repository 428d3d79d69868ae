"""Arrays, series and frames that are no log, each refused in words of the array; frames by name."""

import numpy as np
import pandas as pd
import pytest

from ssm_study.data.arrays import logged, signal
from ssm_study.refusal import BadRequest

T = 2000
RNG = np.random.default_rng(0)
U = RNG.standard_normal(T)
Y = RNG.standard_normal(T)


def with_nan(at: int) -> np.ndarray:
    y = Y.copy()
    y[at] = np.nan
    return y


INDEX = pd.date_range("2026-01-01", periods=T, freq="10ms")


@pytest.mark.parametrize(
    ("u", "y", "says"),
    [
        (U, with_nan(1999), r"y\[1999\] is NaN; interpolate it"),
        (np.stack([U, with_nan(7)], axis=1), Y, r"u\[7, 1\] is NaN"),
        (np.ma.masked_greater(U, 2.0), Y, r"u\[\d+\] = masked"),
        (U + 1j, Y, "are complex; a signal is real"),
        (INDEX, Y, "holds times, not a signal"),
        (np.stack([U, Y]), Y, r"has more channels than samples; transpose it: u.T"),
        (pd.Series(U, name="u", index=INDEX), pd.Series(Y, name="y", index=INDEX[::-1]), "differ"),
        (pd.Series(U, name="u", index=INDEX), Y, "step_s = 0.1: the index shows 0.01 s"),
    ],
)
def test_refused_in_words_of_the_array(tmp_path, u, y, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says):
        logged(u, y, tmp_path, 0.1)


def test_their_good_twins_are_taken(tmp_path) -> None:  # type: ignore[no-untyped-def]
    by_time = pd.Series(U, name="power", index=INDEX)
    for u in (U, U[:, None], np.ma.masked_array(U), by_time, by_time.to_frame()):
        paths, _, _ = logged(u, Y, tmp_path, 0.01)
        assert np.array_equal(pd.read_parquet(paths[0]).iloc[:, 0], U)


def test_frames_are_matched_by_the_names_of_their_columns() -> None:
    frame = pd.DataFrame({"b": Y, "a (V)": U})
    table = signal(frame, "u", 2, ["a_V", "b"])[1]
    assert np.array_equal(table, np.stack([U, Y], axis=1))
    by_place = signal(pd.DataFrame(np.stack([Y, U], axis=1)), "u", 2, ["a", "b"])[1]
    assert np.array_equal(by_place, np.stack([Y, U], axis=1))
    with pytest.raises(BadRequest, match=r"u \(columns\) = b, c: the model's channels are a, b"):
        signal(frame.set_axis(["b", "c"], axis=1), "u", 2, ["a", "b"])
