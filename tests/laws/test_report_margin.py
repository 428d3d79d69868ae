"""The margin's figures: the curve is the one its area says, and both figures hold every design."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssm_study import style

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import loop_margin_figures


def designs(count: int = 60) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    margin = np.round(rng.lognormal(-1, 1.5, count), 1)  # rounded: ties
    upper_limit = margin / (0.5 + margin)
    settled = rng.uniform(size=count) < upper_limit
    plant = np.where(np.arange(count) % 2, "dc_motor", "cascaded_tanks")
    controller_radius = rng.uniform(0.5, 1.3, count)
    noise_peak = rng.uniform(0.0, 1.3, count)
    kind = np.where(settled, "settled", "lost")
    is_unstable = rng.uniform(size=count) < 0.2
    relative_time = np.where(is_unstable, np.nan, rng.uniform(0.2, 2, count))
    return pd.DataFrame(
        {
            "plant": plant,
            "mismatch_margin": margin,
            "resolved_margin": margin,
            "controller_radius": controller_radius,
            "noise_peak": noise_peak,
            "kind": kind,
            "relative_time": relative_time,
        }
    )


def test_the_area_is_the_chance_that_a_good_design_scores_higher():
    table = designs()
    good = table["kind"].eq("settled").to_numpy(float)
    score = table["mismatch_margin"].to_numpy()
    false, true = loop_margin_figures.roc_points(score, good)
    good_scores = score[good == 1][:, None]
    bad_scores = score[good == 0][None, :]
    difference = good_scores - bad_scores
    pairs = np.sign(difference)
    expected = (0.5 + 0.5 * pairs).mean()
    area = np.trapezoid(true, false)
    assert area == pytest.approx(expected, rel=1e-12)
    assert false[-1] == 1.0
    assert true[-1] == 1.0


def test_the_score_puts_what_nothing_else_refuses_first_and_then_the_larger_margin():
    table = designs()
    score = loop_margin_figures.prediction_score(table)
    is_contracting = table.controller_radius < 1
    stable = (is_contracting) & (table.noise_peak < 1)
    expected = stable & (table.resolved_margin > 1)
    assert ((score > 0.5) == expected).all()
    smallest = score[stable].min()
    largest = score[~stable].max()
    assert smallest >= largest
    order = np.argsort(score[stable], kind="stable")
    margins = table.resolved_margin[stable]
    expected = np.argsort(margins, kind="stable")
    assert (order == expected).all()


def test_every_design_is_in_the_scatter_and_every_plant_in_the_curve():
    table = designs()
    with style.paper_style():
        roc = loop_margin_figures.roc(table)
        settling = loop_margin_figures.settling(table)
    drawn = sum(len(dots.get_offsets()) for axes in settling.axes for dots in axes.collections)
    assert drawn == len(table)
    assert len(settling.axes) == 2
    legend = roc.axes[0].get_legend()
    texts = legend.get_texts()
    expected = ["cascaded tanks", "DC motor"]
    first_words = [text.get_text().split(",")[0] for text in texts]
    assert first_words == expected


def test_a_plant_on_which_all_settle_has_no_curve_but_its_dots():
    table = designs().assign(kind="settled")
    with style.paper_style():
        roc = loop_margin_figures.roc(table)
        settling = loop_margin_figures.settling(table)
    lines = roc.axes[0].lines
    assert len(lines) == 1  # the diagonal
    assert sum(
        len(dots.get_offsets()) for axes in settling.axes for dots in axes.collections
    ) == len(table)
