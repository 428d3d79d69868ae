"""The settings of our model on each benchmark, chosen without its test records.

    ssm-study run -m experiment=benchmark_choice
    python benchmarks/plants_choice.py results/benchmark_choice [--out FOLDER]

Rule: on each record the setting with the least held-out error, which is the root mean square over all samples of all
folds (start-up samples left out). A setting that failed on a fold is out. No test file is opened by these runs.
Writes `choice.csv`: every setting with its error on each fold, best first.
"""

import argparse
import csv
import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

REFERENCE = Path(__file__).resolve().parents[1] / "results" / "reference" / "benchmarks"
BENCHMARKS = {"cascaded_tanks": ("V", 1.0), "ced": ("ticks/s", 1.0), "emps": ("mm", 1000.0)}
SETTINGS = ("order", "hidden_width", "slope_lower", "scaffold_out")
FOLDS = 4
Setting = tuple[Any, ...]


def held_out_errors(study: Path) -> dict[str, dict[Setting, dict[int, float]]]:
    """Benchmark -> setting -> fold -> root mean square of the held-out error; failed runs leave a gap."""
    errors: dict[str, dict[Setting, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    for path in sorted(study.glob("*/record.json")):
        record, config = json.loads(path.read_text()), OmegaConf.load(path.parent / ".hydra" / "config.yaml")
        assert config.data.fold is not None, f"{path.parent} is scored on the test records"
        setting = tuple(record[name] for name in SETTINGS)
        of_setting = errors[str(config.data.benchmark)][setting]
        if record.get("rmse_test") is not None:
            of_setting[int(config.data.fold)] = float(record["rmse_test"])
    return errors


def pooled(folds: dict[int, float]) -> float:
    """`sqrt(mean_k rmse_k^2)`: the folds are of equal length."""
    return math.sqrt(sum(e**2 for e in folds.values()) / FOLDS) if len(folds) == FOLDS else math.inf


def rows_of(benchmark: str, settings: dict[Setting, dict[int, float]]) -> list[list[object]]:
    unit, factor = BENCHMARKS[benchmark]
    ranked = sorted(settings.items(), key=lambda item: pooled(item[1]))
    return [
        [benchmark, unit, *setting, f"{factor * pooled(folds):.4g}"]
        + [f"{factor * folds[k]:.4g}" if k in folds else "" for k in range(FOLDS)]
        for setting, folds in ranked
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="the folder of the study, e.g. results/benchmark_choice")
    parser.add_argument("--out", type=Path, default=REFERENCE)
    options = parser.parse_args()
    errors = held_out_errors(options.study)
    with (options.out / "choice.csv").open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        folds = [f"fold_{k}" for k in range(FOLDS)]
        writer.writerow(["benchmark", "unit", *SETTINGS, "held_out_rmse", *folds])
        for benchmark in BENCHMARKS:
            rows = rows_of(benchmark, errors[benchmark])
            writer.writerows(rows)
            print(*rows[:3], sep="\n")


if __name__ == "__main__":
    main()
