"""Structured models of the simulated plants over seeds: noise-free fit, best certified factors,
what a start costs.

    python benchmarks/structured_plants.py dc_motor stribeck_drive --seeds 10 [--set model.order=6
    ...] [--to FILE]

writes results/reference/training/structured_plants.csv. Per row: fits of the validation record
(noisy) and of the test record (without noise), the open loop's slowest mode at rest, the least r =
sqrt(1 - rate) that bisecting the inequality on the exact verdict finds for a state feedback (the
ball of S_u included) and for an observer, 1 where there is none, and processor seconds of a start
with its training. Nothing is chosen by a test record: the starts go by validation. With `--each` a
row is a start, and r is found for those within a percent point of the best by validation:

    python benchmarks/structured_plants.py dc_motor --each --first 10 --set model.starts=12
    model.ridge=1e-7 --to FILE
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from common import REFERENCE, study_of, write

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import dual_system
from ssm_study.models.structured import linearise_at_equilibrium
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.model_selection import largest_certifiable_rate
from ssm_study.synthesis.structured_lmi import largest_rate_with_neurons
from ssm_study.systems import JacobianBall, StateSpace, System
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.saving import train_with_lightning  # noqa: F401 - its imports are no training

TARGET = REFERENCE / "training" / "structured_plants.csv"


def row(plant: str, seed: int, overrides: list[str]) -> dict[str, object]:
    part = study_of(f"plant={plant}", "model=structured", *overrides)
    data = part.data.build(part.plant, part.excitation, seed)
    with TemporaryDirectory() as folder:
        began = time.process_time()
        found = part.training.identify(part.model, data, seed, Path(folder))
        spent = time.process_time() - began
    model, balls = found.model, certified_balls(found.model)
    sides = {False: balls.input, True: balls.output}
    factors = [
        np.sqrt(1.0 - largest(model.system, ball, observes)) for observes, ball in sides.items()
    ]
    numbers = {
        "fit_validation_percent": found.fit_validation_percent,
        "fit_test_percent": records_fit_percent(model, data.test, data),
        "radius_at_rest": linearise_at_equilibrium(model).spectral_radius,
        "r_controller": factors[0],
        "r_observer": factors[1],
        "seconds_per_start": spent / part.model.training_run_count,
    }
    sizes = {
        "plant": plant,
        "seed": seed,
        "order": model.order,
        "neurons": len(getattr(model, "neurons", ())),
    }
    return sizes | {name: f"{value:.4g}" for name, value in numbers.items()}


def largest(system: System, ball: JacobianBall, observes: bool) -> float:
    """Of a one-layer model, which a start may end as, the frontier is exact."""
    if isinstance(system, StateSpace):
        return controller_frontier(dual_system(system) if observes else system, ball).rate_limit
    return largest_rate_with_neurons(
        RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1).problem(system, ball, observes)
    )


def each(plant: str, seed: int, overrides: list[str]) -> list[dict[str, object]]:
    """Every start of one seed, none of which the program would have to take."""
    part = study_of(f"plant={plant}", "model=structured", *overrides)
    found = []

    def kept(every):  # type: ignore[no-untyped-def]
        found.extend(every)
        return max(every, key=lambda one: one.fit_validation_percent)

    data = part.data.build(part.plant, part.excitation, seed)
    with TemporaryDirectory() as folder:
        best = part.training.identify(
            replace(part.model, among_starts=kept), data, seed, Path(folder)
        )
    rows = []
    for start, one in enumerate(found):
        model = one.model
        near = one.fit_validation_percent >= best.fit_validation_percent - 1
        numbers = {"fit_validation_percent": one.fit_validation_percent}
        numbers |= {"fit_test_percent": records_fit_percent(model, data.test, data)}
        sizes = {"plant": plant, "seed": seed, "start": start, "order": model.order}
        sizes |= {"neurons": len(getattr(model, "neurons", ()))}
        told = {name: f"{value:.5g}" for name, value in numbers.items()}
        rate = (
            largest_certifiable_rate(model.system, certified_balls(model).input) if near else None
        )
        rows.append(
            sizes | told | {"r_controller": "" if rate is None else f"{np.sqrt(1 - rate):.4g}"}
        )
    return rows


def written(rows: list[dict[str, object]], to: Path) -> None:
    """The rows so far; the last one is printed."""
    print(",".join(map(str, rows[-1].values())), flush=True)
    write(to, rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plants", nargs="+")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="of the seeds")
    parser.add_argument("--each", action="store_true", help="a row for every start")
    parser.add_argument("--set", nargs="*", default=[], help="overrides of the configuration")
    parser.add_argument("--to", type=Path, default=TARGET)
    options = parser.parse_args()
    rows = []
    for plant in options.plants:
        for seed in range(options.first, options.first + options.seeds):
            rows += (each if options.each else lambda *asked: [row(*asked)])(
                plant, seed, options.set
            )
            written(rows, options.to)


if __name__ == "__main__":
    main()
