"""Pictures of the page: what the legend shows is what is drawn, and a thinned line keeps its
peaks."""

import re
from pathlib import Path

import numpy as np
import pytest
from report_runs import random_model, random_run, write_recordings

from ssm_study import style
from ssm_study.api.pictures.bode import bode_picture, input_map_gain_ratio
from ssm_study.api.pictures.coverage import smallest_coverage_record_text
from ssm_study.api.pictures.drawing import draw_picture
from ssm_study.api.pictures.margin import amplitude_text
from ssm_study.api.pictures.picture import (
    DASH_CYCLE,
    DASHED,
    Band,
    GuideLine,
    Picture,
    PicturePanel,
    Series,
)
from ssm_study.api.pictures.poles import format_below_one
from ssm_study.report.page.pictures import (
    MOST_POINTS,
    legend_entries,
    panel_spec,
    pictures_of_run,
    thin_line,
)
from ssm_study.report.study_folder import RunFolder
from ssm_study.signals import Trajectory

ENDS = np.array([0.0, 1.0])


def panel() -> PicturePanel:
    solid = Series(x=ENDS, y=ENDS, name="solid")
    dashed = Series(x=ENDS, y=ENDS, name="dashed", dashes=DASHED, colour=style.VERMILLION)
    poles = Series(x=ENDS, y=ENDS, name="poles", mark="crosses", colour=style.GREY)
    short_dashes = (2, 2)
    held = Series(x=ENDS, y=ENDS, name="held", mark="steps", dashes=short_dashes)
    unnamed = Series(x=ENDS, y=ENDS)
    series = (solid, dashed, poles, held, unnamed)
    area = Band(x=ENDS, low=ENDS, high=ENDS + 1, name="area", colour=style.SKY)
    bands = (area,)
    bound = GuideLine(y=1.0, name="bound", dashed=False)
    rules = (bound,)
    return PicturePanel(x_label="x", y_label="y", series=series, bands=bands, rules=rules)


def test_the_legend_shows_marks_colours_and_dashes_as_they_are_drawn() -> None:
    legend = legend_entries(panel())
    entries = {name: rest for name, *rest in legend}
    expected_entries = {
        "bound": ["line", style.INK, ""],
        "solid": ["line", style.BLUE, ""],
        "dashed": ["line", style.VERMILLION, "5 3"],
        "poles": ["crosses", style.GREY, ""],
        "held": ["line", style.BLUE, "2 2"],
        "area": ["band", style.SKY, ""],
    }
    assert entries == expected_entries
    layers_of_panel = panel_spec(panel(), "")
    layers = layers_of_panel["layer"]
    band, rule, *drawn = layers
    assert band["mark"]["type"] == "area"
    dashes_of_rule = rule["mark"]["strokeDash"]
    assert dashes_of_rule == ()
    dashes = [layer["mark"].get("strokeDash") for layer in drawn]
    expected_dashes = [None, [5, 3], None, [2, 2], None]
    assert dashes == expected_dashes
    first_lines = drawn[:3]
    colours = [layer["encoding"]["color"]["value"] for layer in first_lines]
    lines = ("solid", "dashed", "poles")
    of_the_legend = [entries[name][1] for name in lines]
    assert colours == of_the_legend


def test_every_mark_has_a_symbol_in_the_legend() -> None:
    from ssm_study.report.page.pictures import JOINED, MARKS
    from ssm_study.report.page.writing import read_asset

    parts_of_text = read_asset("state.js").partition("const SHAPES = {")
    after_the_name = parts_of_text[2]
    parts_of_shapes = after_the_name.partition("};")
    shapes = parts_of_shapes[0]
    names = set(re.findall(r"^  (\w+): \"", shapes, re.M))
    marks = {*MARKS, "band"} - {*JOINED}
    marks_in_the_legend = marks | {"line"}
    assert marks_in_the_legend <= names


def test_as_many_dashes_as_colours_and_none_twice() -> None:
    distinct_dashes = len({*DASH_CYCLE})
    assert distinct_dashes == len(DASH_CYCLE) == len(style.CYCLE)


def test_a_thinned_line_keeps_its_peaks_its_ends_and_its_gaps() -> None:
    rng = np.random.default_rng(0)
    x = np.arange(5000.0)
    y = rng.normal(size=5000)
    y[1234] = 40.0
    y[4321] = -40.0
    y[2000:2100] = np.nan
    thin_x, thin_y = thin_line(x, y)
    assert len(thin_x) <= MOST_POINTS + 5
    assert np.nanmax(thin_y) == 40.0
    assert np.nanmin(thin_y) == -40.0
    first_and_last = [0, -1]
    ends = thin_x[first_and_last]
    list_of_ends = ends.tolist()
    assert list_of_ends == [0.0, 4999.0]
    is_missing = np.isnan(thin_y)
    gaps = is_missing.sum()
    assert gaps == 1
    is_rising = np.diff(thin_x) > 0
    assert is_rising.all()


def test_amplitudes_and_places_are_printed_in_physical_units() -> None:
    amplitude = amplitude_text(0.5, (4.0, "V"))
    assert amplitude == "input of rms 2 V"
    assert amplitude_text(0.5, None) == "input of rms 0.5 input scales"
    labels = {"input of rms 0.5": "input of rms 2 V"}
    step_s = 0.01
    words = smallest_coverage_record_text(
        "input of rms 0.5, 0.31 to 0.63 rad/sample", labels, step_s
    )
    assert words == "input of rms 2 V, 4.93 to 10 Hz"
    words = smallest_coverage_record_text(
        "input of rms 0.5, around 0.00 rad/sample", labels, step_s
    )
    assert words == "input of rms 2 V, the lowest frequencies"
    requirement = smallest_coverage_record_text("input of rms 0.5, in total", labels, step_s)
    assert requirement == "input of rms 2 V, in total"


KINDS = ["monotone", "linear"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_line_at_the_records_gain_meets_what_the_record_shows(kind: str) -> None:
    """Output of a static map alone: its cross spectrum over the input's power is that gain."""
    rng = np.random.default_rng(1)
    model = random_model(rng, kind, 1)
    scale = model.scale.input_scale
    deviation = rng.normal(size=(4000, 1))
    input_equilibrium = model.scale.input_equilibrium
    u = input_equilibrium + scale * deviation
    y = model.scaffold_in(deviation)
    record = Trajectory(u=u, y=y, step_s=0.01)
    ratio = input_map_gain_ratio(model, record)
    input_at_rest = np.zeros(1)
    slopes_at_rest = model.scaffold_in.jacobian(input_at_rest)
    slope_at_rest = slopes_at_rest[0, 0]
    slope = float(slope_at_rest)
    inputs = deviation[:, 0]
    outputs = y[:, 0]
    best_line = np.polyfit(inputs, outputs, 1)
    slope_of_best_line = float(best_line[0])
    if kind == "linear":
        assert ratio is None
        assert slope_of_best_line == pytest.approx(slope)
        return
    assert ratio is not None
    expected_slope = pytest.approx(slope_of_best_line)
    assert ratio * slope == expected_slope
    picture = bode_picture(model, record)
    panels = picture.panels
    panel_of_gains = panels[0]
    names = [series.name for series in panel_of_gains.series]
    assert "model at the record's mean gain" in names


def test_a_proved_factor_is_never_printed_smaller_nor_as_one() -> None:
    assert format_below_one(0.89341) == "0.894"
    assert format_below_one(0.999817) == "0.9999"
    assert format_below_one(0.5) == "0.500"


def test_a_picture_that_a_run_does_not_have_is_named_with_its_reason(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="monotone", channels=1, seed=1)
    write_recordings(run)
    run_folder = RunFolder(path=run)
    *drawn, last = pictures_of_run(run_folder)
    assert last["name"] == "missing"
    assert last["charts"] == []
    assert "Coverage by band: It is not proved" in last["caption"]
    names = [entry["name"] for entry in drawn]
    assert names
    assert "missing" not in names
    empty_folder = RunFolder(path=tmp_path / "empty")
    pictures = pictures_of_run(empty_folder)
    assert pictures == []


@pytest.mark.parametrize("wide", [False, True])
def test_a_long_title_is_not_cut_off(wide: bool) -> None:
    """That of the frequency response ended in `times t`."""
    title = (
        "Frequency response at rest; over the record the input map's gain is 1.9 times that at rest"
    )
    panels = (panel(),)
    picture = Picture(title=title, panels=panels, wide=wide)
    figure = draw_picture(picture)
    figure.draw_without_rendering()
    words = figure.get_suptitle()
    separate_words = words.split()
    one_line = " ".join(separate_words)
    assert one_line == title
    box = figure._suptitle.get_window_extent()
    assert box.x1 <= figure.bbox.x1
