"""Programs in processes of their own that begin with the large libraries loaded.

A new interpreter takes ten seconds of a processor to import them. The standard library's fork
server imports them once for all programs of a test run; it has one thread, no test framework, and
gives back the signals that it found. Of the package itself nothing is loaded: a program may import
a changed copy of it.
"""

import os
import runpy
import signal
import sys
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path

SERVER = get_context("forkserver")
LIBRARIES = ["lightning.pytorch", "cvxpy", "matplotlib.pyplot", "numba", "pandas", "scipy.signal"]
SERVER.set_forkserver_preload(LIBRARIES)


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A program that has ended: its exit status, negative for a signal, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program that runs."""

    process: BaseProcess
    folder: Path

    def send_signal(self, number: signal.Signals) -> None:
        assert self.process.pid is not None
        pid = self.process.pid
        os.kill(pid, number)

    def wait(self, timeout_s: float) -> Ended:
        """Wait until it ends; a program that does not is killed, and the test fails."""
        self.process.join(timeout_s)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(f"the program did not end within {timeout_s} s")
        returncode = self.process.exitcode
        stdout_path = self.folder / "stdout"
        stdout = stdout_path.read_text()
        stderr_path = self.folder / "stderr"
        stderr = stderr_path.read_text()
        return Ended(returncode=returncode, stdout=stdout, stderr=stderr)


def start_program(text: str, folder: Path) -> Program:
    """Start a program; its source and what it prints are kept in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "program.py").write_text(text)
    process = SERVER.Process(target=_run, args=(folder,))
    process.start()
    return Program(process=process, folder=folder)


def _run(folder: Path) -> None:
    """Do the program as an interpreter does it: an interrupt that gets out ends it by its
    signal."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    loaded = {name.partition(".")[0] for name in sys.modules}
    assert not loaded & {"ssm_study", "hydra_plugins"}, "a copy of the package would not be read"
    program_path = str(folder / "program.py")
    sys.argv = [program_path]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except KeyboardInterrupt as interrupt:
        sys.excepthook(type(interrupt), interrupt, interrupt.__traceback__)
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
