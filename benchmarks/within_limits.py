"""With limits on: ten seeds of three plants, the certified loop beside a clamp of which the law
knows nothing.

    python benchmarks/within_limits.py run --to /tmp/limits        (30 runs, ten minutes on one
    core)
    python benchmarks/within_limits.py table /tmp/limits --to results/reference/loop

The limits are a fifth to two fifths of what the records used, so that they act for much of the way.
`auto` is the run as it stands; `integral` is a design with integrators for the same model, which is
where a naive clamp winds up. Loops of the table: ten starts at the ends of the plant's range and
between, no noise; `naive` is the same law in front of an actuator that clips unknown to it.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.cli.main import main
from ssm_study.engine.records import read_record
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import pooled_run_columns
from ssm_study.loop.regulation import LoopRuns
from ssm_study.plants.wrapper import SaturatedInput
from ssm_study.study.run_files import RunFiles
from ssm_study.synthesis.deployed import (
    EVERYWHERE,
    SETS,
    certify_under_input_limits,
    initial_output_range,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis

LIMITS = {"dc_motor": (-1.5, 1.5), "stribeck_drive": (-0.5, 0.5), "cascaded_tanks": (1.7, 3.3)}
INTEGRAL = RiccatiSynthesis(
    rate_controller=0.003, rate_observer=0.1, input_weight=0.1, output_noise=0.1
)


def run(to: Path) -> None:
    """One sweep of ten seeds for each plant."""
    for plant, (low, high) in LIMITS.items():
        words = [
            f"plant={plant}",
            f"study={plant}",
            "seed=range(10)",
            "progress=false",
            "hydra/launcher=basic",
        ]
        main(
            [
                "run",
                "-m",
                *words,
                f"loop.input_lower={low}",
                f"loop.input_upper={high}",
                f"results_dir={to}",
            ]
        )


def loops(files: RunFiles, integral: bool) -> tuple[Design, LoopRuns, LoopRuns]:
    """The certified law within its limits, and the same law in front of a clamp that it is not told
    of; no noise."""
    plant, model, (low, high) = files.plant, files.model, files.loop_experiment.limits
    design = files.design
    if integral:
        design = replace(INTEGRAL, internal_model=["step"], integral_weight=1e-2).design(
            model, certified_balls(model)
        )
    law = ObserverFeedback.from_design(model, design)
    fitted = files.loop_experiment.with_default_horizon(model)
    quiet = replace(
        fitted, measurement_noise_variance=0.0, horizon_s=(4 if integral else 1) * fitted.horizon_s
    )
    told = quiet.run_on_plant(plant, law, seed=0)
    untold = replace(quiet, input_lower=None, input_upper=None)
    clamped = SaturatedInput(plant=plant, lower=float(low), upper=float(high))
    return design, told, untold.run_on_plant(clamped, law, seed=0)


def row(folder: Path, integral: bool) -> dict[str, object]:
    """One run of the table."""
    record = read_record(folder)
    files = RunFiles(path=folder, record=record)
    plant = folder.parent.name
    design, told, naive = loops(files, integral)
    (low, high), u = LIMITS[plant], told.controlled.u
    found: dict[str, object] = {
        "plant": plant,
        "law": "integral" if integral else "auto",
        "seed": record["seed"],
    }
    found |= {
        "certified": design.certified,
        "settled_in_the_run": None if integral else record["stable_count"],
    }
    parts = certify_under_input_limits(files.model, design, np.array([low]), np.array([high]))
    found |= {"limited_rate": parts[EVERYWHERE].rate if EVERYWHERE in parts else None}
    lower, upper = initial_output_range(files.model, parts[SETS].starts)
    found |= {"unlimited_from": float(lower[0]), "unlimited_to": float(upper[0])}
    found["beyond_the_limits"] = float(np.maximum(u - high, low - u).clip(0).max())
    found["most_samples_at_a_limit"] = int(((u <= low) | (u >= high)).sum(axis=(1, 2)).max())
    for name, one in (("", told), ("naive_", naive)):
        columns = pooled_run_columns([one])
        for column in (
            "stable_count",
            "settling_time_mean_s",
            "settling_time_worst_s",
            "overshoot_worst",
        ):
            found[name + column] = columns[column]
    return found


def draw(folder: Path, path: Path) -> None:
    """The start farthest out under both, in the style of all figures."""
    with style.paper_style():
        drawn(folder).savefig(path, dpi=200, metadata={"Software": None})


def drawn(folder: Path) -> Figure:
    """Output above, what the law requests and the limits below."""
    files = RunFiles(path=folder, record={})
    _, told, naive = loops(files, integral=True)
    low, high = LIMITS[folder.parent.name]
    case = int(np.abs(told.controlled.y[:, 0, 0] - files.plant.equilibrium().y[0]).argmax())
    fig = style.new_figure(style.PAGE_IN, 3.2)
    above, below = fig.subplots(2, 1, sharex=True)
    for one, colour, label in (
        (naive, style.VERMILLION, "naive clamp"),
        (told, style.BLUE, "limits known"),
    ):
        above.plot(
            one.controlled.time_s, one.controlled.y[case, :, 0], color=colour, lw=1, label=label
        )
        below.step(
            one.controlled.time_s, one.controlled.u[case, :, 0], color=colour, lw=1, where="post"
        )
    for limit in (low, high):
        below.axhline(limit, color=style.INK, lw=0.8, ls="--")
    output = files.plant.outputs[0]
    applied = files.plant.inputs[0]
    above.set(ylabel=f"{output.name.replace('_', ' ')} ({output.unit})")
    style.place_legend_above(above)
    until = 2 * (
        pooled_run_columns([naive])["settling_time_worst_s"] or told.controlled.time_s[-1] / 2
    )
    below.set(ylabel=f"requested ({applied.unit})", xlabel="Time (s)", xlim=(0, until))
    return fig


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("do", choices=("run", "table"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    asked = parser.parse_args()
    if asked.do == "run":
        run(asked.to)
    else:
        runs = sorted(path.parent for path in asked.folder.glob("*/*/record.json"))
        table = pd.DataFrame([row(one, integral) for integral in (False, True) for one in runs])
        table.to_csv(
            asked.to / "within_limits.csv", index=False, float_format="%.4g", lineterminator="\n"
        )
        draw(next(one for one in runs if "seed0" in one.name), asked.to / "within_limits.png")
        print(table.to_string())
