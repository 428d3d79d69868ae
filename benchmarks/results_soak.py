"""Kill a study at random moments until it is finished, and compare it with one that nobody touched.

    python benchmarks/results_soak.py --kills 30 --damage --minutes 8 --table
    results/reference/engine/soak.csv
    python benchmarks/results_soak.py --sweeps 3 --minutes 5 --table
    results/reference/engine/soak.csv

The study trains real models (experiment=smoke). Each attempt is the same command. Somewhere in it
the sweep gets SIGKILL, SIGTERM or SIGINT, or one of its jobs SIGKILL: some while it starts, most
once its jobs are at work. With `--sweeps 3` three such commands work on the study at once, and one
of them is struck while the others go on. Between attempts a finished stage or record may in
addition be truncated or have a bit flipped (--damage). Whenever a study is finished: its table
equals the undisturbed one, every stage folder is intact, no process lives on. With `--in` the state
is kept and the same command goes on; after `--minutes` no kill follows. Edit nothing in the package
meanwhile: its stages would rightly be computed anew. So run it from a copy: git archive HEAD | tar
x -C DIR.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from ssm_study.engine.store import MANIFEST, read_intact_manifest
from ssm_study.table.gather import gather

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = [sys.executable, "-m", "ssm_study.cli", "run", "-m", "experiment=smoke"]
SWEEP = (
    "seed=0,1",
    "synthesis=riccati",
    "synthesis.rate_controller=0.1,0.2",
    "+training.checkpoint_every_s=0",
    "progress=false",
)
AT_WORK = 0.75  # of the kills wait until jobs are at work
# of the time the jobs took undisturbed: later hardly any is left to kill, and each attempt comes
# further
EARLY = 0.6
STUDY = "smoke"
STATE = "state.json"
COLUMNS = ["sweeps_at_once", "damage", "event", "count"]
# What a second attempt may change: when, where, how often.
VOLATILE = (
    "attempt",
    "ended_utc",
    "started_utc",
    "pid",
    "host",
    "seconds",
    "git_commit",
    "git_dirty",
    "threads",
)


def start(folder: Path) -> "subprocess.Popen[bytes]":
    folder.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    command = [*PROGRAM, *SWEEP, f"results_dir={folder / 'results'}"]
    log = (folder / "log").open("ab")
    variables = os.environ | {"PYTHONPATH": paths}
    return subprocess.Popen(
        command, env=variables, stdout=log, stderr=log, start_new_session=True, cwd=REPOSITORY
    )


def processes_of(folder: Path) -> list[int]:
    """Everything that names the folder in its command line or has its log open as output, ourselves
    excepted."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            names = (entry / "cmdline").read_bytes().decode(errors="replace") + str(
                (entry / "fd" / "1").readlink()
            )
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue
        if str(folder) in names and state != "Z" and int(entry.name) != os.getpid():
            found.append(int(entry.name))
    return found


def disturb(
    sweeps: "list[subprocess.Popen[bytes]]", folder: Path, rng: random.Random, done: "Soak"
) -> str:
    """Wait a random while, then kill something; what was killed, or `finished` if nothing was left
    to kill."""
    process = rng.choice(sweeps)
    if rng.random() < AT_WORK:
        until_at_work(process, folder)
        time.sleep(rng.uniform(0.0, EARLY * done.working_s))
    else:
        time.sleep(rng.uniform(0.0, done.longest_s - done.working_s))
    if all(sweep.poll() is not None for sweep in sweeps):
        return "finished"
    if process.poll() is not None:  # one that found all its runs with the others
        process = next(sweep for sweep in sweeps if sweep.poll() is None)
    target = rng.choice(
        ["sweep KILL", "sweep KILL", "sweep TERM", "sweep INT", "job KILL", "job KILL"]
    )
    if not target.startswith("job"):
        process.send_signal(getattr(signal, f"SIG{target.split()[1]}"))
    elif jobs := jobs_of(folder):
        os.kill(rng.choice(jobs), signal.SIGKILL)
    else:
        target = "nothing"
    for sweep in sweeps:
        sweep.wait(timeout=300)
    return target


def until_at_work(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    while process.poll() is None and not jobs_of(folder):
        time.sleep(0.05)


def jobs_of(folder: Path) -> list[int]:
    """The processes of jobs: those whose output is the log of a run."""
    logs = str(folder / "results" / STUDY)
    return [
        pid
        for pid in processes_of(folder)
        if str(readable_link(Path(f"/proc/{pid}/fd/1"))).startswith(logs)
    ]


def readable_link(path: Path) -> Path | None:
    try:
        return path.readlink()
    except OSError:
        return None


def damage(folder: Path, rng: random.Random) -> str:
    """Truncate a finished artefact or flip one bit of it."""
    results = folder / "results"
    files = [
        path
        for pattern in (".store/*/[!.]*/*", f"{STUDY}/*/record.json", f"{STUDY}/*/m*.json")
        for path in results.glob(pattern)
    ]
    files = [path for path in files if path.is_file() and path.stat().st_size]
    if not files:
        return "nothing"
    path, content = (chosen := rng.choice(files)), bytearray(chosen.read_bytes())
    if rng.random() < 0.5:
        path.write_bytes(content[: rng.randrange(len(content))])
        return "truncated"
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    return "flipped"


def stable_table(folder: Path) -> pd.DataFrame:
    table = gather(folder / "results" / STUDY)
    volatile = [
        str(name)
        for name in table
        if name in VOLATILE or str(name).endswith(("_seconds", "_reused"))
    ]
    return (
        table.drop(columns=volatile).dropna(axis=1, how="all").sort_values("run", ignore_index=True)
    )


def soak(folder: Path, kills: int, damages: bool, until: float, sweeps: int = 1) -> "Soak":
    """Kill until `kills` have been dealt and the study is finished; raises AssertionError if a
    promise is broken."""
    done = Soak.read(folder)
    undisturbed = folder / "undisturbed"
    if not done.longest_s:
        begun = time.monotonic()
        process = start(undisturbed)
        until_at_work(process, undisturbed)
        at_work = time.monotonic()
        assert process.wait(timeout=600) == 0
        done.longest_s = time.monotonic() - begun
        done.working_s = time.monotonic() - at_work
    while done.kills < kills and time.monotonic() < until:
        here = folder / f"round{done.rounds}"
        started = [start(here) for _ in range(sweeps)]
        rng = random.Random(done.counts.total())
        done.counts[what := disturb(started, here, rng, done)] += 1
        if what == "finished":
            assert [sweep.returncode for sweep in started] == [0] * sweeps
            check(here, undisturbed, damages)
            shutil.rmtree(here)
            done.longest_s = 0.8 * done.longest_s
            done.working_s = 0.8 * done.working_s  # too late: strike sooner
            done.rounds += 1
        elif damages and rng.random() < 0.3:
            done.counts[damage(here, rng)] += 1
        done.write(folder)
    if (folder / f"round{done.rounds}").is_dir():
        check(folder / f"round{done.rounds}", undisturbed, damages)
        done.rounds += 1
    return done


@dataclass
class Soak:
    """What has been dealt out so far; `longest_s` is how long the undisturbed study took,
    `working_s` its jobs."""

    counts: Counter[str]
    rounds: int = 0
    longest_s: float = 0.0
    working_s: float = 0.0

    @property
    def kills(self) -> int:
        return sum(
            number for what, number in self.counts.items() if what.startswith(("sweep", "job"))
        )

    @classmethod
    def read(cls, folder: Path) -> "Soak":
        state = folder / STATE
        known = json.loads(state.read_text()) if state.is_file() else {"counts": {}}
        return cls(**known | {"counts": Counter(known["counts"])})

    def write(self, folder: Path) -> None:
        (folder / STATE).write_text(json.dumps(vars(self)))

    def lines(self) -> list[str]:
        counts = [f"{what:<12}{number:>5}" for what, number in sorted(self.counts.items())]
        return [
            *counts,
            f"{'studies':<12}{self.rounds:>5}  finished: tables equal, stages intact, no "
            "process left",
        ]


def check(folder: Path, undisturbed: Path, harmed: bool) -> None:
    """The same command once more (it repairs what was damaged last), then everything is as if
    nothing had happened.

    A damaged stage that no run asks for any more stays as it is: it is noticed when it is asked
    for.
    """
    assert start(folder).wait(timeout=300) == 0
    pd.testing.assert_frame_equal(stable_table(folder), stable_table(undisturbed))
    for manifest in (folder / "results" / ".store").glob(f"[!.]*/[!.]*/{MANIFEST}"):
        assert harmed or read_intact_manifest(manifest.parent) is not None, manifest
    for run in (folder / "results" / STUDY).glob("order*"):
        assert read_intact_manifest(run) is not None, run
    deadline = time.monotonic() + 10
    while left := processes_of(folder):
        assert time.monotonic() < deadline, f"still alive: {left}"
        time.sleep(0.1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--damage", action="store_true")
    parser.add_argument("--in", dest="folder", type=Path)
    parser.add_argument("--sweeps", type=int, default=1)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--minutes", type=float, default=1e6)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.folder or Path(scratch)).absolute()
        until = time.monotonic() + 60 * options.minutes
        done = soak(folder, options.kills, options.damage, until, options.sweeps)
    print("\n".join(done.lines()))
    if options.table:
        written(options.table, (options.sweeps, options.damage), done)


def written(path: Path, form: tuple[int, bool], done: Soak) -> None:
    """The table, with the rows of this form made anew and those of others as they were."""
    counts = {**dict(sorted(done.counts.items())), "studies finished and equal": done.rounds}
    rows = pd.DataFrame([(*form, what, number) for what, number in counts.items()], columns=COLUMNS)
    others = pd.read_csv(path) if path.is_file() else rows[:0]
    others = others[(others.sweeps_at_once != form[0]) | (others.damage != form[1])]
    pd.concat([others, rows]).sort_values([*COLUMNS[:2]], kind="stable").to_csv(
        path, index=False, lineterminator="\n"
    )


if __name__ == "__main__":
    main()
