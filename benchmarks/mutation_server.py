"""Runs pytest in forks of a process that has the libraries imported: `python
benchmarks/mutation_server.py SOCKET`.

Half of a short test run is imports; `benchmarks/mutation.py` asks this server (`... SOCKET CPU_S
TREE ARGUMENT...`) instead of starting an interpreter for each planted fault. Nothing of the tree
itself is imported before the fork.
"""

import json
import os
import resource
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any


def serve(path: str) -> None:
    import cvxpy  # noqa: F401  imported for the forks
    import flint  # noqa: F401
    import hydra  # noqa: F401
    import hypothesis  # noqa: F401
    import lightning  # noqa: F401
    import numpy  # noqa: F401
    import pytest  # noqa: F401
    import scipy  # noqa: F401
    import torch

    torch.set_num_threads(1)
    Path(path).unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen()
        while True:
            connection, _ = listener.accept()
            if os.fork() == 0:  # the one that waits
                tested = os.fork()
                if tested == 0:
                    _test(*json.loads(connection.makefile().readline()))
                status = os.waitstatus_to_exitcode(os.waitpid(tested, 0)[1])
                connection.sendall(str(status).encode())
                os._exit(0)
            connection.close()


class Chosen:
    """Plugin that runs the chosen tests alone, in their order."""

    def __init__(self, tests: list[str]) -> None:
        self.place = {test: i for i, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> Iterator[None]:
        yield
        items[:] = [item for item in items if item.nodeid in self.place]
        items.sort(key=lambda item: self.place[item.nodeid])


def _test(cpu_s: int, tree: str, arguments: list[str], tests: list[str]) -> None:
    import pytest

    around = pytest.hookimpl(wrapper=True, tryfirst=True)
    around(Chosen.pytest_collection_modifyitems)
    plugins = [Chosen(tests)] if tests else []

    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
    os.chdir(tree)
    sys.path.insert(0, tree)
    # Named as a worker, pytest looks for the run that tests share beside its own folder.
    os.environ |= {"OMP_NUM_THREADS": "1", "PYTEST_XDIST_WORKER": "gw0", "PYTHONPATH": tree}
    log = os.open(f"{tree}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1), os.dup2(log, 2)
    status = int(pytest.main(arguments, plugins))
    nothing_left = tests and status == pytest.ExitCode.NO_TESTS_COLLECTED
    os._exit(0 if nothing_left else status)


def ask(path: str, cpu_s: int, tree: str, arguments: list[str], tests: Sequence[str] = ()) -> int:
    """Status of pytest with the arguments; with tests, of these alone."""
    for _ in range(120):  # the server binds when its libraries are imported
        if Path(path).exists():
            break
        time.sleep(1)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        connection.sendall(json.dumps([cpu_s, tree, arguments, list(tests)]).encode() + b"\n")
        return int(connection.recv(16).decode() or 1)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        serve(sys.argv[1])
    sys.exit(ask(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4:]) != 0)
