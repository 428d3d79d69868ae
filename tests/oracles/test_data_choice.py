"""The settings behind the benchmark table are those that held-out folds chose, as the table of the choice has it."""

import csv
import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

ROOT = Path(__file__).resolve().parents[2]
CHOICE = ROOT / "results" / "reference" / "benchmarks" / "choice.csv"
DATA = {"emps": "emps_position", "ced": "ced", "cascaded_tanks": "cascaded_tanks"}


def rows(benchmark: str) -> list[dict[str, str]]:
    with CHOICE.open(newline="") as stream:
        return [row for row in csv.DictReader(stream) if row["benchmark"] == benchmark]


@pytest.mark.parametrize("benchmark", DATA)
def test_the_table_ranks_by_the_error_over_all_folds(benchmark: str) -> None:
    pooled = [float(row["held_out_rmse"]) for row in rows(benchmark)]
    assert pooled == sorted(pooled)
    for row, error in zip(rows(benchmark), pooled, strict=True):
        folds = [float(row[f"fold_{k}"] or "inf") for k in range(4)]  # a setting that failed on a fold is out
        assert math.sqrt(sum(e**2 for e in folds) / 4) == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize("benchmark", DATA)
def test_the_chosen_settings_are_those_that_are_scored(benchmark: str) -> None:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        asked = ["experiment=benchmarks", f"data={DATA[benchmark]}", "model=ssm"]
        model = compose("study", overrides=asked).model
    best = rows(benchmark)[0]
    assert model.order == int(best["order"])
    assert model.hidden_width == int(best["hidden_width"])
    assert model.slope_lower == float(best["slope_lower"])
    assert model.scaffold_out._target_.rsplit(".", 1)[-1].lower() == best["scaffold_out"]
