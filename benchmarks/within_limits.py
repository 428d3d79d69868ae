"""With limits on: ten seeds of three plants, the certified loop beside a naive clamp that nobody told the controller of.

    python benchmarks/within_limits.py run --to /tmp/limits        (60 runs, half an hour on one core)
    python benchmarks/within_limits.py table /tmp/limits --to results/reference/loop

The limits are a fifth to two fifths of what the records used, so that they act for most of the way. `auto` is the run as it
stands; `auto_integral` adds integrators, which is where a naive clamp winds up. The loops of the table: without noise,
ten starts, same model, gains and limits; `naive` is the same law in front of an actuator that clips unknown to it.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from ssm_study.cli.main import main
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import pooled
from ssm_study.loop.regulation import Loop, LoopRuns
from ssm_study.plants.wrapper import SaturatedInput
from ssm_study.report import style
from ssm_study.study.run_files import RunFiles

LIMITS = {"dc_motor": (-1.5, 1.5), "stribeck_drive": (-0.5, 0.5), "cascaded_tanks": (1.7, 3.3)}
SYNTHESES = ("auto", "auto_integral")


def run(to: Path) -> None:
    """The two sweeps of each plant; the second takes its models from the first."""
    for plant, (low, high) in LIMITS.items():
        ends = [f"loop.input_lower={low}", f"loop.input_upper={high}", f"results_dir={to}"]
        for synthesis in SYNTHESES:
            words = [f"plant={plant}", f"synthesis={synthesis}", f"study={plant}-{synthesis}", "seed=range(10)"]
            main(["run", "-m", *words, *ends, "progress=false", "hydra/launcher=basic"])


def loops(files: RunFiles) -> tuple[LoopRuns, LoopRuns]:
    """The certified law within its limits, and the same law in front of a clamp that it is not told of; no noise."""
    plant, (low, high) = files.plant, files.loop.limits
    law = ObserverFeedback.of(files.model, files.design)
    quiet = replace(files.loop.fitted(files.model), measurement_noise_variance=0.0)
    told = quiet.on_plant(plant, law, seed=0)
    untold = replace(quiet, input_lower=None, input_upper=None)
    assert isinstance(quiet, Loop)
    clamped = SaturatedInput(plant=plant, lower=float(low), upper=float(high))
    return told, untold.on_plant(clamped, law, seed=0)


def row(folder: Path) -> dict[str, object]:
    """One run of the table."""
    record = pd.read_json(folder / "record.json", typ="series")
    told, naive = loops(RunFiles(path=folder, record=dict(record)))
    low, high = LIMITS[folder.parent.name.rsplit("-", 1)[0]]
    u = told.controlled.u
    found: dict[str, object] = {"plant": folder.parent.name.rsplit("-", 1)[0], "synthesis": record["synthesis_method"]}
    found |= {"integrators": folder.parent.name.endswith("integral"), "seed": record["seed"]}
    found |= {name: record.get(name) for name in ("controller_certified", "observer_certified", "predicted_stable")}
    found |= {"settled_in_the_run": record["stable_count"], "starts": record["initial_conditions"]}
    found |= {name: record.get(name) for name in ("limited_rate", "unlimited_from", "unlimited_to")}
    found["beyond_the_limits"] = float(np.maximum(u - high, low - u).clip(0).max())
    found["at_a_limit"] = float(((u <= low) | (u >= high)).mean(axis=(1, 2)).max())
    for name, one in (("", told), ("naive_", naive)):
        columns = pooled([one])
        for column in ("stable_count", "settling_time_mean_s", "settling_time_worst_s", "overshoot_worst"):
            found[name + column] = columns[column]
    return found


def draw(folder: Path, path: Path) -> None:
    """The start farthest out under both: output above, what the law asks for and what acts below."""
    files = RunFiles(path=folder, record={})
    told, naive = loops(files)
    low, high = LIMITS[folder.parent.name.rsplit("-", 1)[0]]
    case = int(np.abs(told.controlled.y[:, 0, 0] - files.plant.equilibrium().y[0]).argmax())
    fig = style.canvas(style.PAGE_IN, 3.2)
    above, below = fig.subplots(2, 1, sharex=True)
    for one, colour, label in ((naive, style.VERMILLION, "naive clamp"), (told, style.BLUE, "limits known")):
        above.plot(one.controlled.time_s, one.controlled.y[case, :, 0], color=colour, lw=1, label=label)
        below.step(one.controlled.time_s, one.controlled.u[case, :, 0], color=colour, lw=1, where="post")
    for limit in (low, high):
        below.axhline(limit, color="black", lw=0.8, ls="--")
    output, applied = files.plant.outputs[0], files.plant.inputs[0]
    above.set(ylabel=f"{output.name.replace('_', ' ')} ({output.unit})")
    above.legend(frameon=False)
    below.set(ylabel=f"asked for ({applied.unit})", xlabel="Time (s)")
    fig.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("run", "table"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    asked = parser.parse_args()
    if asked.do == "run":
        run(asked.to)
    else:
        runs = sorted(path.parent for path in asked.folder.glob("*-auto*/*/record.json"))
        table = pd.DataFrame([row(one) for one in runs]).sort_values(["integrators", "plant", "seed"])
        table.to_csv(asked.to / "within_limits.csv", index=False, float_format="%.6g", lineterminator="\n")
        shown = next(one for one in runs if one.parent.name == "dc_motor-auto_integral" and "seed0" in one.name)
        draw(shown, asked.to / "within_limits.png")
        print(table.to_string())
