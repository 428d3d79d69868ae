"""Arrays, series and frames that are no log, each refused in words of the array; frames by name."""

import warnings

import numpy as np
import pandas as pd
import pytest

import ssm_study as st
from ssm_study.data.arrays import (
    require_consistent_time_indexes,
    signal_array_and_names,
    write_log_files,
)
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
BACKWARDS = INDEX[::-1]
GAP_AT_THE_END = with_nan(1999)
GAP_IN_ONE_INPUT = np.stack([U, with_nan(7)], axis=1)
MASKED = np.ma.masked_greater(U, 2.0)
COMPLEX = U + 1j
ROWS_FOR_COLUMNS = np.stack([U, Y])
TWICE = np.stack([U, U], axis=1)
U_BY_TIME = pd.Series(U, name="u", index=INDEX)
Y_BACKWARDS = pd.Series(Y, name="y", index=BACKWARDS)
CLOCK = pd.Series(0.1 * np.arange(T), name="time")

REFUSED_VALUES = [
    (U, GAP_AT_THE_END, r"y\[1999\] is NaN; interpolate it"),
    (GAP_IN_ONE_INPUT, Y, r"u\[7, 1\] is NaN"),
    (MASKED, Y, r"u\[\d+\] = masked"),
    (COMPLEX, Y, "are complex; a signal is real"),
]
REFUSED_TIMES = [
    (INDEX, Y, "holds times, not a signal"),
    (U_BY_TIME, Y_BACKWARDS, "differ"),
    (U_BY_TIME, Y, "step_s = 0.1: the index of u shows 0.01 s"),
    (CLOCK, Y, "time: is the clock: it increases"),
]
REFUSED_COLUMNS = [
    (ROWS_FOR_COLUMNS, Y, r"has more channels than samples; transpose it: u.T"),
    (TWICE, Y, r"u_2: holds the numbers of u_1"),
    (U, U, r"u, y \(column\) = y: holds the numbers of u"),
]
REFUSED_ARRAYS = [*REFUSED_VALUES, *REFUSED_TIMES, *REFUSED_COLUMNS]


@pytest.mark.parametrize(("u", "y", "says"), REFUSED_ARRAYS)
def test_refused_in_words_of_the_array(tmp_path, u, y, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says):
        write_log_files(u, y, tmp_path, 0.1)


def test_their_good_twins_are_taken(tmp_path) -> None:  # type: ignore[no-untyped-def]
    by_time = pd.Series(U, name="power", index=INDEX)
    masked = np.ma.masked_array(U)
    column = U[:, None]
    frame = by_time.to_frame()
    for u in (U, column, masked, by_time, frame):
        logged_arrays = write_log_files(u, Y, tmp_path, 0.01)
        paths = logged_arrays.paths
        table = pd.read_parquet(paths[0])
        stored = table.iloc[:, 0]
        assert np.array_equal(stored, U)


def test_frames_are_matched_by_the_names_of_their_columns() -> None:
    frame = pd.DataFrame({"b": Y, "a (V)": U})
    columns = ["a_V", "b"]
    _, by_name = signal_array_and_names(frame, "u", 2, columns)
    signals = np.stack([U, Y], axis=1)
    assert np.array_equal(by_name, signals)
    columns = ["a", "b"]
    swapped_signals = np.stack([Y, U], axis=1)
    swapped = pd.DataFrame(swapped_signals)
    _, by_place = signal_array_and_names(swapped, "u", 2, columns)
    assert np.array_equal(by_place, swapped_signals)
    columns = ["a", "b"]
    renamed = frame.set_axis(["b", "c"], axis=1)
    words = r"u \(columns\) = b, c: the model's channels are a, b"
    with pytest.raises(BadRequest, match=words):
        signal_array_and_names(renamed, "u", 2, columns)


LAST = INDEX[-1:] + pd.Timedelta("10ms")
MISSING_ROW = INDEX.delete(300).append(LAST)
SHUFFLED = INDEX.to_series().sample(frac=1, random_state=0)
LATER_HALF = INDEX[1000:] + pd.Timedelta("8ms")
JUMP = INDEX[:1000].append(LATER_HALF)
SLOW_CLOCK = np.arange(T) * 0.010011
REFUSED_INDICES = [
    (MISSING_ROW, "row 299: the times have a h"),
    (SHUFFLED.index, r"sort it: u.sort_index\(\)"),
    (JUMP, "row 999: the times have a hole"),
    (SLOW_CLOCK, "the index of u shows 0.010011 s"),
]


@pytest.mark.parametrize(("index", "says"), REFUSED_INDICES)
def test_an_index_that_is_no_even_clock_of_the_sampling_time(tmp_path, index, says: str) -> None:  # type: ignore[no-untyped-def]
    u = pd.Series(U, index=index, name="u")
    y = pd.Series(Y, index=index, name="y")
    with pytest.raises(BadRequest, match=says):
        write_log_files(u, y, tmp_path, 0.01)


def test_an_index_that_agrees_or_counts_rows_is_taken() -> None:
    frequency = {"periods": T, "freq": "10ms"}
    zoned = pd.date_range("2026-03-01", tz="Europe/Paris", **frequency)
    counts = np.arange(T)
    nearly_the_step = counts * 0.010009
    words = list("abcd") * (T // 4)
    for index in (INDEX, zoned, nearly_the_step, counts, words):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            u = pd.Series(U, index=index)
            y = pd.Series(Y, index=index)
            require_consistent_time_indexes(u, y, 0.01)


def two_inputs() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two inputs of unlike effect on two outputs."""
    levels = RNG.uniform(-1, 1, (60, 2))
    u = np.repeat(levels, 10, axis=0)
    y = np.zeros((601, 2))
    gains = np.array([[0.1, -0.2], [0.3, 0.05]])
    for k in range(600):
        driven = u[k] @ gains
        y[k + 1] = 0.9 * y[k] + driven
    index = pd.timedelta_range("0s", periods=600, freq="100ms")
    inputs = pd.DataFrame(u, index, ["a", "b"])
    outputs = pd.DataFrame(y[:600], index, ["c", "d"])
    return inputs, outputs


def test_predict_score_simulate_and_compare_take_frames_by_name_and_at_their_times() -> None:
    u, y = two_inputs()
    linear = {"model": "linear", "order": 2}
    model = st.fit(u, y, 0.1, progress=False, **linear)
    swapped_u = u[["b", "a"]]
    swapped_y = y[["d", "c"]]
    swapped_score = model.score(swapped_u, swapped_y)
    score = model.score(u, y)
    assert swapped_score == score
    assert score > 95
    prediction = model.predict(u)
    assert model.predict(swapped_u).equals(prediction)
    response = st.simulate(model, swapped_u)
    assert response.equals(st.simulate(model, u))
    swapped_comparison = st.compare([model], swapped_u, swapped_y)
    comparison = st.compare([model], u, y)
    assert swapped_comparison.table.equals(comparison.table)
    seconds = pd.timedelta_range("0s", periods=600, freq="1s")
    slower = u.set_axis(seconds)
    words = "the index of u shows 1 s"
    with pytest.raises(BadRequest, match=words):
        model.predict(slower)
    with pytest.raises(BadRequest, match=words):
        st.simulate(model, slower)
    with pytest.raises(BadRequest, match="their indexes differ"):
        model.score(u, y.shift(freq="100ms"))
    columns = {"d": "e"}
    with pytest.raises(BadRequest, match="the model's channels are c, d"):
        model.score(u, y.rename(columns=columns))
