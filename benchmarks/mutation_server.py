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
from pathlib import Path


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


def _test(cpu_s: int, tree: str, arguments: list[str]) -> None:
    import pytest

    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
    os.chdir(tree)
    sys.path.insert(0, tree)
    # Named as a worker, pytest looks for the run that tests share beside its own folder.
    os.environ |= {"OMP_NUM_THREADS": "1", "PYTEST_XDIST_WORKER": "gw0", "PYTHONPATH": tree}
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1), os.dup2(silent, 2)
    os._exit(int(pytest.main(arguments)))


def ask(path: str, cpu_s: int, tree: str, arguments: list[str]) -> int:
    for _ in range(120):  # the server binds when its libraries are imported
        if Path(path).exists():
            break
        time.sleep(1)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        connection.sendall(json.dumps([cpu_s, tree, arguments]).encode() + b"\n")
        return int(connection.recv(16).decode() or 1)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        serve(sys.argv[1])
    sys.exit(ask(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4:]) != 0)
