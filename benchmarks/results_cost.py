"""What the engine costs around the work: one model, 20 controller rates by 10 observer rates, 200
runs.

    python benchmarks/results_cost.py --jobs 2 --append results/reference/engine/cost.csv

The whole command, imports, checks, records and table included, against its stages (training and
data once, each synthesis, each loop). The promise: at most 1.3. Twice: in wall time on `--jobs`
processes, and in processor time of all processes together (a control group counts it; root), which
other work on the machine hardly touches.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pandas as pd

from ssm_study.engine.store import MANIFEST

ACCOUNTS = Path("/sys/fs/cgroup/cpuacct")


def swept(folder: Path, words: list[str], group: Path | None) -> tuple[float, float | None]:
    """Wall and processor seconds of one command with all its processes."""
    command = [
        sys.executable,
        "-m",
        "ssm_study.cli",
        "run",
        "-m",
        *words,
        "study=s",
        f"results_dir={folder}",
    ]
    if group:
        command = ["sh", "-c", 'echo $$ >"$0/cgroup.procs"; exec "$@"', str(group), *command]
    before = processor_seconds(group)
    begun = time.perf_counter()
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    after = processor_seconds(group)
    return time.perf_counter() - begun, None if before is None or after is None else after - before


def processor_seconds(group: Path | None) -> float | None:
    return int((group / "cpuacct.usage").read_text()) * 1e-9 if group else None


@contextmanager
def accounts() -> Iterator[Path | None]:
    group = ACCOUNTS / f"ssm-study-{os.getpid()}"
    try:
        group.mkdir()
    except OSError:
        yield None
        return
    yield group
    with suppress(OSError):  # the server may take a moment to leave
        group.rmdir()


def measured(folder: Path, experiment: str, observers: int, jobs: int) -> dict[str, object]:
    rates = [
        ",".join(f"{step * k:.2f}" for k in range(1, n + 1))
        for step, n in ((0.02, 20), (0.04, observers))
    ]
    words = [
        f"synthesis.rate_{side}={asked}"
        for side, asked in zip(("controller", "observer"), rates, strict=True)
    ]
    words += [f"experiment={experiment}", f"hydra.launcher.n_jobs={jobs}"]
    load = os.getloadavg()[0]
    with accounts() as group:
        wall_s, processor_s = swept(folder, words, group)
    notes = [
        json.loads(path.read_bytes())
        for path in (folder / ".store").glob(f"[!.]*/[!.]*/{MANIFEST}")
    ]
    stages_s, worked_s = (
        sum(note[kind] for note in notes) for kind in ("seconds", "processor_seconds")
    )
    columns = (folder / ".store").glob("[!.]*/[!.]*.json")  # measuring is the study's work as well
    worked_s += sum(json.loads(path.read_bytes())["processor_seconds"] for path in columns)
    told: dict[str, object] = {
        "experiment": experiment,
        "runs": 20 * observers,
        "jobs": jobs,
        "load_before": load,
    }
    told |= {"wall_s": wall_s, "stages_wall_s": stages_s, "wall_ratio": wall_s / (stages_s / jobs)}
    told |= {"processor_s": processor_s, "stages_processor_s": worked_s}
    told |= {"processor_ratio": processor_s / worked_s if processor_s else None}
    return told | {
        f"{name}_computed": n for name, n in Counter(note["stage"] for note in notes).items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--experiment", default="smoke")
    parser.add_argument("--observers", type=int, default=10, help="how many observer rates")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--append", type=Path, help="add the line to this CSV table")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        row = pd.DataFrame(
            [measured(Path(scratch), options.experiment, options.observers, options.jobs)]
        )
    print(row.T.to_string(header=False))
    if options.append:
        options.append.parent.mkdir(parents=True, exist_ok=True)
        known = [pd.read_csv(options.append)] if options.append.is_file() else []
        pd.concat([*known, row]).to_csv(options.append, index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
