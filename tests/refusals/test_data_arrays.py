"""Arrays, series and frames that are no log, each refused in words of the array; frames by name."""

import warnings

import numpy as np
import pandas as pd
import pytest

import ssm_study as st
from ssm_study.data.arrays import check_time_index, signal_columns, write_log_files
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


REFUSED_ARRAYS = [
    (U, with_nan(1999), r"y\[1999\] is NaN; interpolate it"),
    (np.stack([U, with_nan(7)], axis=1), Y, r"u\[7, 1\] is NaN"),
    (np.ma.masked_greater(U, 2.0), Y, r"u\[\d+\] = masked"),
    (U + 1j, Y, "are complex; a signal is real"),
    (INDEX, Y, "holds times, not a signal"),
    (np.stack([U, Y]), Y, r"has more channels than samples; transpose it: u.T"),
    (pd.Series(U, name="u", index=INDEX), pd.Series(Y, name="y", index=INDEX[::-1]), "differ"),
    (pd.Series(U, name="u", index=INDEX), Y, "step_s = 0.1: the index of u shows 0.01 s"),
    (pd.Series(0.1 * np.arange(T), name="time"), Y, "time: is the clock: it increases"),
    (np.stack([U, U], axis=1), Y, r"u_2: holds the numbers of u_1"),
    (U, U, r"u, y \(column\) = y: holds the numbers of u"),
]


@pytest.mark.parametrize(("u", "y", "says"), REFUSED_ARRAYS)
def test_refused_in_words_of_the_array(tmp_path, u, y, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says):
        write_log_files(u, y, tmp_path, 0.1)


def test_their_good_twins_are_taken(tmp_path) -> None:  # type: ignore[no-untyped-def]
    by_time = pd.Series(U, name="power", index=INDEX)
    masked = np.ma.masked_array(U)
    for u in (U, U[:, None], masked, by_time, by_time.to_frame()):
        logged_arrays = write_log_files(u, Y, tmp_path, 0.01)
        paths = logged_arrays.paths
        table = pd.read_parquet(paths[0])
        assert np.array_equal(table.iloc[:, 0], U)


def test_frames_are_matched_by_the_names_of_their_columns() -> None:
    frame = pd.DataFrame({"b": Y, "a (V)": U})
    columns = ["a_V", "b"]
    table = signal_columns(frame, "u", 2, columns)[1]
    signals = np.stack([U, Y], axis=1)
    assert np.array_equal(table, signals)
    columns = ["a", "b"]
    swapped = pd.DataFrame(np.stack([Y, U], axis=1))
    by_place = signal_columns(swapped, "u", 2, columns)[1]
    signals_swapped = np.stack([Y, U], axis=1)
    assert np.array_equal(by_place, signals_swapped)
    columns = ["a", "b"]
    renamed = frame.set_axis(["b", "c"], axis=1)
    with pytest.raises(BadRequest, match=r"u \(columns\) = b, c: the model's channels are a, b"):
        signal_columns(renamed, "u", 2, columns)


REFUSED_INDICES = [
    (INDEX.delete(300).append(INDEX[-1:] + pd.Timedelta("10ms")), "row 299: the times have a h"),
    (INDEX.to_series().sample(frac=1, random_state=0).index, r"sort it: u.sort_index\(\)"),
    (INDEX[:1000].append(INDEX[1000:] + pd.Timedelta("8ms")), "row 999: the times have a hole"),
    (np.arange(T) * 0.010011, "the index of u shows 0.010011 s"),
]


@pytest.mark.parametrize(("index", "says"), REFUSED_INDICES)
def test_an_index_that_is_no_even_clock_of_the_sampling_time(tmp_path, index, says: str) -> None:  # type: ignore[no-untyped-def]
    u = pd.Series(U, index=index, name="u")
    y = pd.Series(Y, index=index, name="y")
    with pytest.raises(BadRequest, match=says):
        write_log_files(u, y, tmp_path, 0.01)


def test_an_index_that_agrees_or_counts_rows_is_taken() -> None:
    zoned = pd.date_range("2026-03-01", periods=T, freq="10ms", tz="Europe/Paris")
    nearly_the_step = np.arange(T) * 0.010009
    words = list("abcd") * (T // 4)
    for index in (INDEX, zoned, nearly_the_step, np.arange(T), words):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            u = pd.Series(U, index=index)
            y = pd.Series(Y, index=index)
            check_time_index(u, y, 0.01)


def two_inputs() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two inputs of unlike effect on two outputs."""
    levels = RNG.uniform(-1, 1, (60, 2))
    u = np.repeat(levels, 10, axis=0)
    y = np.zeros((601, 2))
    for k in range(600):
        gains = np.array([[0.1, -0.2], [0.3, 0.05]])
        y[k + 1] = 0.9 * y[k] + u[k] @ gains
    index = pd.timedelta_range("0s", periods=600, freq="100ms")
    table = pd.DataFrame(u, index, ["a", "b"])
    return table, pd.DataFrame(y[:600], index, ["c", "d"])


def test_predict_score_simulate_and_compare_take_frames_by_name_and_at_their_times() -> None:
    u, y = two_inputs()
    model = st.fit(u, y, 0.1, model="linear", order=2, progress=False)
    swapped_u = u[["b", "a"]]
    swapped_y = y[["d", "c"]]
    swapped_score = model.score(swapped_u, swapped_y)
    assert swapped_score == model.score(u, y) > 95
    assert model.predict(swapped_u).equals(model.predict(u))
    response = st.simulate(model, swapped_u)
    assert response.equals(st.simulate(model, u))
    model_comparison = st.compare([model], swapped_u, swapped_y)
    ours = model_comparison.table
    model_comparison = st.compare([model], u, y)
    assert ours.equals(model_comparison.table)
    seconds = pd.timedelta_range("0s", periods=600, freq="1s")
    slower = u.set_axis(seconds)
    for call in (model.predict, lambda frame: st.simulate(model, frame)):
        with pytest.raises(BadRequest, match="the index of u shows 1 s"):
            call(slower)
    with pytest.raises(BadRequest, match="their indexes differ"):
        model.score(u, y.shift(freq="100ms"))
    columns = {"d": "e"}
    with pytest.raises(BadRequest, match="the model's channels are c, d"):
        model.score(u, y.rename(columns=columns))
