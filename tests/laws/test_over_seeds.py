"""Means and deviations over seeds below the table of `show`."""

import pandas as pd
import pytest

from ssm_study.table.over_seeds import mean_and_deviation_text, seed_statistics_lines


def study(**more: object) -> pd.DataFrame:
    """Two rates by three seeds; the last run has no result."""
    seed = [0, 1, 2] * 2
    rate_controller = [0.1] * 3 + [0.3] * 3
    fit_test_percent = [90.0, 91.0, 92.0, 90.0, 91.0, 92.0]
    resolved_margin = [2.0, 3.0, 4.0, 1.5, 2.5, None]
    settings = {"seed": seed, "rate_controller": rate_controller}
    outcomes = {"fit_test_percent": fit_test_percent, "resolved_margin": resolved_margin}
    table = pd.DataFrame(settings | outcomes)
    return table.assign(**more)


def test_each_setting_has_its_mean_and_deviation() -> None:
    lines = seed_statistics_lines(study())
    expected = ["", "mean ± deviation over seeds"]
    assert lines[:2] == expected
    first = lines[-2].split()
    second = lines[-1].split()
    rate_and_fit = ["0.1", "3", "91", "±", "1"]
    margin = ["3", "±", "1", "-", "-"]
    assert first == [*rate_and_fit, *margin]
    expected = ["2", "±", "0.71"]
    assert second[5:8] == expected, "a seed without a result is left out"


def test_two_seeds_have_a_deviation() -> None:
    table = study()
    two_seeds = table[table["seed"] < 2]
    lines = seed_statistics_lines(two_seeds)
    assert lines[1] == "mean ± deviation over seeds"
    assert len(lines) > 3


def test_one_seed_or_one_run_a_setting_has_no_deviation() -> None:
    table = study(seed=0)
    assert seed_statistics_lines(table) == []
    table = study(rate_controller=range(6))
    assert seed_statistics_lines(table) == []


GROUPS = [([], "-"), ([2.0], "2"), ([1.0, 2.0], "1.5 ± 0.71")]


@pytest.mark.parametrize(("values", "words"), GROUPS)
def test_the_words_of_a_group(values: list[float], words: str) -> None:
    series = pd.Series(values, dtype=float)
    actual = mean_and_deviation_text(series)
    assert actual == words
