"""Logs as people write them, to a fit: each file of `../shared/data/logs_small`, trained briefly.

Files that hold the same lag are fitted by least squares; those that mislead a choice (feedthrough,
positions behind a dead zone, plateaus, stairs) with the setting that `look` or the evidence names.
"""

from pathlib import Path

import pytest

from ssm_study.api.parts import Parts
from ssm_study.models.warm_start import simulate_validation_and_test

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "logs_small"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/data/logs_small")
BY_NUMBER = {"input": 0, "output": 1, "step_s": 0.01}
APART = BY_NUMBER | {"output": 0, "output_path": str(FOLDER / "zero_out.csv")}
LAG = {
    "comment.csv": {},
    "dates_eu.csv": {},
    "dates_nosec.csv": {},
    "dup.csv": {"step_s": 0.01},
    "gap.csv": {},
    "german.csv": {},
    "latin.csv": {"input": "Drehzahl in 1/min", "output": "Öltemp °C"},
    "matrix.mat": {"input": 1, "output": 2, "time": 0},
    "ms.csv": {},
    "ms2.csv": {},
    "na.csv": {},
    "names.csv": {"input": 1, "output": 2},
    "nan.csv": {},
    "plain.txt": {},
    "struct.mat": {"input": "log.u", "output": "log.y", "step_s": 0.01},
    "tab.txt": BY_NUMBER,
    "three_digits.csv": {},
    "trail.csv": {},
    "units_row.csv": {},
    "unnamed.csv": {"step_s": 0.01},
    "us.csv": {},
    "zero_in.csv": APART,
    "zero_one.csv": BY_NUMBER,
}
ONE_TENTH = {"step_s": 0.1}


def fit_on_test(name: str, settings: dict[str, object], model: str, *words: str) -> float:
    """Fit on the test record of the file, read with these settings."""
    choices = {"data": "recorded", "model": model, "training": "default"}
    parts = Parts(choices, words)
    columns = {"input": "u", "output": "y"}
    path = str(FOLDER / name)
    parts.set_fields("data", path=path, **(columns | settings))
    data = parts.build("data").build(0)
    trained = parts.build("model").solve(data)
    return simulate_validation_and_test(trained, data)[1].fit_percent


@pytest.mark.parametrize("name", LAG)
def test_the_lag_is_fitted_from_every_spelling(name: str) -> None:
    on_test = fit_on_test(name, LAG[name], "arx")
    assert on_test > 99.9


@pytest.mark.parametrize("kind", ["aprbs", "white"])
def test_an_answer_within_the_sample_is_fitted_with_feedthrough_alone(kind: str) -> None:
    """The noise is 2 % of the range: 96 % (random levels) and 90 % (white input) can be reached."""
    same = f"{kind}_answers_in_the_same_sample_noise0.02.csv"
    later = f"{kind}_answers_in_the_next_sample_noise0.02.csv"
    best = fit_on_test(later, ONE_TENTH, "arx")
    assert best > 89
    on_test = fit_on_test(same, ONE_TENTH, "arx", "model.delay=0")
    assert on_test == pytest.approx(best, abs=1.0)
    on_test = fit_on_test(same, ONE_TENTH, "arx")
    assert on_test < best - 10


@pytest.mark.parametrize(("name", "least"), [("plateau.csv", 95.0), ("stairs.csv", 98.0)])
def test_levels_cut_into_blocks_are_fitted(name: str, least: float) -> None:
    on_test = fit_on_test(name, ONE_TENTH, "arx", "data.split=blocks")
    assert on_test > least


def test_a_position_is_the_running_sum_of_what_a_fit_of_its_rate_predicts() -> None:
    """Velocities of the positions behind a dead zone, by a polynomial of the input."""
    words = ("model.degree=3", "model.lags=2", "data.differentiate=true")
    for name in ("pos_random_60_0.9.csv", "pos_sweep_60_0.9.csv", "pos_random_0_1.csv"):
        on_test = fit_on_test(name, ONE_TENTH, "narx", *words)
        assert on_test > 80
