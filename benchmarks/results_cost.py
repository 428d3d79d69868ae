"""What the engine costs around the work: one model, 20 controller rates by 10 observer rates, 200 runs.

    python benchmarks/results_cost.py --experiment paper --jobs 2 --append results/reference/engine/cost.csv

Wall time of the whole command, imports and table included, against the time of its stages (training and data once, each
synthesis and each loop), spread over the jobs. The promise: at most 1.3. Then the same command with nothing to do.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from ssm_study.results.cost import stage_costs
from ssm_study.results.gather import gather

RATES = (
    "synthesis.rate_controller=" + ",".join(f"{0.02 * k:.2f}" for k in range(1, 21)),
    "synthesis.rate_observer=" + ",".join(f"{0.04 * k:.2f}" for k in range(1, 11)),
)


def seconds_of(results: Path, words: list[str]) -> float:
    begun = time.perf_counter()
    command = [sys.executable, "-m", "ssm_study.cli", "run", "-m", *words, *RATES, "study=s", f"results_dir={results}"]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return time.perf_counter() - begun


def measured(results: Path, experiment: str, jobs: int) -> dict[str, object]:
    words = [f"experiment={experiment}", f"hydra.launcher.n_jobs={jobs}"]
    load = os.getloadavg()[0]
    wall_s, again_s = seconds_of(results, words), seconds_of(results, words)
    costs = {cost.name: cost for cost in stage_costs(gather(results / "s"))}
    work_s = sum(cost.spent_s for cost in costs.values())
    each = {f"{name}_each_s": round(cost.spent_s / cost.computed, 3) for name, cost in costs.items()}
    once = {f"{name}_computed": cost.computed for name, cost in costs.items()}
    told = {"experiment": experiment, "jobs": jobs, "load_before": load, "wall_s": round(wall_s, 1)}
    told |= {"stages_s": round(work_s, 1), "ratio": round(wall_s / (work_s / jobs), 2), "again_s": round(again_s, 1)}
    return told | each | once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiment", default="paper")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--append", type=Path, help="add the line to this CSV table")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        row = pd.DataFrame([measured(Path(scratch), options.experiment, options.jobs)])
    print(row.T.to_string(header=False))
    if options.append:
        options.append.parent.mkdir(parents=True, exist_ok=True)
        known = [pd.read_csv(options.append)] if options.append.is_file() else []
        pd.concat([*known, row]).to_csv(options.append, index=False)


if __name__ == "__main__":
    main()
