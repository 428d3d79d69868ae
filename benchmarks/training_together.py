"""Throughput of training the members of a sweep together, against one after the other; and whether the results agree.

python benchmarks/training_together.py [members] [samples ...]   # writes results/reference/training/together.csv

Pairs within one run: the same members alone, one after the other, then together in one process, both in processor
seconds of that process, from the data to the scored model. Two such processes side by side double the second.
"""

import csv
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from models_clock import machine

from ssm_study.results.naming import register_resolver
from ssm_study.results.server import ALLOCATOR, thread_limits
from ssm_study.specification import Specification
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
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        return work(Path(folder)), time.process_time() - began


def pair(members: int, samples: int) -> dict[str, float]:
    made = specifications(members, samples)
    data = [one.dataset() for one in made]

    def alone(folder: Path) -> list[Identification]:
        trained = zip(made, data, strict=True)
        return [one.training.identify(one.model, d, one.seed, folder / f"{one.seed}") for one, d in trained]

    def together(folder: Path) -> dict[int, Identification]:
        shared = [
            Member(spec=one.model, data=d, seed=one.seed, training=one.training)
            for one, d in zip(made, data, strict=True)
        ]
        found: dict[int, Identification] = {}
        left = train_together(shared, lambda m, n: found.setdefault(m.seed, m.conclude(folder / f"{m.seed}", n)))
        for one in left:
            found[one.seed] = one.training.identify(one.spec, one.data, one.seed, folder / f"{one.seed}")
        return found

    made[0].training.identify(made[0].model, data[0], 0, Path(tempfile.mkdtemp()))  # warm
    (each, alone_s), (shared, together_s) = clocked(alone), clocked(together)
    apart = [abs(one.fit_validation_percent - shared[i].fit_validation_percent) for i, one in enumerate(each)]
    return {
        "members": members,
        "samples": samples,
        "alone_s_each": alone_s / members,
        "together_s_each": together_s / members,
        "throughput_ratio": alone_s / together_s,
        "shared": sum(one.trained_together > 1 for one in shared.values()),
        "largest_difference_percent": max(apart),
    }


def main(members: int, lengths: list[int]) -> None:
    for name, value in (thread_limits(1) | ALLOCATOR).items():
        assert os.environ.get(name) == value, f"set {name}={value} as the launcher does"
    rows = [pair(members, samples) for samples in lengths]
    for row in rows:
        print({name: round(value, 4) for name, value in row.items()})
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    with TARGET.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], "machine"])
        writer.writeheader()
        writer.writerows(row | {"machine": machine()} for row in rows)


if __name__ == "__main__":
    register_resolver()
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8, [int(word) for word in sys.argv[2:]] or [250, 1000, 4000])
