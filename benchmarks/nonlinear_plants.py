"""Plants that one layer fits badly, with neurons and without: a pendulum at large angles, a
hardening spring.

    python -m benchmarks.nonlinear_plants [seeds] > results/reference/loop/nonlinear_plants.csv

Per row: plant, model, seed; fit of the noise-free test record; what `auto` predicts and what its
loop does on the plant; mean settling times with control and without. Order 4, four neurons (tanh;
clipped cubics for the spring), the rest as configured. The plants are those of
`benchmarks/adversarial`, driven and released farther out.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.adversarial.__main__ import plant_of
from benchmarks.common import study_of
from ssm_study.bounds.slopes import certified_balls
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.models.metrics import Simulation
from ssm_study.plants.plant import Plant
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import predict_margins

# radians, up to 2; the spring pulls seven times as hard at the end of its range as its stiffness at
# rest would
PLANTS: dict[str, dict[str, float]] = {
    "pendulum": {"amplitude": 0.85, "reach": 1.8},
    "hardening": {"amplitude": 2.0},
}
NEURONS = "structured model.neurons=4"
MODELS = {
    "pendulum": ("ssm", NEURONS),
    "hardening": ("ssm", f"{NEURONS} model.kinds=clipped_cubic"),
}


def row(name: str, plant: Plant, model: str, seed: int) -> str:
    """One line: identified, designed and closed as `ssm-study run` does it."""
    asked = [word if "=" in word else f"model={word}" for word in model.split()]
    parts: Any = study_of(*asked, "model.order=4", f"seed={seed}")
    data = parts.data.build(plant, parts.excitation, seed)
    with TemporaryDirectory() as folder:
        made = parts.reduction.reduce_model(
            parts.training.identify(parts.model, data, seed, Path(folder), False).model
        )
    clean = replace(plant, noise=0.0)
    quiet = replace(data, test=parts.data.build(clean, parts.excitation, seed).test)
    fit = Simulation.simulate_records(made, quiet.test, quiet.start_up_samples).fit_percent
    shown = measure_model_error(made, data.validation, data.start_up_samples, data.mismatch_records)
    balls = certified_balls(made)
    design = parts.synthesis.design(made, balls, data.validation, shown)
    if not design.feasible:
        head = f"{name},{asked[0][6:]},{seed},{np.mean(fit):.2f},{shown.largest_recorded_gain:.3f}"
        return f"{head},,,,,,{design.certified}"
    predicted = predict_margins(made, design.gain_pair, balls, shown)
    facts = behaviour_columns(
        parts.loop.with_default_horizon(made).run_design(plant, made, design, parts.loop_seed)
    )
    times = [facts[f"settling_time_{which}"] for which in ("mean_s", "open_loop_s")]
    told = ",".join("" if value is None else f"{value:.3f}" for value in times)
    judged = (
        f"{predicted.resolved_margin:.2f},{predicted.predicts_stability()},{facts['stable_count']}"
    )
    head = f"{name},{asked[0][6:]},{seed},{np.mean(fit):.2f},{shown.largest_recorded_gain:.3f}"
    return f"{head},{judged},{told},{design.certified}"


def main(seeds: int) -> None:
    """Every plant, model and seed."""
    print(
        "plant,model,seed,fit_percent,mismatch_seen,margin,predicted,settled_of_10,settle_s,alone_s,certified"
    )
    for name, changes in PLANTS.items():
        plant = replace(plant_of(name), **changes)  # type: ignore[arg-type] # numbers
        for model in MODELS[name]:
            for seed in range(seeds):
                print(row(name, plant, model, seed), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
