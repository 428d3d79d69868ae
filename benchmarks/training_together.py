"""Throughput of training the members of a sweep together, against one after the other; and whether the results agree.

python benchmarks/training_together.py [--members N] [--samples T ...]   # results/reference/training/together.csv

Pairs within one run: the same members alone, one after the other; then together in one process, both in processor
seconds of that process, from the data to the scored model (`throughput_ratio`); then in two such processes side by
side, as a sweep on two cores does it, by the processor seconds of the slower one (`two_processes_ratio`): what the wall
clock shows where nothing else runs.
"""

import argparse
import csv
import os
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from models_clock import machine

from ssm_study.results.naming import register_resolver
from ssm_study.signals import DataSet
from ssm_study.specification import Specification
from ssm_study.sweeps.server import ALLOCATOR, thread_limits
from ssm_study.training.identification import Identification
from ssm_study.training.together import Member, train_together

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "results" / "reference" / "training" / "together.csv"


def specifications(members: int, samples: int) -> list[Specification]:
    """The default study on the motor, one member per seed."""
    lengths = [f"data.{name}={samples}" for name in ("samples", "validation_samples")]
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        words = [[f"seed={seed}", "data.test_samples=200", *lengths] for seed in range(members)]
        return [Specification.from_config(compose("study", overrides=one)) for one in words]


def clocked(work: Callable[[Path], Any]) -> tuple[Any, float]:
    """What it returns, and processor seconds of this process."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        return work(Path(folder)), time.process_time() - began


def trained_together(made: list[Specification], data: list[DataSet], folder: Path) -> dict[int, Identification]:
    """By seed; a member that shares with nobody is trained alone, as its own run would."""
    both = zip(made, data, strict=True)
    shared = [Member(spec=one.model, data=d, seed=one.seed, training=one.training) for one, d in both]
    found: dict[int, Identification] = {}
    left = train_together(shared, lambda m, n: found.setdefault(m.seed, m.conclude(folder / f"{m.seed}", n)))
    for one in left:
        found[one.seed] = one.training.identify(one.spec, one.data, one.seed, folder / f"{one.seed}")
    return found


def side_by_side(made: list[Specification], data: list[DataSet]) -> float:
    """Every second member in each of two processes: processor seconds of the slower."""
    context = get_context("fork")
    spent = context.SimpleQueue()

    def half(i: int) -> None:
        spent.put(clocked(lambda folder: trained_together(made[i::2], data[i::2], folder))[1])

    processes = [context.Process(target=half, args=(i,)) for i in range(2)]
    for process in processes:
        process.start()
    return max(spent.get() for _ in processes)


def pair(members: int, samples: int) -> dict[str, float]:
    made = specifications(members, samples)
    data = [one.dataset() for one in made]

    def alone(folder: Path) -> list[Identification]:
        trained = zip(made, data, strict=True)
        return [one.training.identify(one.model, d, one.seed, folder / f"{one.seed}") for one, d in trained]

    made[0].training.identify(made[0].model, data[0], 0, Path(tempfile.mkdtemp()))  # warm
    each, alone_s = clocked(alone)
    shared, together_s = clocked(lambda folder: trained_together(made, data, folder))
    slower_s = side_by_side(made, data)
    apart = [abs(one.fit_validation_percent - shared[i].fit_validation_percent) for i, one in enumerate(each)]
    return {
        "members": members,
        "samples": samples,
        "alone_s_each": alone_s / members,
        "together_s_each": together_s / members,
        "throughput_ratio": alone_s / together_s,
        "two_processes_ratio": alone_s / slower_s,
        "shared": sum(one.trained_together > 1 for one in shared.values()),
        "largest_difference_percent": max(apart),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--samples", type=int, nargs="+", default=[250, 1000, 4000])
    asked = parser.parse_args()
    as_launched()
    register_resolver()
    for samples in asked.samples:
        row = pair(asked.members, samples)
        print({name: round(value, 4) for name, value in row.items()}, flush=True)
        keep(row | {"machine": machine()})


def as_launched() -> None:
    """Start again with the threads and the allocator that the launcher gives its jobs, unless they are given."""
    wanted = thread_limits(1) | ALLOCATOR
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | wanted)


def keep(row: dict[str, Any]) -> None:
    """In the table, in place of an earlier one of this size."""
    before = list(csv.DictReader(TARGET.open())) if TARGET.exists() else []
    size = (f"{row['members']}", f"{row['samples']}")
    others = [one for one in before if (one["members"], one["samples"]) != size]
    with TARGET.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        writer.writeheader()
        writer.writerows(sorted([*others, row], key=lambda one: (int(one["members"]), int(one["samples"]))))


if __name__ == "__main__":
    main()
