"""Our certified model on the benchmarks' official test records, beside the published scores.

    python benchmarks/plants_scores.py [--seeds 3] [--results-dir FOLDER]

runs `experiment=benchmark_emps`, `benchmark_ced` and `benchmark_cascaded_tanks` for each seed, takes on each record the
seed whose model fits its training record best (never the test record), scores it, and writes
`results/reference/benchmarks/scores.csv` (ours above the published rows) and `scores_by_seed.csv` (every run).
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from ssm_study.data.scores import benchmark_rmse
from ssm_study.models.free_run import free_run
from ssm_study.models.identified import SSM

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "results" / "reference" / "benchmarks"
EXPERIMENTS = {
    "benchmark_emps": ("emps_mm",),
    "benchmark_cascaded_tanks": ("cascaded_tanks_v",),
    "benchmark_ced": ("ced_low_ticks_per_s", "ced_high_ticks_per_s"),
}
COLUMNS = [column for columns in EXPERIMENTS.values() for column in columns]


def run_one(experiment: str, seed: int, results: Path) -> Path:
    """The run folder of one finished study run."""
    command = [sys.executable, "-m", "ssm_study.cli", "run", f"experiment={experiment}", f"seed={seed}",
               f"results_dir={results}", f"study={experiment}_{seed}", "progress=false"]  # fmt: skip
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{finished.stderr}")
    return next((results / f"{experiment}_{seed}").glob("*/record.json")).parent


def scored(experiment: str, run: Path) -> list[float]:
    """The benchmark's own figures, recomputed from the stored model and the records."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        source = instantiate(compose("study", overrides=[f"experiment={experiment}"]).data, _convert_="all")
    data, model = source.build(0), SSM.from_json(json.loads((run / "model.json").read_text()))
    return list(benchmark_rmse(data, tuple(free_run(model, r, data.start_up_samples) for r in data.test)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--results-dir", type=Path, default=None)
    options = parser.parse_args()
    results = options.results_dir or Path(tempfile.mkdtemp(prefix="benchmark_scores_"))
    every: list[dict[str, Any]] = []
    for experiment, columns in EXPERIMENTS.items():
        for seed in range(options.seeds):
            run = run_one(experiment, seed, results.resolve())
            record = json.loads((run / "record.json").read_text())
            row = {"experiment": experiment, "seed": seed, "fit_train_percent": record["fit_train_percent"],
                   "controller_certified": record["controller_certified"],
                   "observer_certified": record["observer_certified"]}  # fmt: skip
            row |= dict(zip(columns, scored(experiment, run), strict=True))
            every.append(row)
            print(row, flush=True)
    write(every)
    print((OUT / "scores.csv").read_text())


def write(every: list[dict[str, Any]]) -> None:
    chosen: dict[str, str] = {}
    for experiment, columns in EXPERIMENTS.items():
        best = max((r for r in every if r["experiment"] == experiment), key=lambda r: r["fit_train_percent"])
        chosen |= {column: f"{best[column]:.3g}" for column in columns}
        chosen[experiment] = str(bool(best["controller_certified"] and best["observer_certified"])).lower()
    certified = ", ".join(f"{name.removeprefix('benchmark_')} {chosen[name]}" for name in EXPERIMENTS)
    ours = {
        "model": "SSM of this project, one layer, certified",
        "source": f"this table; both certificates: {certified}",
    }
    with (OUT / "published.csv").open(newline="") as stream:
        published = list(csv.DictReader(stream))
    with (OUT / "scores.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["model", *COLUMNS, "source"], lineterminator="\n")
        writer.writeheader()
        writer.writerow(ours | {column: chosen[column] for column in COLUMNS})
        writer.writerows(published)
    with (OUT / "scores_by_seed.csv").open("w", newline="") as stream:
        names = ["experiment", "seed", "fit_train_percent", "controller_certified", "observer_certified", *COLUMNS]
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in every)


if __name__ == "__main__":
    main()
