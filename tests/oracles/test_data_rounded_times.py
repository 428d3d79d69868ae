"""Clocks written with few digits: the even clock behind them, against clocks that are known."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ssm_study.data.calendar_numbers import parse_calendar_numbers
from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.data.rounded_times import estimate_period_s, period_bounds_s, resolution_of_times
from ssm_study.data.scattered_times import find_scattered_clock
from ssm_study.refusal import BadRequest


def in_digits(times: np.ndarray, digits: int) -> np.ndarray:
    """The times as a program prints them with so many significant digits."""
    return np.array([float(f"{time:.{digits}g}") for time in times])


@settings(max_examples=60, deadline=None)
@example(period_s=4.0, start_s=5e-324, digits=3, samples=300)
@given(
    period_s=st.floats(1e-3, 10.0),
    start_s=st.floats(0.0, 1.0),
    digits=st.integers(3, 5),
    samples=st.integers(300, 3000),
)
def test_the_period_is_found_or_none(
    period_s: float, start_s: float, digits: int, samples: int
) -> None:
    """The true period lies among the possible ones, and the one taken is within what is stated."""
    times = in_digits(start_s * period_s + period_s * np.arange(samples), digits)
    error_s = 0.6 * resolution_of_times(times)
    possible_s = period_bounds_s(times, error_s)
    assert possible_s is not None
    upper_limit = period_s * (1 + 1e-9)
    assert possible_s[0] <= upper_limit
    lower_limit = period_s * (1 - 1e-9)
    assert possible_s[1] >= lower_limit
    found = estimate_period_s(times)
    if found is not None:
        assert found[0] == pytest.approx(period_s, rel=2e-3)


def test_a_round_period_is_found_exactly() -> None:
    times = in_digits(0.135 * np.arange(3000), 3)
    found = estimate_period_s(times)
    assert found is not None
    assert found[0] == 0.135
    assert found[1] < 1e-3


def test_times_that_no_even_clock_explains() -> None:
    """A row that is missing, a clock that changes its period, and a time that stands twice."""
    even = 0.135 * np.arange(2000)
    times = np.delete(even, 700)
    time_s = in_digits(times, 3)
    assert estimate_period_s(time_s) is None
    times = np.where(even > 20, 1.2 * even - 4, even)
    time_s = in_digits(times, 3)
    assert estimate_period_s(time_s) is None
    twice = np.sort(np.append(0.01 * np.arange(1000), 3.0))
    assert estimate_period_s(twice) is None


def test_too_few_digits_leave_the_period_open(tmp_path: Path) -> None:
    """Sixty rows in whole seconds: periods of one per cent more or less explain them as well."""
    rows = [f"{int(0.3 * k)},{k % 7},{k % 5}" for k in range(60)]
    path = tmp_path / "log.csv"
    text = "\n".join(["t,u,y", *rows])
    path.write_text(text)
    recorded_data = RecordedData(path=str(path), input="u", output="y")
    with pytest.raises(BadRequest, match=r"times were rounded; use data.step_s"):
        recorded_data.read_pieces(path)


def test_a_file_without_names_that_counts_its_rows(tmp_path: Path) -> None:
    """A row is taken to last one second, said so; a table with names (an index) is refused."""
    rows = [f"{k},{(7 * k) % 13},{(5 * k) % 11}" for k in range(80)]
    path = tmp_path / "log.csv"
    text = "\n".join(rows)
    path.write_text(text)
    recorded_data = RecordedData(path=str(path), input=1, output=2)
    pieces, remark = recorded_data.read_pieces(path)
    assert pieces[0].step_s == 1.0
    assert "column 0 counts the rows, and a row is taken to last one second" in remark
    recorded_data = RecordedData(path=str(path), input=1, output=2, step_s=0.1)
    stated, _ = recorded_data.read_pieces(path)
    assert stated[0].step_s == 0.1
    text = "\n".join([",u,y", *rows])
    path.write_text(text)
    recorded_data = RecordedData(path=str(path), input="u", output="y")
    with pytest.raises(BadRequest, match="the first column counts the rows"):
        recorded_data.read_pieces(path)


def test_a_column_that_stands_twice_and_a_separator_at_the_end(tmp_path: Path) -> None:
    """Equal columns of one name are one; unequal ones are ambiguous; nothing stands behind a last
    separator; a trace of keys and values is no table."""
    path = tmp_path / "log.csv"
    rows = [f"{0.1 * k:.1f},{k % 7},{k % 5},{k % 5}," for k in range(80)]
    text = "\n".join(["t,u,y,y,", *rows])
    path.write_text(text)
    source = RecordedData(path=str(path), input="u", output="y")
    pieces = source.read_pieces(path)
    assert len(pieces[0][0]) == 80
    columns = look(path).columns
    names = [column.name for column in columns]
    assert names == ["t", "u", "y"]
    text = "\n".join(["t,u,y,y,", *rows[:-1], "7.9,2,4,3,"])
    path.write_text(text)
    with pytest.raises(BadRequest, match="the header has it 2 times"):
        source.read_pieces(path)
    path.write_text("[key]; [value]\nName; trace\n" + "\n".join(f"; {k}; 25" for k in range(60)))
    with pytest.raises(BadRequest, match="its variables one below the other"):
        look(path)


def test_a_space_between_date_and_time_is_no_separator(tmp_path: Path) -> None:
    """At whole minutes and with whole numbers the rows would be tables of four columns, too."""
    for mark in "\t;|,":
        rows = [
            f"2026-01-01 {k // 60:02}:{k % 60:02}:00{mark}{k % 7}{mark}{k % 5}" for k in range(90)
        ]
        path = tmp_path / "log.txt"
        text = "\n".join([f"time{mark}u{mark}y", *rows])
        path.write_text(text)
        recorded_data = RecordedData(path=str(path), input="u", output="y")
        pieces, _ = recorded_data.read_pieces(path)
        assert pieces[0].step_s == 60.0
        assert len(pieces[0]) == 90


@pytest.mark.parametrize("unit_s", [1e-3, 1.0, 1e3])
def test_scatter_is_told_from_wander_in_every_unit(unit_s: float) -> None:
    rng = np.random.default_rng(0)
    white = rng.standard_normal(400)
    scatter = 0.05 * white
    rows = np.arange(400.0)
    scattered = rows + scatter
    whole_log = [(0, 400)]
    clock = find_scattered_clock(unit_s * scattered, whole_log)
    assert clock is not None
    assert clock.period_s == pytest.approx(unit_s)
    running_mean = np.full(5, 0.2)
    wander = np.convolve(scatter, running_mean, "same")
    wandering = rows + wander
    assert find_scattered_clock(unit_s * wandering, whole_log) is None


@pytest.mark.parametrize("unit_s", [1e-3, 1e-6, 1e-9])
def test_numbers_since_1970_are_read_in_their_unit(unit_s: float) -> None:
    seconds = np.arange(5.0)
    numbers = (1.7e9 + seconds) / unit_s
    found = parse_calendar_numbers("clock", numbers)
    assert found is not None
    np.testing.assert_allclose(found[0], seconds, atol=1e-6)
