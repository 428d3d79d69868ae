"""Our certified model, our runs of the baselines and the published scores on the official test
records: one table.

    ssm-study run -m experiment=benchmarks
    python benchmarks/plants_scores.py results/benchmarks [--out FOLDER]

takes on each record, for each model, the seed whose model fits its training record best (never the
test record), and writes `scores.csv` (ours, our baselines, the published rows of `published.csv`)
and `scores_by_run.csv` (every run). Runs of further seeds in the same study count: `ssm-study run
-m experiment=benchmarks model=ssm seed=1,2`. Runs of structured models go to
`structured_by_seed.csv`, and their medians and ranges over the seeds are printed: `ssm-study run -m
experiment=benchmarks data=cascaded_tanks,ced model=structured seed=0,1,2,3,4`.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from common import REFERENCE, rows_of, write
from omegaconf import OmegaConf

FOLDER = REFERENCE / "benchmarks"
COLUMNS = {
    "emps": ("emps_mm",),
    "cascaded_tanks": ("cascaded_tanks_v",),
    "ced": ("ced_low_ticks_per_s", "ced_high_ticks_per_s"),
}
SCORES = [column for columns in COLUMNS.values() for column in columns]
MEAN = "_mean"  # behind the name of a score: of the mean of several models (`model.members`)
SILVERBOX = {
    "silverbox": tuple(
        f"silverbox_{part}_mv" for part in ("multisine", "arrow", "no_extrapolation")
    )
}
MODELS = {
    "ssm": "SSM of this project, one layer, certified",
    "linear": "linear state space, our run",
    "n4sid": "N4SID, our run",
    "narx": "polynomial NARX, our run",
    "gru": "GRU, our run",
    "lstm": "LSTM, our run",
}
# epochs of conf/training/default.yaml, of every model; a run with fewer is said to be cut short
FULL_BUDGET = 60
TOLD = ["benchmark", "model", "seed", "status", "fit_train_percent", "epochs_allowed",
        "training_seconds",
        "training_ended", "controller_certified", "observer_certified"]  # fmt: skip


def every_run(study: Path) -> list[dict[str, Any]]:
    """What each run of the study was asked and what it scored; failed ones with their sentence."""
    return [run_of(path.parent) for path in sorted(study.glob("*/record.json"))]


def run_of(folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((folder / "record.json").read_text())
    config = OmegaConf.load(folder / ".hydra" / "config.yaml")
    asked = dict(
        str(word).split("=", 1) for word in OmegaConf.load(folder / ".hydra" / "overrides.yaml")
    )
    benchmark = str(config.data.benchmark)
    columns = (COLUMNS | SILVERBOX)[benchmark]
    scores = {name: record.get(f"score_test_{i + 1}") for i, name in enumerate(columns)}
    for number, name in enumerate(columns, start=1):
        scores[name + MEAN] = record.get(f"score_members_{number}")
    known = {
        "benchmark": benchmark,
        "model": asked.get("model", "ssm"),
        "epochs_allowed": config.training.max_epochs,
    }
    return record | known | scores


def row_of(model: str, runs: list[dict[str, Any]]) -> dict[str, str]:
    """The line of one model: its best-fitting seed on each record, or why there is none."""
    row = {"model": MODELS[model]}
    notes = []
    for benchmark, columns in COLUMNS.items():
        ours = [run for run in runs if (run["model"], run["benchmark"]) == (model, benchmark)]
        scored = [run for run in ours if isinstance(run.get(columns[0]), float)]
        if not scored:
            notes.append(f"{benchmark} {why_not(ours[0]) if ours else 'not run'}")
            continue
        best = max(scored, key=lambda run: run["fit_train_percent"])
        row |= {column: f"{best[column]:.3g}" for column in columns}
        if best["epochs_allowed"] < FULL_BUDGET:
            notes.append(f"{benchmark} cut to {best['epochs_allowed']} epochs")
        if model == "ssm":
            is_certified = best["controller_certified"] and best["observer_certified"]
            notes.append(f"{benchmark} {str(is_certified).lower()}")
    said = "both certificates: " if model == "ssm" else ""
    return row | {
        "source": "; ".join(["this table", said + ", ".join(notes)] if notes else ["this table"])
    }


def why_not(run: dict[str, Any]) -> str:
    """Why a run has no score: it overflowed, or what it said when it failed."""
    said = str(run.get("error_message", run["status"]))
    diverged = run.get("fit_train_percent") == "-inf" or said.endswith("-inf")
    return "diverges in free run" if diverged else said


def write_structured(out: Path, runs: list[dict[str, Any]]) -> None:
    """Every seed of the structured models, and what the seeds make of each score."""
    columns = [*SCORES, *SILVERBOX["silverbox"], *(name + MEAN for name in COLUMNS["ced"])]
    write_table(out / "structured_by_seed.csv", [*TOLD, *columns], runs)
    for column in columns:
        if seen := sorted(run[column] for run in runs if isinstance(run.get(column), float)):
            told = f"median {np.median(seen):.3g}, {seen[0]:.3g} to {seen[-1]:.3g}"
            print(f"{column}, {len(seen)} seeds: {told}")


def write_table(path: Path, columns: list[str], rows: list[dict[str, Any]]) -> None:
    told = [{k: row[k] for k in columns if k in row} for row in rows]
    write(
        path,
        [{k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in told],
        columns,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, help="the folder of the study, e.g. results/benchmarks")
    parser.add_argument("--out", type=Path, default=FOLDER)
    options = parser.parse_args()
    found = every_run(options.study)
    structured = [run for run in found if run["model"] == "structured"]
    if structured:
        write_structured(
            options.out, sorted(structured, key=lambda run: (run["benchmark"], run["seed"]))
        )
    runs = [run for run in found if run["model"] != "structured"]
    runs.sort(key=lambda run: (run["benchmark"], [*MODELS].index(run["model"]), run["seed"]))
    if structured and not runs:
        return
    if not runs:
        raise SystemExit(
            f"{options.study} holds no runs; make them with: ssm-study run -m experiment=benchmarks"
        )
    published = rows_of(FOLDER / "published.csv")
    rows = [row_of(model, runs) for model in MODELS]
    write_table(options.out / "scores.csv", ["model", *SCORES, "source"], [*rows, *published])
    write_table(options.out / "scores_by_run.csv", [*TOLD, *SCORES], runs)
    print((options.out / "scores.csv").read_text())


if __name__ == "__main__":
    main()
