"""Fair clocks for a shared machine: CPU seconds of this process, contenders interleaved,
medians."""

import os
import statistics
import sys
import time
from collections.abc import Callable

import torch

from ssm_study.engine.server import thread_limit_variables

TURN_S = 0.03
# What `engine.server.ALLOCATOR` says to a process that is running, for one that is about to start.
ALLOCATOR = {
    "MALLOC_MMAP_THRESHOLD_": "4294967296",
    "MALLOC_TRIM_THRESHOLD_": "4294967296",
    "MALLOC_TOP_PAD_": "67108864",
}


def as_in_a_run() -> None:
    """Starts this program again with one thread and the allocator settings that every run of a
    study has."""
    wanted = thread_limit_variables(1) | ALLOCATOR
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **wanted})


def interleaved(
    contenders: dict[str, Callable[[], object]], seconds: float = 4.0, least: int = 5
) -> dict[str, float]:
    """Median CPU milliseconds of each contender; they take turns, so that a disturbance hits all of
    them.

    A turn is one run that is not clocked and then some that are: in a training, too, a step follows
    its like, and what a contender costs must not depend on whose numbers it finds in the caches.
    """
    torch.set_num_threads(1)
    for run in contenders.values():
        run()
        run()
    times: dict[str, list[float]] = {name: [] for name in contenders}
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline or min(len(t) for t in times.values()) < least:
        for name, run in contenders.items():
            run()
            until = time.perf_counter() + TURN_S
            while True:
                began = time.process_time()
                run()
                times[name].append(1e3 * (time.process_time() - began))
                if time.perf_counter() > until:
                    break
    return {name: statistics.median(values) for name, values in times.items()}


def machine() -> str:
    """One line: threads, torch, cores and load, for the head of a table."""
    load = os.getloadavg()[0]
    return (
        f"one thread, torch {torch.__version__}, {os.cpu_count()} cores, load {load:.1f}, CPU "
        "time of the process"
    )
