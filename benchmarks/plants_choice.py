"""The settings of our model on each benchmark, chosen without its test records.

    ssm-study run -m experiment=benchmark_choice
    ssm-study run --with benchmarks/rehearsal -m experiment=benchmark_rehearsal
    python benchmarks/plants_choice.py results/benchmark_choice [--out FOLDER]
    python benchmarks/plants_choice.py results/benchmark_rehearsal

Rule: on each record the setting with the least error on what was held out, which is the root mean
square over all samples of all folds, or of all rehearsals (start-up samples left out). A setting
that failed on one of them, or whose controller or observer is not certified, is out. No test file
is opened by these runs. Writes `choice.csv` or `rehearsal.csv`: every setting with each of its
errors, best first.
"""

import argparse
import csv
import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

from common import REFERENCE
from omegaconf import DictConfig, OmegaConf

UNITS = {"cascaded_tanks": "V", "ced": "ticks/s", "emps": "mm"}
SETTINGS = ("order", "hidden_width", "slope_lower", "scaffold_out")
PARTS = 4  # folds, or rehearsals
Setting = tuple[Any, ...]
Errors = dict[str, dict[Setting, dict[int, float]]]


def held_out_errors(study: Path, rehearsed: bool) -> Errors:
    """Benchmark -> setting -> fold or rehearsal -> root mean square error; a failed or uncertified
    one is a gap."""
    errors: Errors = defaultdict(lambda: defaultdict(dict))
    for path in sorted(study.glob("*/record.json")):
        record = json.loads(path.read_text())
        config = config_of(path)
        setting = tuple(record[name] for name in SETTINGS)
        if rehearsed:
            errors["emps"][(*setting, *config.data.experiments.output_equilibrium)] |= (
                rehearsal_errors(record)
            )
            continue
        assert config.data.fold is not None, f"{path.parent} is scored on the test records"
        of_setting = errors[str(config.data.benchmark)][setting]
        if record.get("rmse_test") is not None:
            of_setting[int(config.data.fold)] = float(record["rmse_test"])
    return errors


def rehearsal_errors(record: dict[str, Any]) -> dict[int, float]:
    certified = record.get("controller_certified") and record.get("observer_certified")
    return {k: float(record[f"score_test_{k + 1}"]) for k in range(PARTS)} if certified else {}


def config_of(record: Path) -> DictConfig:
    config = OmegaConf.load(record.parent / ".hydra" / "config.yaml")
    assert isinstance(config, DictConfig)
    return config


def pooled(parts: dict[int, float]) -> float:
    """`sqrt(mean_k rmse_k^2)`: the parts are of equal length."""
    return math.sqrt(sum(e**2 for e in parts.values()) / PARTS) if len(parts) == PARTS else math.inf


def rows_of(benchmark: str, settings: dict[Setting, dict[int, float]]) -> list[list[object]]:
    ranked = sorted(settings.items(), key=lambda item: pooled(item[1]))
    return [
        [benchmark, UNITS[benchmark], *setting, f"{pooled(parts):.4g}"]
        + [f"{parts[k]:.4g}" if k in parts else "" for k in range(PARTS)]
        for setting, parts in ranked
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "study", type=Path, help="the folder of the study, e.g. results/benchmark_choice"
    )
    parser.add_argument("--out", type=Path, default=REFERENCE / "benchmarks")
    options = parser.parse_args()
    runs = sorted(options.study.glob("*/record.json"))
    if not runs:
        raise SystemExit(
            f"{options.study} holds no runs; make them with: ssm-study run -m "
            "experiment=benchmark_choice"
        )
    rehearsed = "rehearsals" in config_of(runs[0]).data
    errors = held_out_errors(options.study, rehearsed)
    part, more = ("rehearsal", ["output_equilibrium"]) if rehearsed else ("fold", [])
    parts = [f"{part}_{k}" for k in range(PARTS)]
    with (options.out / ("rehearsal.csv" if rehearsed else "choice.csv")).open(
        "w", newline=""
    ) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["benchmark", "unit", *SETTINGS, *more, "held_out_rmse", *parts])
        for benchmark in [name for name in UNITS if name in errors]:
            rows = rows_of(benchmark, errors[benchmark])
            writer.writerows(rows)
            print(*rows[:3], sep="\n")


if __name__ == "__main__":
    main()
