"""Internal models on the true motor: loads and references of a constant, a ramp and a sine, under
laws that know them.

    python benchmarks/internal_models.py run --to /tmp/internal        (twelve runs, three minutes
    on one core)
    python benchmarks/internal_models.py table /tmp/internal --to results/reference/loop

Designs of `synthesis=auto_integral` for the models of three seeds; no noise, ten starts. The error
is that of the last period of the sine (2 s): the largest, and its component at the sine's
frequency.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.cli.main import main
from ssm_study.engine.records import read_record
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.reference import StepReference
from ssm_study.plants.disturbance import NoDisturbance, PeriodicDisturbance, RampDisturbance
from ssm_study.study.run_files import RunFiles

LAWS = ("step", "step,sine(0.5Hz)", "step,sine(0.5Hz),sine(1Hz)", "ramp")
HERTZ = 0.5
HORIZON_S = 12.0
TURNING = StepReference(before=0.0, after=8.0, at_s=0.0)
SITUATIONS = {
    "sine load": (TURNING, PeriodicDisturbance(amplitude=0.005, frequency_hz=HERTZ)),
    "ramp load": (TURNING, RampDisturbance(slope_per_s=0.001, from_s=2.0, until_s=100.0)),
    "sine reference": (PeriodicDisturbance(amplitude=4.0, frequency_hz=HERTZ), NoDisturbance()),
    "ramp reference": (
        RampDisturbance(slope_per_s=1.0, from_s=0.0, until_s=100.0),
        NoDisturbance(),
    ),
}


def run(to: Path) -> None:
    """One run for each law and seed."""
    for law in LAWS:
        words = [
            "synthesis=auto_integral",
            f"synthesis.internal_model=[{law}]",
            "seed=0,1,2",
            "progress=false",
        ]
        main(["run", "-m", *words, "study=internal", "hydra/launcher=basic", f"results_dir={to}"])


def loops(folder: Path, situation: str):
    """The design's loop on the true motor in one of the situations."""
    files = RunFiles(path=folder, record=read_record(folder))
    reference, disturbance = SITUATIONS[situation]
    asked = {"reference": reference, "disturbance": disturbance, "horizon_s": HORIZON_S}
    loop = replace(files.loop_experiment, **asked, measurement_noise_variance=0.0)
    return files, loop.run_on_plant(
        files.plant, ObserverFeedback.from_design(files.model, files.design), seed=0
    ).controlled


def row(folder: Path, situation: str) -> dict[str, object]:
    """One line of the table."""
    files, made = loops(folder, situation)
    samples = round(1 / (HERTZ * made.step_s))
    error = (made.y - made.reference)[:, -samples:, 0]
    turn = np.exp(-2j * np.pi * np.arange(samples) / samples)
    law = ",".join(files.config.synthesis.internal_model)
    found: dict[str, object] = {
        "situation": situation,
        "internal_model": law,
        "seed": files.record["seed"],
    }
    found |= {
        "certified": files.design.certified,
        "rate": files.design.certified_rate("state_feedback"),
    }
    found |= {
        "predicted_stable": files.record["predicted_stable"],
        "stayed": int(made.stayed_within_bound.sum()),
    }
    found["largest_error"] = float(np.abs(error).max())
    found["at_the_frequency"] = float(2 * np.abs((error * turn).mean(axis=1)).max())
    return found


def draw(folders: list[Path], path: Path) -> None:
    """One start of seed 0 under the sine and the ramp load, the error over time on a logarithmic
    axis."""
    with style.paper_style():
        fig = drawn(folders)
        fig.savefig(path, dpi=200, metadata={"Software": None})


def drawn(folders: list[Path]) -> Figure:
    """The two panels."""
    fig = style.new_figure(style.PAGE_IN, 2.6)
    for axis, situation in zip(
        fig.subplots(1, 2, sharey=True), ("sine load", "ramp load"), strict=True
    ):
        for folder, colour in zip(
            folders, (style.VERMILLION, style.BLUE, style.SKY, style.GREEN), strict=True
        ):
            files, made = loops(folder, situation)
            size = np.abs(made.y - made.reference)[0, :, 0]
            law = ", ".join(files.config.synthesis.internal_model)
            axis.semilogy(
                made.time_s, np.maximum(size, 1e-12), color=colour, lw=0.8, label=f"[{law}]"
            )
        axis.set(title=situation, xlabel="Time (s)")
    fig.axes[0].set(ylabel="|speed - set point| (rad/s)", ylim=(1e-6, None))
    handles, labels = fig.axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper left", ncols=4)
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
        order = {law: i for i, law in enumerate(LAWS)}
        table = pd.DataFrame([row(one, situation) for situation in SITUATIONS for one in runs])
        table = table.sort_values(
            ["situation", "internal_model", "seed"],
            key=lambda c: c.map(order) if c.name == "internal_model" else c,
        )
        table.to_csv(
            asked.to / "internal_models.csv", index=False, float_format="%.2g", lineterminator="\n"
        )
        first = {
            ",".join(RunFiles(path=one, record={}).config.synthesis.internal_model): one
            for one in runs
            if "seed0" in one.name
        }
        draw([first[law] for law in LAWS], asked.to / "internal_models.png")
        print(table.to_string())
