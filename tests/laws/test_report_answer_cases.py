"""Answers of the report page one by one, at the edges of each case."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.report.answers import (
    certifiable_rate_sentences,
    distinct_values_text,
    exceeded_limit_sentence,
    failure_bound_sentences,
    feasibility_sentences,
    fit_correlation_sentence,
    fit_correlation_sentences,
    group_by_plant,
    prediction_sentences,
    rate_limit_sentence,
    swept_settings_line,
)


def test_values_of_a_setting_ascend_with_auto_last_and_many_are_abridged() -> None:
    actual = distinct_values_text(pd.Series(["auto", 0.3, 0.1, None]))
    assert actual == "0.1, 0.3, auto"
    eight = pd.Series(range(8))
    text = distinct_values_text(eight)
    assert text == "0, 1, 2, 3, 4, 5, 6, 7"
    actual = distinct_values_text(pd.Series(range(9)))
    assert actual == "9 values, 0 to 8"
    actual = swept_settings_line(pd.DataFrame({"order": [4]}))
    assert actual == "One setting, no sweep."


def test_plants_are_named_where_there_are_several() -> None:
    one = pd.DataFrame({"plant": ["DCMotor", "DCMotor"]})
    names = [name for name, _ in group_by_plant(one)]
    assert names == [""]
    two = pd.DataFrame({"plant": ["own_rig", "DCMotor", "own_rig", None]})
    groups = {name: len(runs) for name, runs in group_by_plant(two)}
    expected = {"Own rig: ": 2, "DC motor: ": 1}
    assert groups == expected


def rates(*rows: tuple[float, float | None, bool | None], side: str = "controller") -> pd.DataFrame:
    """Table of requested rates, their limits and whether they were certified."""
    names = [f"rate_{side}", f"{side}_rate_limit", f"{side}_certified"]
    return pd.DataFrame(rows, columns=names)


def test_a_rate_at_its_limit_lies_beyond() -> None:
    table = rates((0.3, 0.3, None), (0.1, 0.3, True))
    _, sentence = certifiable_rate_sentences(table, "controller")
    assert sentence == "1 of 2 requests lie beyond it, and none of those was certified."
    table = rates((0.4, 0.3, True), (0.1, 0.3, True), (0.5, None, None))
    _, sentence = certifiable_rate_sentences(table, "controller")
    assert sentence == "1 of 2 requests lie beyond it, and 1 of those were certified."
    assert exceeded_limit_sentence(2, 3, 0).endswith("none of those was certified.")


def test_rates_below_their_limit_are_counted_in_words() -> None:
    table = rates((0.1, 0.3, True))
    one = list(certifiable_rate_sentences(table, "controller"))
    assert one[1:] == ["The rate is below it."]
    table = rates((0.1, 0.3, True), (0.2, 0.3, False))
    two = list(certifiable_rate_sentences(table, "controller"))
    missed = "Inside it, 1 got no certificate: there the method fell short."
    expected = ["Every rate is below the limit of its model.", missed]
    assert two[1:] == expected
    table = rates((0.1, None, True))
    names = list(certifiable_rate_sentences(table, "controller"))
    assert names == []
    good = rates((0.1, 0.3, True), side="observer")
    assert feasibility_sentences(good) == ()
    bad = rates((0.1, 0.3, False), side="observer")
    assert len(feasibility_sentences(bad)) == 3


def test_the_limit_names_its_input_map_and_its_range() -> None:
    limits = pd.Series([0.25, 0.3])
    controller = rate_limit_sentence("controller", limits)
    assert "any controller can be certified for is from 0.25 to 0.3 per sample" in controller
    assert controller.endswith("slope of S_u.")
    observer = rate_limit_sentence("observer", limits[:1])
    assert "any observer can be certified for is 0.25 per sample" in observer
    assert observer.endswith("slope of S_y.")


def fits(*values: float, **columns: Any) -> pd.DataFrame:
    """Table of certified runs with these fits."""
    certified = {"controller_certified": True, "observer_certified": True}
    return pd.DataFrame({"fit_test_percent": values}).assign(**certified | columns)


def test_a_correlation_needs_three_fits_and_unequal_loops() -> None:
    shares = [0.5, 0.7, 1.0]
    table = fits(80, 85, 90, stable_fraction=shares)
    sentence = fit_correlation_sentence(table)
    assert "share of starts settled have a rank correlation of 1.00" in sentence
    alike = fits(80, 80, 90, stable_fraction=shares)
    unknown = "it has 3 certified runs with 2 different fits."
    sentence = fit_correlation_sentence(alike)
    assert sentence.endswith(unknown)
    equal = fits(80, 85, 90, stable_fraction=1.0, settling_time_mean_s=[3.0, 2.0, 1.0])
    sentence = fit_correlation_sentence(equal)
    assert "settling time have a rank correlation of -1.00" in sentence
    half = fits(80, 85, 90, stable_fraction=shares, observer_certified=[True, True, False])
    sentence = fit_correlation_sentence(half)
    assert sentence.startswith("This study cannot tell")
    table = fits(80)
    actual = fit_correlation_sentences(table)
    assert actual == ()
    table = fits(80, 90)
    count = len(fit_correlation_sentences(table))
    assert count == 1


def test_predictions_are_counted_on_both_sides() -> None:
    table = pd.DataFrame({"predicted_stable": [True, True], "stable_fraction": [1.0, 0.5]})
    first, second = prediction_sentences(table)
    start = "Where the loop was predicted to stay stable"
    assert first == f"{start}, every start settles in 1 of 2 runs."
    assert second.startswith("All runs are on one side")
    both = table.assign(predicted_stable=[True, False])
    sentences = prediction_sentences(both)
    assert len(sentences) == 2
    on_model = table.assign(loop_on=["identified model", "plant"])
    sentences = prediction_sentences(on_model)
    assert len(sentences) == 2
    actual = prediction_sentences(table.assign(loop_on="identified model"))
    assert actual == ()
    actual = prediction_sentences(table.assign(predicted_stable=None))
    assert actual == ()


@given(st.integers(0, 5), st.integers(20, 60))
def test_the_bound_on_failures_is_that_of_clopper_and_pearson(failed: int, count: int) -> None:
    settled = np.ones(2 * count)
    settled[: 2 * failed : 2] = 0.9
    models = pd.Series(np.repeat(np.arange(count), 2)).astype(str)
    (sentence,) = failure_bound_sentences(models, pd.Series(settled))
    bound = float(sentence.rpartition("below ")[2].rstrip("."))
    probability = scipy.stats.binom.cdf(failed, count, bound)
    expected = pytest.approx(0.05, abs=0.02)
    assert probability == expected
    words = f"{failed} had" if failed else "none had"
    assert f"of {count} models {words} a predicted loop" in sentence


def test_a_bound_needs_two_models_and_one_success() -> None:
    models = pd.Series(["a", "b"])
    actual = failure_bound_sentences(models, pd.Series([0.5, 0.5]))
    assert actual == []
    actual = failure_bound_sentences(models[:1], pd.Series([1.0]))
    assert actual == []
    actual = failure_bound_sentences(pd.Series(["", ""]), pd.Series([1.0, 1.0]))
    assert actual == []
    (few,) = failure_bound_sentences(models, pd.Series([1.0, 1.0]))
    assert few == "2 models are too few to say how often a prediction fails."
