"""Our process server beside the standard library's forkserver: seconds a run, of a sweep, of a
training.

    python benchmarks/engine_server.py --table results/reference/engine/server.csv

Both serve the same sweeps of `tests/engine_study.py` (a toy: the engine and nothing else) and of
`experiment=smoke`. The rival is the best that the library allows: `set_forkserver_preload` names
this
module, which reads the jobs once from a file, imports what they need, freezes the collector and
sets
the allocator; a job is then sent its number alone. Processor seconds are those of the whole
command;
a run's share is the slope between two lengths of a sweep, a sweep's the rest. `left behind` counts
the processes that live three seconds after `kill -9` of a sweep whose job has started one.
"""

import argparse
import contextlib
import ctypes
import gc
import importlib
import multiprocessing
import multiprocessing.connection
import multiprocessing.forkserver
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ssm_study.engine import server as ours

REPOSITORY = Path(__file__).resolve().parents[1]
JOBS = "SSM_STUDY_JOBS"  # the file from which the forkserver reads them
SHORT = 40
LONG = 240


@dataclass
class StandardServer:
    """`ssm_study.engine.server.Server` by `multiprocessing`'s forkserver."""

    tasks: Sequence[Callable[[], object]]
    preload: Callable[[], object]
    threads: int
    children: dict[Any, Any] = field(default_factory=dict)
    context: Any = None
    folder: Any = None

    def fork(self, number: int) -> Any:
        if self.context is None:
            self.folder = tempfile.TemporaryDirectory()
            jobs = Path(self.folder.name) / "jobs"
            jobs.write_bytes(pickle.dumps((list(self.tasks), self.preload, self.threads)))
            os.environ[JOBS] = str(jobs)
            self.context = multiprocessing.get_context("forkserver")
            self.context.set_forkserver_preload([Path(__file__).stem])
        process = self.context.Process(target=do, args=(number,))
        process.start()
        child = ours.JobProcess(pid=process.pid, wait_for_job_end=self.wait_for_job_end)
        self.children[process.sentinel] = (process, child)
        return child

    def wait_for_job_end(self, timeout: float | None) -> None:
        for sentinel in multiprocessing.connection.wait(list(self.children), timeout):
            process, child = self.children.pop(sentinel)
            process.join()
            child.exitcode = process.exitcode

    def close(self) -> None:
        for process, _ in self.children.values():
            process.kill()
        multiprocessing.forkserver._forkserver._stop()  # type: ignore[attr-defined]  # waited for, so that its time counts


def do(number: int) -> None:
    """Work on a job, in its own process."""
    ctypes.CDLL(None).prctl(ours.PR_SET_PDEATHSIG, signal.SIGKILL)
    LOADED[0][number]()


LOADED: tuple[Any, ...] = ()
if __name__ == Path(__file__).stem and JOBS in os.environ:  # in the forkserver, not again in a job
    with Path(os.environ[JOBS]).open("rb") as stream:
        LOADED = pickle.load(stream)
    LOADED[1]()
    gc.freeze()
    ours._apply_memory_and_thread_limits(LOADED[2])
    if len(LOADED[0]) >= ours.MANY:
        ours._collapse_into_large_pages()


def command(server: str, study: str, runs: int, results: Path) -> list[str]:
    words = [f"results_dir={results}", "study=many"]
    if study == "toy":
        words += [f"seed={','.join(map(str, range(runs)))}"]
    elif study == "train":
        words += ["experiment=smoke", f"seed={','.join(map(str, range(runs)))}"]
    else:
        rates = ",".join(f"{0.3 * (k + 1) / runs:.6f}" for k in range(runs))
        words += ["experiment=smoke", "synthesis=riccati", f"synthesis.rate_controller={rates}"]
    return [sys.executable, __file__, "--serve", server, study, *words]


def serve(server: str, study: str, words: list[str]) -> None:
    """The command in this process, with one of the servers."""
    if server == "standard":
        module = importlib.import_module(
            Path(__file__).stem
        )  # its functions have a name in the server
        launcher: Any = importlib.import_module("ssm_study.engine.launcher")
        launcher.Server = module.StandardServer
    if study == "toy":
        sys.path.insert(0, str(REPOSITORY / "tests"))
        sys.argv = ["toy", "-m", *words]
        toy = importlib.import_module("engine_study")
        toy.main(toy.Badly(), toy.SETTINGS)
        return
    from ssm_study.cli.main import main

    sys.exit(main(["run", "-m", "progress=false", *words]))


def measure(server: str, study: str, runs: int) -> tuple[float, float]:
    """Wall and processor seconds of one sweep."""
    with tempfile.TemporaryDirectory() as scratch:
        environment = os.environ | {
            "PYTHONPATH": f"{REPOSITORY / 'benchmarks'}:{REPOSITORY / 'tests'}"
        }
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        begun = time.monotonic()
        ended = subprocess.run(
            command(server, study, runs, Path(scratch)),
            env=environment, capture_output=True, text=True,
        )  # fmt: skip
        assert ended.returncode == 0, ended.stderr[-3000:]
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        records = list(Path(scratch).glob("many/*/record.json"))
        good = sum('"status": "ok"' in path.read_text() for path in records)
        print(
            server, study, runs, "ok", good, ended.stderr[-300:] if good < runs else "", flush=True
        )
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - begun, used


def left_behind(server: str) -> int:
    """Processes that outlive the `kill -9` of a sweep whose job waits for one of its own."""
    with tempfile.TemporaryDirectory() as scratch:
        words = command(server, "toy", 1, Path(scratch))
        folders = f"{REPOSITORY / 'benchmarks'}:{REPOSITORY / 'tests'}"
        environment = os.environ | {"PYTHONPATH": folders}
        sweep = subprocess.Popen([*words, "do=wait,work"], env=environment, stderr=subprocess.PIPE)
        while not sleepers():
            time.sleep(0.1)
        sweep.kill()
        sweep.wait()
        time.sleep(3.0)
        left = sleepers()
        for process in left:
            os.kill(process, signal.SIGKILL)
        return len(left)


def sleepers() -> list[int]:
    """Processes that only the waiting jobs of `tests/engine_study.py` start."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"sleep\x0086399" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serve", nargs=argparse.REMAINDER)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--only", choices=["toy", "train", "smoke"])
    options = parser.parse_args()
    if options.serve:
        serve(options.serve[0], options.serve[1], options.serve[2:])
        return
    rows = ["study,server,runs,wall_seconds,processor_seconds"]
    for study, counts in (("toy", (SHORT, LONG)), ("train", (4,)), ("smoke", (10, 60))):
        for runs in counts if options.only in (None, study) else ():
            for server in ("own", "standard"):
                wall, used = measure(server, study, runs)
                rows.append(f"{study},{server},{runs},{wall:.2f},{used:.2f}")
                print(rows[-1], flush=True)
    for server in ("own", "standard"):
        rows.append(f"left behind,{server},{left_behind(server)},,")
        print(rows[-1], flush=True)
    if options.table:
        options.table.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
