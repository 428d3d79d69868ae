"""Logs as people write them, to a fit: each file of `../shared/data/logs_small`, trained briefly.

Files that hold the same lag are fitted by least squares; those that mislead a choice (feedthrough,
positions behind a dead zone, plateaus, stairs) with the setting that `look` or the evidence names.
"""

from pathlib import Path

import pytest

from ssm_study.api.parts import StudyParts
from ssm_study.models.warm_start import simulate_validation_and_test

SHARED = Path(__file__).parents[3] / "shared"
FOLDER = SHARED / "data" / "logs_small"
IS_MISSING = not FOLDER.is_dir()
pytestmark = pytest.mark.skipif(IS_MISSING, reason="needs ../shared/data/logs_small")
STEP_S = {"step_s": 0.01}
BY_NUMBER = {"input": 0, "output": 1, **STEP_S}
OUTPUT_PATH = str(FOLDER / "zero_out.csv")
APART = BY_NUMBER | {"output": 0, "output_path": OUTPUT_PATH}
WITHOUT_NAMES = {"tab.txt": BY_NUMBER, "zero_one.csv": BY_NUMBER, "zero_in.csv": APART}
WITHOUT_A_CLOCK = {"dup.csv": STEP_S, "unnamed.csv": STEP_S}
MATLAB = {
    "matrix.mat": {"input": 1, "output": 2, "time": 0},
    "struct.mat": {"input": "log.u", "output": "log.y", **STEP_S},
}
OTHER_NAMES = {
    "latin.csv": {"input": "Drehzahl in 1/min", "output": "Öltemp °C"},
    "names.csv": {"input": 1, "output": 2},
}
DATES = ["dates_eu.csv", "dates_nosec.csv"]
GAPS = ["gap.csv", "na.csv", "nan.csv"]
SPELLINGS = ["comment.csv", "german.csv", "plain.txt", "trail.csv", "units_row.csv"]
CLOCKS = ["ms.csv", "ms2.csv", "three_digits.csv", "us.csv"]
AS_THEY_ARE = [*DATES, *GAPS, *SPELLINGS, *CLOCKS]
LAG: dict[str, dict[str, object]] = {name: {} for name in AS_THEY_ARE}
LAG |= WITHOUT_NAMES | WITHOUT_A_CLOCK
LAG |= MATLAB | OTHER_NAMES
ONE_TENTH = {"step_s": 0.1}


def fit_on_test(name: str, settings: dict[str, object], model: str, *words: str) -> float:
    """Fit on the test record of the file, read with these settings."""
    choices = {"data": "recorded", "model": model, "training": "default"}
    parts = StudyParts(choices, words)
    columns = {"input": "u", "output": "y"}
    path = str(FOLDER / name)
    fields = columns | settings
    parts.change_settings("data", path=path, **fields)
    source = parts.build("data")
    data = source.build(0)
    spec = parts.build("model")
    trained = spec.fit_model(data)
    _, on_test = simulate_validation_and_test(trained, data)
    return on_test.fit_percent


@pytest.mark.parametrize("name", LAG)
def test_the_lag_is_fitted_from_every_spelling(name: str) -> None:
    settings = LAG[name]
    on_test = fit_on_test(name, settings, "arx")
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


LEVELS = [("plateau.csv", 95.0), ("stairs.csv", 98.0)]


@pytest.mark.parametrize(("name", "least"), LEVELS)
def test_levels_cut_into_blocks_are_fitted(name: str, least: float) -> None:
    on_test = fit_on_test(name, ONE_TENTH, "arx", "data.split=blocks")
    assert on_test > least


POSITIONS = ("pos_random_60_0.9.csv", "pos_sweep_60_0.9.csv", "pos_random_0_1.csv")


def test_a_position_is_the_running_sum_of_what_a_fit_of_its_rate_predicts() -> None:
    """Velocities of the positions behind a dead zone, by a polynomial of the input."""
    words = ("model.degree=3", "model.lags=2", "data.differentiate=true")
    for name in POSITIONS:
        on_test = fit_on_test(name, ONE_TENTH, "narx", *words)
        assert on_test > 80
