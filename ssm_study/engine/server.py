"""Server process from which the jobs of a sweep are forked. It is itself forked from the sweep, so
it has all libraries and configurations loaded.

So a job starts at once, and nothing is sent to it. The server also ends every job that would
outlive the sweep.
"""

import contextlib
import ctypes
import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import NoReturn

from ssm_study.refusal import BadRequest

# For mallopt: thresholds of mmap and trim, padding. Large tensors then stay in the process instead
# of going back to the system at every step: 1.6-2.2 times faster.
ALLOCATOR = ((-3, 2**31 - 1), (-1, 2**31 - 1), (-2, 64 << 20))
PR_SET_PDEATHSIG = 1
MADV_COLLAPSE = 25
LARGE_PAGE = 2 << 20
MANY = 40  # bytes; jobs from which on large pages pay
# No exit status of a process is 1000, and no process has the number 0.
SERVER_DIED = 1000
UNBORN = 0


@dataclass
class JobProcess:
    """Process of one job of a sweep, with its exit status once it has ended. `exitcode` is None
    while it runs, and minus the number of the signal if one killed it."""

    pid: int
    wait_for_job_end: Callable[[float | None], object]
    exitcode: int | None = None

    def join(self, timeout: float | None = None) -> None:
        """Wait until the process of a job has ended, or until a time limit has passed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while self.exitcode is None and (deadline is None or time.monotonic() < deadline):
            self.wait_for_job_end(
                None if deadline is None else max(0.0, deadline - time.monotonic())
            )


@dataclass
class Server:
    """Server process with preloaded libraries, from which the processes of a sweep's jobs are
    forked. `preload` imports for all of them; each uses `threads` threads."""

    tasks: Sequence[Callable[[], object]]
    preload: Callable[[], object]
    threads: int
    children: dict[int, JobProcess] = field(default_factory=dict)
    line: Connection | None = None
    pid: int = 0

    def fork_job(self, number: int) -> JobProcess:
        """Fork a new process that runs the job with a given number. Raises `BadRequest` if
        `preload` fails."""
        if self.line is None:
            self._start_server()
        assert self.line is not None
        try:
            self.line.send(number)
        except ConnectionError:
            self._mark_jobs_dead()
        # The ends of other jobs may be told before the birth of this one.
        while self.line is None or not isinstance(born := self._read_message(), JobProcess):
            if self.line is None:  # the server was killed before it could fork
                return JobProcess(
                    pid=UNBORN, wait_for_job_end=self.wait_for_job_end, exitcode=SERVER_DIED
                )
        return born

    def wait_for_job_end(self, timeout: float | None) -> None:
        """Wait, up to a time limit, until some job ends, and note its exit status."""
        if self.line is not None and self.line.poll(timeout):
            self._read_message()

    def close(self) -> None:
        """Stop the server process and all jobs that are still running."""
        if self.line is not None:
            self.line.close()
            os.waitpid(self.pid, 0)  # else it stays as a zombie until the sweep ends
            self.line = None

    def _read_message(self) -> JobProcess | None:
        """Read one message of the server process: a job's process was started, or one has ended."""
        assert self.line is not None
        try:
            pid, exitcode = self.line.recv()  # a birth has no exit code, an end has
        except (EOFError, ConnectionError):
            self._mark_jobs_dead()
            return None
        if exitcode is None:
            self.children[pid] = JobProcess(pid=pid, wait_for_job_end=self.wait_for_job_end)
            return self.children[pid]
        self.children.pop(pid).exitcode = exitcode
        return None

    def _mark_jobs_dead(self) -> None:
        """Mark all jobs as ended because the server process has died."""
        self.close()
        for child in self.children.values():
            child.exitcode = SERVER_DIED
        self.children.clear()

    def _start_server(self) -> None:
        """Preload the libraries and fork the server process of a sweep."""
        with _temporary_environment(thread_limit_variables(self.threads)):
            try:
                self.preload()
            except Exception as error:  # whatever a module raises
                source = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{source.filename}:{source.lineno}"
                cause = f"{type(error).__name__}: {error}"
                problem = f"{where}: importing it for the jobs failed ({cause})"
                name = Path(source.filename).name
                raise BadRequest("program", name, problem, "correct this import error") from error
            gc.freeze()  # what has been imported is not looked at again: a job would copy all of it
            for stream in (sys.stdout, sys.stderr):
                stream.flush()  # what waits in a buffer would be written again by every job
            self.line, theirs = Pipe()
            self.pid = os.fork()
            if self.pid == 0:
                # The server must not hold the sweep's end, or it would never see it close.
                self.line.close()
                _run_server(theirs, self.tasks, self.threads)
            # Nor the sweep the server's: its death is then seen as the end of the line.
            theirs.close()


def _run_server(sweep: Connection, tasks: Sequence[Callable[[], object]], threads: int) -> NoReturn:
    """Main loop of the server process, which forks a process for each requested job and reports the
    ends of jobs. When the process of the sweep has gone, it kills all jobs."""
    os.setsid()  # Ctrl-C on the terminal reaches the sweep alone, which then ends the rest in order
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    _apply_memory_and_thread_limits(threads)
    if len(tasks) >= MANY:
        _collapse_into_large_pages()
    living: dict[int, int] = {}  # process by its descriptor
    with contextlib.suppress(BaseException):
        while True:
            for ready in wait([sweep, *living]):
                if ready is sweep:
                    pid = _fork_job(sweep, tasks[sweep.recv()])
                    # Readable when the process ends: no polling, no SIGCHLD.
                    living[os.pidfd_open(pid)] = pid
                    sweep.send((pid, None))
                elif isinstance(ready, int):
                    pid, status = os.waitpid(living.pop(ready), 0)
                    os.close(ready)
                    sweep.send((pid, os.waitstatus_to_exitcode(status)))
    for pid in living.values():
        kill_process_tree(pid)
    os._exit(0)  # without the sweep's own handlers at exit, which the fork has inherited


def _fork_job(sweep: Connection, task: Callable[[], object]) -> int:
    """Fork a process that executes one task, and return its process id."""
    server = os.getpid()
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        sweep.close()  # a job that lives on must not keep the line open
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # It died before the line above: nobody would ever send the signal.
        if os.getppid() != server:
            os._exit(status)
        task()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:  # nothing may return into the server's loop
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def kill_process_tree(pid: int) -> None:
    """Kill a process and all processes that it started."""
    # A group of its own is the first thing it makes, not the birth of it.
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            kill(pid, signal.SIGKILL)


def thread_limit_variables(threads: int) -> dict[str, str]:
    """Environment variables that limit the threads of torch, MKL and OpenBLAS in a job's
    process."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(names, str(threads)) | {"OMP_WAIT_POLICY": "passive"}


def _apply_memory_and_thread_limits(threads: int) -> None:
    """Apply the memory settings and thread limits to libraries that a job's process has loaded
    already."""
    with contextlib.suppress(AttributeError):  # another C library
        for parameter, value in ALLOCATOR:
            ctypes.CDLL(None).mallopt(parameter, value)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(threads)


def _collapse_into_large_pages() -> None:
    """Collapse the server's memory into large pages, so that forks are faster. A fork takes 13 ms
    instead of 35, for 0.8 s once.

    Linux 6.1 and later; elsewhere nothing happens.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for line in Path("/proc/self/maps").read_text().splitlines():
        region, rights = line.split()[:2]
        first, last = (int(address, 16) for address in region.split("-"))
        if rights == "rw-p":
            for page in range(-(-first // LARGE_PAGE), last // LARGE_PAGE):
                madvise(page * LARGE_PAGE, LARGE_PAGE, MADV_COLLAPSE)


@contextlib.contextmanager
def _temporary_environment(variables: dict[str, str]) -> Iterator[None]:
    """Context manager in which environment variables have given values."""
    before = {name: os.environ[name] for name in variables if name in os.environ}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]
        os.environ.update(before)
