"""Many runs end to end: wall seconds per run along the sweep, processor time, bytes and inodes of
each run.

    python benchmarks/results_many.py --runs 2000 --table results/reference/engine/many_runs_toy.csv
    python benchmarks/results_many.py --runs 60 --smoke --table
    results/reference/engine/many_runs_smoke.csv

The toy (`tests/engine_study.py`: two stages of one number each) is the engine and nothing else.
With `--smoke` the runs are those of `experiment=smoke`, one model and as many controller rates:
each adds its own synthesis and loop.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
BLOCKS = 10


def command(folder: Path, runs: int, smoke: bool) -> list[str]:
    place = ["study=many", f"results_dir={folder / 'results'}"]
    if smoke:
        rates = ",".join(f"{0.3 * (k + 1) / runs:.6f}" for k in range(runs))
        words = [
            "experiment=smoke",
            "synthesis=riccati",
            f"synthesis.rate_controller={rates}",
            "progress=false",
        ]
        return [sys.executable, "-m", "ssm_study.cli", "run", "-m", *words, *place]
    seeds = ",".join(map(str, range(runs)))
    return [
        sys.executable,
        str(REPOSITORY / "tests" / "engine_study.py"),
        "-m",
        f"seed={seeds}",
        *place,
    ]


def along(study: Path, begun: float) -> list[tuple[str, float]]:
    """Seconds per run in each tenth of the sweep, by when the records were written."""
    ended = sorted(path.stat().st_mtime for path in study.glob("*/record.json"))
    edges = [round(k * len(ended) / BLOCKS) for k in range(BLOCKS + 1)]
    times = [begun, *ended]
    return [
        (f"seconds per run, runs {low + 1} to {high}", (times[high] - times[low]) / (high - low))
        for low, high in pairwise(edges)
        if high > low
    ]


def sizes(results: Path, runs: int) -> list[tuple[str, float]]:
    """Per run, of the study and of the store with it; a file with several names counts once."""
    found = []
    for name, folders in (("study", [results / "many"]), ("study and store", [results])):
        facts = {
            s.st_ino: s.st_blocks * 512
            for folder in folders
            for p in folder.rglob("*")
            for s in [p.lstat()]
        }
        found += [
            (f"inodes per run, {name}", len(facts) / runs),
            (f"bytes per run, {name}", sum(facts.values()) / runs),
        ]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    load = Path("/proc/loadavg").read_text().split()[0]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        begun = time.time()
        ended = subprocess.run(
            command(folder, options.runs, options.smoke), cwd=folder, capture_output=True, text=True
        )
        wall = time.time() - begun
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert ended.returncode == 0, ended.stderr[-2000:]
        rows = [("load before", float(load)), ("runs", options.runs), ("wall seconds", wall)]
        rows += [("processor seconds", used.ru_utime + used.ru_stime)]
        rows += [
            *along(folder / "results" / "many", begun),
            *sizes(folder / "results", options.runs),
        ]
    text = "\n".join(["what,value", *(f'"{what}",{value:.5g}' for what, value in rows)])
    print(text)
    if options.table:
        options.table.write_text(text + "\n")


if __name__ == "__main__":
    main()
