"""Closed-loop rollouts: many cases in one batch against the same cases one by one.

    python benchmarks/loop_batch.py [--cases 1000] [--samples 1000] [--one-by-one 20]

The design is the default (`synthesis=auto`) for the default motor and model; times in seconds of
wall clock, the one-by-one time extrapolated from `--one-by-one` cases. Run both in one process:
only the ratio travels.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from common import study_of

from ssm_study.bounds.slopes import certified_balls
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.synthesis.auto import Auto


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, count in (("cases", 1000), ("samples", 1000), ("one-by-one", 20)):
        parser.add_argument(f"--{name}", type=int, default=count)
    asked = parser.parse_args()
    part = study_of("study=benchmark")
    data = part.data.build(part.plant, part.excitation, 0)
    with TemporaryDirectory() as folder:
        found = part.training.identify(part.model, data, 0, Path(folder), False)
    model = part.reduction.reduce_model(found.model)
    plant = part.plant
    design = Auto().design(model, certified_balls(model), data.validation)
    loop = LoopExperiment(initial_conditions=asked.cases, horizon_s=asked.samples * plant.step_s)
    controller, (y0, noise) = (
        ObserverFeedback.from_design(model, design),
        loop.draw_starts_and_noise(plant, 0),
    )
    loop.simulate(plant, controller, y0[:2], noise[:2])  # compiles the plant's kernel

    started = time.perf_counter()
    together = loop.simulate(plant, controller, y0, noise)
    batch_s = time.perf_counter() - started
    started = time.perf_counter()
    few = asked.one_by_one
    singles = [
        loop.simulate(plant, controller, y0[i : i + 1], noise[i : i + 1]) for i in range(few)
    ]
    single_s = (time.perf_counter() - started) / few * asked.cases
    apart = max(float(np.abs(together.y[i] - one.y[0]).max()) for i, one in enumerate(singles))
    print(f"cases {asked.cases}, samples {asked.samples}")
    print(
        f"batch {batch_s:.2f} s, one by one {single_s:.1f} s (from {few} cases), ratio "
        f"{single_s / batch_s:.0f}"
    )
    print(f"largest difference between the two {apart:.1e} rad/s")


if __name__ == "__main__":
    main()
