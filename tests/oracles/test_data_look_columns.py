"""Which columns of a log `look` takes for input, output and clock, and what it says of others."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.signal

from ssm_study.data.log_checks import ANGLE, angle_remarks
from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.metrics import judge_log_reading
from ssm_study.report.figure_of_a_log import draw_log


def held_levels_log() -> pd.DataFrame:
    """Log of a first-order plant under held levels, sampled every 5 ms."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 10), 40)
    y = scipy.signal.lfilter([0.0, 0.2], [1, -0.8], u)
    return pd.DataFrame({"time (ms)": 5.0 * np.arange(400), "u": u, "y": y})


def test_the_picture_of_a_log_has_the_units_of_its_titles(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    held_levels_log().rename(columns={"y": "y [rad/s]", "u": "u (V)"}).to_csv(path, index=False)
    labels = [axes.get_ylabel() for axes in draw_log(look(path, input="u", output="y")).axes]
    assert labels == ["y (rad/s)", "u (V)"]


def test_an_angle_that_starts_again_is_doubted_where_the_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    table = held_levels_log()
    angle = np.cumsum(5.0 * table["y"] + 8.0) % 360.0
    table.assign(y=angle).to_csv(path, index=False)
    turned = RecordedData(path=str(path), input="u", output="y").build(0).metadata["reading"]
    assert turned.endswith("; the output y jumps by a turn of 360 in 9 places, " + ANGLE)
    (doubt,) = judge_log_reading(turned)
    assert doubt.level == "doubt"
    assert doubt.sentence.startswith("The output y jumps by a turn of 360 in 9 places")
    assert doubt.sentence.endswith("add the turns up, or take its rate for the output.")
    table.to_csv(path, index=False)
    straight = RecordedData(path=str(path), input="u", output="y").build(0).metadata["reading"]
    assert "turn" not in straight


@pytest.mark.parametrize("turn", [360.0, 2 * np.pi])
@pytest.mark.parametrize("start", [0.0, -0.5])
def test_an_angle_may_start_at_zero_or_half_a_turn_below(turn: float, start: float) -> None:
    turns = 0.03 * np.arange(400.0)
    share = turns % 1.0
    angle = turn * (share + start)
    (remark,) = angle_remarks([angle], "output")
    assert f"by a turn of {turn:.4g} in 11 places" in remark


def test_an_angle_that_starts_again_is_named(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rng = np.random.default_rng(0)
    table = held_levels_log()
    angle = np.cumsum(5.0 * table["y"] + 8.0) % 360.0
    table.assign(y=angle).to_csv(path, index=False)
    assert "jumps by a turn of 360 in " in str(look(path))
    late_ms = np.sin(np.arange(400) / 30)
    late = table.assign(y=angle, **{"time (ms)": table["time (ms)"] + late_ms})
    late.to_csv(path, index=False)
    seen = str(look(path))
    assert "samples interpolated" in seen
    assert "jumps by a turn of 360 in " in seen
    white_noise = rng.standard_normal(400)
    scaled = np.clip(white_noise, -3.0, 3.0)
    table.assign(y=scaled).to_csv(path, index=False)
    assert "jumps by a turn" not in str(look(path))


def test_why_nothing_is_measured_is_said(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    table = held_levels_log()
    table.head(100).to_csv(path, index=False)
    assert "the longest piece has 100 samples, fewer than 160" in str(look(path))
    held = np.repeat([0.0, 1.0], 200)
    clock_ms = table["time (ms)"] + 1000.0 * held
    table.assign(**{"time (ms)": clock_ms, "u": held}).to_csv(path, index=False)
    assert "the input stands still throughout the longest piece" in str(look(path))


def test_a_clock_without_a_unit_yields_to_dates_that_contradict_it(tmp_path: Path) -> None:
    """Hours since the start, beside the dates of the same rows."""
    path = tmp_path / "log.csv"
    table = held_levels_log()
    columns = table[["u", "y"]].assign(t=np.arange(400) / 12.0)
    dates = pd.date_range("2009-02-05 14:26:00", periods=400, freq="5min")
    columns.assign(TimeDate=dates).to_csv(path, index=False)
    assert "clock TimeDate (dates); step 300 s" in str(look(path))
    seconds = columns.assign(t=300.0 * np.arange(400), TimeDate=dates)
    seconds.to_csv(path, index=False)
    assert "step 300 s" in str(look(path))


GUESSES = {
    "Q1,Q2,TC1,TC2": ("Q1", "TC1"),
    "Heater 1,Heater 2,Temperature 1,Temperature 2": ("Heater 1", "Temperature 1"),
    "1,2,3,4": ("0", "2"),
    "motorCommand,targetSpeed,leftSpeed,rightSpeed": ("motorCommand", "leftSpeed"),
    "rightCommand,pad,leftSpeed,rightSpeed": ("rightCommand", "rightSpeed"),
    "Ph,Pw,Ta,yTi": ("Ph", "yTi"),
}


@pytest.mark.parametrize("titles", GUESSES)
def test_the_second_input_is_not_taken_for_the_output(tmp_path: Path, titles: str) -> None:
    rng = np.random.default_rng(0)
    names = titles.split(",")
    u = np.repeat(rng.integers(0, 9, (10, 2)) * 10.0, 40, axis=0)
    y = scipy.signal.lfilter([0.0, 0.2], [1, -0.8], u, axis=0)
    signals = np.hstack([u, y + 0.1 * rng.standard_normal(y.shape)])
    table = pd.DataFrame(signals, columns=names)
    has_names = not names[0].isdigit()
    table.to_csv(tmp_path / "log.csv", index=False, header=has_names)
    seen = look(tmp_path / "log.csv")
    assert (seen.input, seen.output) == GUESSES[titles]


def test_a_constant_set_point_or_nameless_column_hinders_no_guess(tmp_path: Path) -> None:
    table = held_levels_log()
    named = table.assign(targetSpeed=200.0)
    named.to_csv(tmp_path / "log.csv", index=False)
    seen = look(tmp_path / "log.csv")
    assert seen.input == "u"
    assert "data.reference" not in str(seen)
    signals = np.column_stack([table["u"], table["y"], np.zeros(400)])
    scipy.io.savemat(tmp_path / "log.mat", {"dataAll": signals})
    seen = look(tmp_path / "log.mat")
    assert (seen.input, seen.output) == ("dataAll:1", "dataAll:2")


def test_a_column_that_counts_rows_is_not_measured_too(tmp_path: Path) -> None:
    table = held_levels_log()
    signals = np.column_stack([np.arange(1, 401), table["u"], table["y"]])
    scipy.io.savemat(tmp_path / "log.mat", {"data": signals})
    assert "measured too" not in str(look(tmp_path / "log.mat"))


def test_the_output_of_a_lone_input_is_asked_for(tmp_path: Path) -> None:
    table = held_levels_log()
    table[["u"]].to_csv(tmp_path / "in.csv", index=False)
    seen = look(tmp_path / "in.csv")
    assert "name that data.output_path" in str(seen)
    assert "data.output_path=FILE" in seen.command


STRANGERS_TITLES = {
    "t [s],Lauge [l/h],pH": ("Lauge [l/h]", "pH"),
    "t,heater,outdoor,room": ("heater", "room"),
    "t,Heizung,Außen,Innen": ("Heizung", "Innen"),
    "t,power,outdoor temperature,water": ("power", "water"),
}


@pytest.mark.parametrize("titles", STRANGERS_TITLES)
def test_the_weather_is_neither_input_nor_output(tmp_path: Path, titles: str) -> None:
    """`Ph` is a power in one log, `pH` an acidity in another."""
    names = titles.split(",")
    table = held_levels_log()
    clock_s = table["time (ms)"] / 1e3
    days = np.arange(len(table)) / 60.0
    weather = 10.0 * np.sin(days)
    columns = [clock_s, table["u"], weather, table["y"]]
    if len(names) == 3:
        del columns[2]
    signals = np.stack(columns, axis=1)
    log = pd.DataFrame(signals)
    log.columns = pd.Index(names)
    path = tmp_path / "log.csv"
    log.to_csv(path, index=False)
    seen = look(path)
    assert (seen.input, seen.output) == STRANGERS_TITLES[titles]


@pytest.mark.parametrize(("title", "unit_s"), [("min", 60.0), ("ms", 1e-3), ("h", 3600.0)])
def test_a_column_named_by_a_unit_of_time_alone_is_the_clock(
    tmp_path: Path, title: str, unit_s: float
) -> None:
    table = held_levels_log().rename(columns={"time (ms)": title})
    table[title] = np.arange(len(table))
    path = tmp_path / "log.csv"
    table.to_csv(path, index=False)
    text = str(look(path))
    assert f"clock {title}; step {unit_s:g} s" in text
    source = RecordedData(path=str(path), input="u", output="y", time=title)
    data = source.build(0)
    assert data.step_s == pytest.approx(unit_s)


def test_a_minimum_that_falls_and_rises_is_no_clock(tmp_path: Path) -> None:
    named = held_levels_log().rename(columns={"y": "min"})
    table = named.drop(columns="time (ms)")
    path = tmp_path / "log.csv"
    table.to_csv(path, index=False)
    text = str(look(path, input="u", output="min"))
    assert "no clock found" in text


def test_a_set_point_is_in_a_command_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    set_point = np.repeat([1.0, 2.0], 200)
    table = held_levels_log()
    with_set_point = table.assign(setpoint=set_point)
    with_set_point.to_csv(path, index=False)
    seen = look(path)
    expected = f"{seen.command} data.reference=setpoint"
    assert seen.reference_command == expected
    text = str(seen)
    assert text.endswith(f"or if a controller made the input:\n{expected}")
    table.to_csv(path, index=False)
    without = look(path)
    assert without.reference_command == ""
