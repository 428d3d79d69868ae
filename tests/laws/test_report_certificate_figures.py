"""The committed certificate tables draw, and the figures say what the tables say."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssm_study import style

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import synthesis_figures

TABLES = Path(__file__).resolve().parents[2] / "results" / "reference" / "certificates"
NAMES = ("feasibility_map", "gain_norm", "contraction")


def table(name: str) -> pd.DataFrame:
    return pd.read_csv(TABLES / f"{name}.csv")


@pytest.mark.parametrize("name", NAMES)
def test_the_figure_draws_the_same_bytes_twice_with_a_unit_on_every_axis(
    name: str, tmp_path: Path
) -> None:
    files = []
    for folder in (tmp_path / "once", tmp_path / "again"):
        with style.paper_style():
            draw = getattr(synthesis_figures, name)
            figure = draw(table(name))
            paths = style.save_figure(figure, folder, name)
            contents = [path.read_bytes() for path in paths]
            files.append(contents)
    assert files[0] == files[1]
    (axes,) = figure.axes
    assert "(" in axes.get_xlabel()
    assert "(" in axes.get_ylabel()


def test_every_verdict_is_a_point_and_the_frontier_is_the_tables() -> None:
    rows = table("feasibility_map")
    figure = synthesis_figures.feasibility_map(rows)
    (axes,) = figure.axes
    _, of_certified, of_uncertified = axes.collections
    certified = of_certified.get_offsets()
    uncertified = of_uncertified.get_offsets()
    held = rows.solver_certified
    points = rows[["slope_floor", "rate"]]
    np.testing.assert_array_equal(certified, points[held])
    np.testing.assert_array_equal(uncertified, points[~held])
    floors, limits = axes.lines[0].get_data()
    rate_limit = rows.groupby("slope_floor").rate_limit
    expected = rate_limit.first()
    np.testing.assert_array_equal(floors, expected.index)
    np.testing.assert_array_equal(limits, expected)
    interpolated_values = np.interp(certified[:, 0], floors, limits)
    assert (certified[:, 1] < interpolated_values).all()


@pytest.mark.parametrize("name", ["gain_norm", "contraction"])
def test_every_method_of_the_table_has_its_line(name: str) -> None:
    rows = table(name)
    (axes,) = getattr(synthesis_figures, name)(rows).axes
    drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
    for method, group in rows.groupby("method"):
        label = synthesis_figures.METHODS[str(method)][0]
        expected = group["gain_norm" if name == "gain_norm" else "measured"]
        np.testing.assert_array_equal(drawn[label], expected)
