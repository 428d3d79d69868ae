"""Small studies where a machine is hostile: what happened, and whether the study could be finished.

    python benchmarks/engine_hostile.py --table results/reference/engine/hostile.csv

The study is `experiment=smoke` with two seeds: real training, two jobs at a time; with `--toy` the
engine alone, on stages that compute nothing (the last two cases need a study). Each case
disturbs it in one way. It holds if no run is silently wrong: what was disturbed ends in one
sentence or in failed runs, and the same command finishes the study once the disturbance is over;
every run of it then passes `ssm-study verify`. The cases of a full disk, of a disk that may only be
read, and of two users need root; `faketime` sets the clock back. A case that the machine does not
allow is a row "not tried".
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import ROOT, write

from ssm_study.engine.records import read_record
from ssm_study.engine.store import read_intact_manifest

SSM_STUDY = (sys.executable, "-m", "ssm_study.cli")
WORDS = (
    "-m",
    "experiment=smoke",
    "seed=0,1",
    "synthesis=riccati",
    "synthesis.rate_controller=0.1",
    "+data.trials=false",
    "progress=false",
)
SWEEP = [*SSM_STUDY, "run", *WORDS]
TOY = [sys.executable, str(ROOT / "tests" / "engine_study.py"), "-m", "seed=0,1"]
SMALL_FILE = 4096  # bytes: smaller than a record
SMALL_DISK = "20k"  # smaller than a study
USERS = (61001, 61002)
FROM_PYTHON = """
import asyncio, multiprocessing, sys
import numpy as np
import ssm_study as st

def study():
    return st.study(*sys.argv[2:])

async def in_a_loop():
    table = study()
    u = np.random.default_rng(0).normal(size=400)
    y = np.convolve(u, 0.2 * 0.8 ** np.arange(40))[:400]
    model = st.fit(u, y, 0.1, "training.max_epochs=2", model="ssm", order=2, progress=False)
    assert np.isfinite(model.predict(u)).all()
    return table

if __name__ == "__main__":
    if sys.argv[1] == "spawn":
        multiprocessing.set_start_method("spawn")
        table = study()
    else:
        table = asyncio.run(in_a_loop())
    print(table["status"].to_list())
"""


class NotTried(Exception):
    """The machine does not allow this case."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Folder of results in which one case happens."""

    folder: Path
    study: str = "hostile"

    def words(self) -> list[str]:
        return [f"results_dir={self.folder}", f"study={self.study}"]

    def sweep(self, *words: str, before: tuple[str, ...] = (), **how: Any) -> "Answer":
        return answer([*before, *SWEEP, *self.words(), *words], **how)

    def start(self) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(
            [*SWEEP, *self.words()], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def runs(self) -> list[Path]:
        return sorted(path.parent for path in (self.folder / self.study).glob("*/record.json"))

    def statuses(self) -> str:
        found = Counter(str((read_record(run) or {}).get("status")) for run in self.runs())
        return ", ".join(f"{count} {name}" for name, count in sorted(found.items())) or "no run"

    def is_finished(self) -> bool:
        """Both runs are ok, and every claim of theirs holds."""
        if self.statuses() != "2 ok":
            return False
        if SWEEP == TOY:
            return all(read_intact_manifest(run) is not None for run in self.runs())
        return all(answer([*SSM_STUDY, "verify", str(run)]).status == 0 for run in self.runs())

    def files_of_the_store(self) -> list[Path]:
        suffix = "number.json" if SWEEP == TOY else "*.mcap"
        return sorted(path for path in (self.folder / ".store").rglob(suffix) if path.is_file())


@dataclass(frozen=True, kw_only=True)
class Answer:
    """How a command ended, and the last line that it printed."""

    status: int
    last_line: str
    has_traceback: bool

    def __str__(self) -> str:
        traceback = ", a traceback" if self.has_traceback else ""
        return f"exit status {self.status}{traceback}"


def answer(command: list[str], **how: Any) -> Answer:
    ended = subprocess.run(command, cwd=how.pop("cwd", ROOT), capture_output=True, text=True, **how)
    printed = (ended.stdout + ended.stderr).strip().splitlines() or [""]
    return Answer(
        status=ended.returncode,
        last_line=printed[-1],
        has_traceback="Traceback (most recent call last)" in ended.stdout + ended.stderr,
    )


@contextmanager
def mounted(folder: Path, size: str) -> Iterator[None]:
    folder.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if answer(command).status != 0:
        raise NotTried("mounting needs root")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def mount_again(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True)


def then_again(place: Place, first: Answer) -> tuple[str, bool]:
    """The same command after the disturbance, which must finish the study."""
    disturbed = place.statuses()
    again = place.sweep()
    finished = place.is_finished()
    seen = f"{first}: {disturbed}; the same command: {again}, {place.statuses()}"
    # A program of the engine alone lets an exception of the disk through; the command does not.
    is_sentence = SWEEP == TOY or not first.has_traceback
    return seen, finished and is_sentence and again.status == 0


def full_disk(place: Place) -> tuple[str, bool]:
    with mounted(place.folder, SMALL_DISK):
        first = place.sweep()
        mount_again(place.folder, "size=200m")
        return then_again(place, first)


def quota(place: Place) -> tuple[str, bool]:
    """No process of the study may write a longer file: write(2) fails as under a quota."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (SMALL_FILE, SMALL_FILE))

    return then_again(place, place.sweep(preexec_fn=limit))


def read_only(place: Place) -> tuple[str, bool]:
    with mounted(place.folder, "200m"):
        mount_again(place.folder, "ro")
        first = place.sweep()
        mount_again(place.folder, "rw")
        return then_again(place, first)


def two_users(place: Place) -> tuple[str, bool]:
    """The second finds results of the first that it may not read."""
    if os.geteuid() != 0:
        raise NotTried("other users need root")
    place.folder.mkdir()
    place.folder.chmod(0o1777)
    how = [as_user(user, place.folder.parent) for user in USERS]
    first = place.sweep(before=(), **how[0])
    second = place.sweep(**how[1])
    own = Place(folder=place.folder, study="own")
    third = own.sweep(**how[1])
    seen = (
        f"the first user: {first}, {place.statuses()}; the second, same study: {second}; "
        f"same folder, own study: {third}, {own.statuses()}"
    )
    answers = (first, second, third)
    answers_are_sentences = SWEEP == TOY or not any(one.has_traceback for one in answers)
    return f"{seen} ({second.last_line[:120]})", place.is_finished() and answers_are_sentences


def as_user(user: int, folder: Path) -> dict[str, Any]:
    """Arguments of a process of another user, whose files nobody else may read."""
    home = folder / f"home{user}"
    home.mkdir()
    os.chown(home, user, user)
    paths = os.pathsep.join([str(ROOT), sysconfig.get_path("purelib")])
    variables = {"HOME": str(home), "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    return {
        "user": user,
        "group": user,
        "extra_groups": [],
        "umask": 0o077,
        "env": os.environ | variables,
        "executable": python_for_everyone(user),
    }


def python_for_everyone(user: int) -> str:
    """A Python of this version that other users may run: ours may lie in a home."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for python in (os.path.realpath(sys.executable), f"/usr/bin/{version}"):
        with suppress(PermissionError):
            if answer([python, "-c", ""], cwd="/", user=user, group=user).status == 0:
                return python
    raise NotTried("no Python of this version that other users may run")


def clock_set_back(place: Place) -> tuple[str, bool]:
    if shutil.which("faketime") is None:
        raise NotTried("faketime is not installed")
    first = place.sweep("seed=0")
    second = place.sweep(before=("faketime", "-f", "-400d"))
    statuses = place.statuses()
    third = place.sweep()
    seen = f"one run; 400 days earlier both: {second}, {statuses}; today: {third}"
    ended_well = [one.status for one in (first, second, third)] == [0, 0, 0]
    return seen, ended_well and place.is_finished()


def store_removed(place: Place) -> tuple[str, bool]:
    """The store disappears while two sweeps, of one study each, are at work."""
    other = Place(folder=place.folder, study="other")
    sweeps = [place.start(), other.start()]
    while not place.files_of_the_store() and any(one.poll() is None for one in sweeps):
        time.sleep(0.05)
    shutil.rmtree(place.folder / ".store", ignore_errors=True)
    statuses = [one.wait() for one in sweeps]
    disturbed = f"{place.statuses()} and {other.statuses()}"
    again = [place.sweep(), other.sweep()]
    seen = (
        f"exit status {statuses[0]} and {statuses[1]}: {disturbed}; the same commands: "
        f"{place.statuses()} and {other.statuses()}"
    )
    answers = all(one.status == 0 for one in again)
    return seen, answers and place.is_finished() and other.is_finished()


def flipped_bits(place: Place) -> tuple[str, bool]:
    """One bit of every recording in the store; another study would use them again."""
    place.sweep()
    shutil.rmtree(place.folder / place.study)
    files = place.files_of_the_store()
    for path in files:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(bytes(content))
    again = place.sweep()
    aside = len(list((place.folder / ".store" / ".corrupt").iterdir()))
    seen = f"{len(files)} files, {aside} stages put aside and computed again: {place.statuses()}"
    return seen, again.status == 0 and aside > 0 and place.is_finished()


def edited_in_place(place: Place) -> tuple[str, bool]:
    """A run's file is a hard link to the store's: an edit changes both."""
    place.sweep()
    model = place.runs()[0] / "model.json"
    links = model.stat().st_nlink
    with model.open("r+") as stream:
        stream.write(" ")
    is_named = answer([*SSM_STUDY, "verify", str(model.parent)]).status == 1
    shutil.rmtree(model.parent)
    again = place.sweep()
    seen = (
        f"{links} links; verify {'names' if is_named else 'misses'} it; the run removed, the same "
        f"command: {again}, {place.statuses()}"
    )
    return seen, is_named and place.is_finished()


def long_names(place: Place) -> tuple[str, bool]:
    """255 characters, the longest that a file system takes, as study and as folder."""
    study = place.sweep(f"study={'x' * 255}")
    folder = Place(folder=place.folder / ("x" * 255))
    beside = folder.sweep()
    seen = f"as study: {study} ({study.last_line[-60:]}); as folder: {beside}, {folder.statuses()}"
    refused = study.status == 2 and not study.has_traceback
    return seen, refused and (folder.is_finished() or beside.status == 2)


def from_python(place: Place, how: str) -> tuple[str, bool]:
    script = place.folder.parent / "script.py"
    script.write_text(FROM_PYTHON)
    ended = answer([sys.executable, str(script), how, *WORDS, *place.words()])
    return f"{ended}: {place.statuses()}", ended.status == 0 and place.is_finished()


CASES: dict[str, Callable[[Place], tuple[str, bool]]] = {
    f"disk of {SMALL_DISK}B": full_disk,
    f"no file above {SMALL_FILE} bytes": quota,
    "read-only results": read_only,
    "two users, umask 077": two_users,
    "clock set back": clock_set_back,
    "store removed under two studies": store_removed,
    "bits flipped in the store": flipped_bits,
    "file of a run edited in place": edited_in_place,
    "names of 255 characters": long_names,
    "start method spawn": lambda place: from_python(place, "spawn"),
    "within a running event loop": lambda place: from_python(place, "loop"),
}


def case_row(name: str) -> dict[str, object]:
    """One case in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="hostile-") as scratch:
        Path(scratch).chmod(0o755)
        place = Place(folder=Path(scratch) / "results")
        try:
            seen, holds = CASES[name](place)
        except NotTried as reason:
            return {"case": name, "holds": "not tried", "seen": str(reason)}
    row = {"case": name, "holds": holds, "seen": seen.replace(scratch, "...")}
    print(f"{name}: {'holds' if holds else 'DOES NOT HOLD'}: {row['seen']}", flush=True)
    return row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--toy", action="store_true", help="stages that compute nothing instead")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    if options.toy:
        SWEEP[:] = TOY
    rows = [case_row(name) for name in options.only]
    if options.table:
        write(options.table, rows)
    return 0 if all(row["holds"] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
