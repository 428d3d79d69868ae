"""The settings behind the benchmark table are those that folds and rehearsals chose, as their
tables have it."""

import csv
import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results" / "reference" / "benchmarks"
TABLES = {"emps": "rehearsal", "ced": "choice", "cascaded_tanks": "choice"}
DATA = {"emps": "emps_position", "ced": "ced", "cascaded_tanks": "cascaded_tanks"}


def rows(benchmark: str) -> list[dict[str, str]]:
    path = RESULTS / f"{TABLES[benchmark]}.csv"
    with path.open(newline="") as stream:
        dict_reader = csv.DictReader(stream)
        return [row for row in dict_reader if row["benchmark"] == benchmark]


def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("study", overrides=list(overrides))


@pytest.mark.parametrize("benchmark", DATA)
def test_the_table_ranks_by_the_error_over_all_parts(benchmark: str) -> None:
    part = "rehearsal" if TABLES[benchmark] == "rehearsal" else "fold"
    ranked = rows(benchmark)
    pooled = [float(row["held_out_rmse"]) for row in ranked]
    assert pooled == sorted(pooled)
    for row, error in zip(ranked, pooled, strict=True):
        cells = [row[f"{part}_{k}"] for k in range(4)]
        # A setting that failed on one is out.
        parts = [float(cell or "inf") for cell in cells]
        squares = [part_error**2 for part_error in parts]
        mean_square = sum(squares) / 4
        assert math.sqrt(mean_square) == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize("benchmark", DATA)
def test_the_chosen_settings_are_those_that_are_scored(benchmark: str) -> None:
    scored = composed("experiment=benchmarks", f"data={DATA[benchmark]}", "model=ssm")
    best = rows(benchmark)[0]
    order = scored.model.order
    assert order == int(best["order"])
    hidden_width = scored.model.hidden_width
    assert hidden_width == int(best["hidden_width"])
    slope_lower = scored.model.slope_lower
    assert slope_lower == float(best["slope_lower"])
    scaffold_out = scored.model.scaffold_out
    scaffold_name = scaffold_out._target_.rsplit(".", 1)[-1]
    assert scaffold_name.lower() == best["scaffold_out"]


def test_the_servo_is_scored_as_it_was_rehearsed() -> None:
    scored = composed("experiment=benchmarks", "data=emps_position", "model=ssm")
    folder = ROOT / "benchmarks" / "rehearsal" / "conf"
    rehearsed = composed("experiment=benchmark_rehearsal", f"hydra.searchpath=[file://{folder}]")
    assert scored.training == rehearsed.training
    ring_radius = scored.model.ring_radius
    assert ring_radius == [0.9, 0.9999]
    ring_frequency = scored.model.ring_frequency
    assert ring_frequency == [0.003, 0.1]
    training = scored.data.training
    assert training == rehearsed.data.experiments.training
    output_equilibrium = scored.data.output_equilibrium
    best = rows("emps")[0]
    expected = [float(best["output_equilibrium"])]
    assert output_equilibrium == expected
