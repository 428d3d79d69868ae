"""Kill a study at random moments until it is finished, and compare it with one that nobody touched.

    python benchmarks/results_soak.py --kills 60

Each attempt is the same command. Somewhere in it the sweep gets SIGKILL, SIGTERM or SIGINT, or one of its jobs SIGKILL.
Between attempts a finished stage or record may in addition be truncated or have a bit flipped (--damage).
At the end: the table equals the undisturbed one, every stage folder is intact, no process lives on.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pandas as pd

from ssm_study.results.gather import gather
from ssm_study.results.store import MANIFEST, intact_manifest

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = [sys.executable, str(REPOSITORY / "tests" / "engine_study.py"), "-m"]
SWEEP = ("seed=range(4)", "rate=range(4)", "work_s=0.05", "hydra.launcher.preload=[ssm_study.results.store]")
# What a second attempt may change: when, where, how often.
VOLATILE = ("attempt", "ended_utc", "started_utc", "pid", "host", "seconds", "git_commit", "git_dirty", "threads")


def start(folder: Path) -> "subprocess.Popen[bytes]":
    (folder / "conf").mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    variables = os.environ | {"ENGINE_CONF": str(folder / "conf"), "PYTHONPATH": paths, "HYDRA_FULL_ERROR": "1"}
    command = [*PROGRAM, f"results_dir={folder / 'results'}", *SWEEP]
    log = (folder / "log").open("ab")
    return subprocess.Popen(command, env=variables, stdout=log, stderr=log, start_new_session=True)


def processes_of(folder: Path) -> list[int]:
    """Everything that names the folder in its command line or has its log open as output, ourselves excepted."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            names = (entry / "cmdline").read_bytes().decode(errors="replace") + str((entry / "fd" / "1").readlink())
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue
        if str(folder) in names and state != "Z" and int(entry.name) != os.getpid():
            found.append(int(entry.name))
    return found


def disturb(process: "subprocess.Popen[bytes]", folder: Path, rng: random.Random, longest_s: float) -> str:
    """Wait a random while, then kill something; what was killed, or `finished` if nothing was left to kill."""
    time.sleep(rng.uniform(0.0, longest_s))
    if process.poll() is not None:
        return "finished"
    target = rng.choice(["sweep KILL", "sweep KILL", "sweep TERM", "sweep INT", "job KILL", "job KILL"])
    if target.startswith("job"):
        jobs = [pid for pid in processes_of(folder / "results") if pid != process.pid]
        if not jobs:
            return "nothing"
        os.kill(rng.choice(jobs), signal.SIGKILL)
        process.wait(timeout=120)
    else:
        process.send_signal(getattr(signal, f"SIG{target.split()[1]}"))
        process.wait(timeout=60)
    return target


def damage(folder: Path, rng: random.Random) -> str:
    """Truncate a finished artefact or flip one bit of it."""
    results = folder / "results"
    files = [
        path
        for pattern in (".store/*/[!.]*/*", "study/*/record.json", "study/*/m*.json")
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
    table = gather(folder / "results" / "study")
    volatile = [name for name in table if name in VOLATILE or name.endswith(("_seconds", "_reused"))]
    return table.drop(columns=volatile).dropna(axis=1, how="all").sort_values("run", ignore_index=True)


def soak(folder: Path, kills: int, seed: int, damages: bool) -> Counter[str]:
    """Kill until `kills` have been dealt and the study is finished; raises AssertionError if a promise is broken."""
    rng, dealt = random.Random(seed), Counter[str]()
    undisturbed = folder / "undisturbed"
    begun = time.monotonic()
    assert start(undisturbed).wait(timeout=300) == 0
    longest_s = 1.1 * (time.monotonic() - begun)
    while dealt.total() - dealt["finished"] - dealt["nothing"] < kills:
        round_folder = folder / f"round{dealt['finished']}"
        process = start(round_folder)
        dealt[disturb(process, round_folder, rng, longest_s)] += 1
        if damages and rng.random() < 0.3:
            dealt[damage(round_folder, rng)] += 1
        if dealt["finished"] > len(list(folder.glob("checked*"))):
            check(round_folder, undisturbed, damages)
            (folder / f"checked{dealt['finished']}").touch()
    last = folder / f"round{dealt['finished']}"
    assert start(last).wait(timeout=300) == 0
    check(last, undisturbed, damages)
    return dealt


def check(folder: Path, undisturbed: Path, harmed: bool) -> None:
    """The same command once more (it repairs what was damaged last), then everything is as if nothing had happened.

    A damaged stage that no run asks for any more stays as it is: it is noticed when it is asked for.
    """
    assert start(folder).wait(timeout=300) == 0
    pd.testing.assert_frame_equal(stable_table(folder), stable_table(undisturbed))
    for manifest in (folder / "results" / ".store").glob(f"[!.]*/[!.]*/{MANIFEST}"):
        assert harmed or intact_manifest(manifest.parent) is not None, manifest
    for run in (folder / "results" / "study").glob("seed*"):
        assert intact_manifest(run) is not None, run
    deadline = time.monotonic() + 10
    while left := processes_of(folder):
        assert time.monotonic() < deadline, f"still alive: {left}"
        time.sleep(0.1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--damage", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        begun = time.monotonic()
        dealt = soak(Path(scratch), options.kills, options.seed, options.damage)
        print(f"{dict(dealt)} in {time.monotonic() - begun:.0f} s: tables equal, stages intact, no process left")


if __name__ == "__main__":
    main()
