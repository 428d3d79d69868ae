"""Does the monitor of the exported C flag every loop that is lost, and leave alone those that
settle?

    python -m benchmarks.monitored_plants --jobs 2 --to monitored_plants.csv
    python -m benchmarks.monitored_plants --table monitored_plants.csv

Per plant of `benchmarks/aside_plants.py` and `benchmarks/adversarial` `auto` chooses for a model of
order 4 (seed 0). Where the choice is covered its loop then runs on the plant as it was recorded and
on plants that have changed since: they answer more strongly, with the other sign, or later. Ten
starts with noise each. A case is lost where it leaves the bound of the simulation or does not
settle; the sum of the premise is that of `-DMONITOR` (`export/c_monitor.py`), which
`tests/oracles/test_export_monitor.py` compares with the C code. Half a minute of one core a plant.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from benchmarks.aside_plants import ASIDE
from benchmarks.common import add_table_options, finished_results, keep, rows_of
from benchmarks.coverage_by_seed import IdentifiedCase
from benchmarks.coverage_designs import MADE, ORDER
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.export.c_monitor import MonitorConstants
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.motion import settling_times_s
from ssm_study.loop.rollout import Rollouts
from ssm_study.plants.plant import Plant
from ssm_study.plants.wrapper import DelayedInput, PlantWrapper
from ssm_study.robustness.coverage import running_constraint_sum
from ssm_study.synthesis.measured_discs_run import coverage_columns, disc_weights

KEY = ("plant", "gain", "delay")
GAINS = (1.0, 2.0, 4.0, 8.0, -1.0)
DELAYS = (0, 3, 12)
LONGER = 3  # times the usual horizon: a small swing takes long to exceed the limit


@dataclass(frozen=True, kw_only=True)
class StrongerInput(PlantWrapper):
    """Plant whose input acts `gain` times as strongly as when it was recorded."""

    gain: float

    def applied_input(self, memory: Any, u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:  # noqa: ARG002
        rest = self.plant.equilibrium().u
        return rest + self.gain * (u - rest)


def changed_plant(plant: Plant, gain: float, delay: int) -> Plant:
    """The plant with another gain and a dead time."""
    stronger = plant if gain == 1.0 else StrongerInput(plant=plant, gain=gain)
    return stronger if delay == 0 else DelayedInput(plant=stronger, samples=delay)


def flagged_at(
    run: Rollouts, case: IdentifiedCase, design: Design, monitor: MonitorConstants
) -> Float[np.ndarray, "N"]:
    """First sample of each case at which the monitor's flag is up; infinite without one."""
    part = design.extra_certificates["coverage"]
    assert isinstance(part, MeasuredDiscs)
    scale = case.model.scale
    firsts = []
    for u, y in zip(run.u, run.measured, strict=True):
        simulated = case.model.simulate(u)
        signals = (scale.scaled_input(u), scale.scaled_output(simulated))
        e = (y - simulated) / scale.output_scale
        weights = disc_weights(part)
        sums = running_constraint_sum(weights, part.centre, part.kappa, *signals, e)
        added = np.diff(sums, prepend=0.0) - monitor.allowance
        whole = np.cumsum(added)
        excess = whole - np.minimum(np.minimum.accumulate(whole), 0.0)
        raised = np.flatnonzero(excess > monitor.alarm_limit(scale.scaled_output(y[0])))
        firsts.append(float(raised[0]) if len(raised) else np.inf)
    return np.array(firsts)


def rows_of_plant(name: str) -> list[dict[str, Any]]:
    """The lines of one plant; none where nothing is covered."""
    case = IdentifiedCase.of(name, 0, [f"model.order={ORDER}"], fresh=0)
    _, design = case.choose()
    coverage = coverage_columns(design, case.model, case.premise).get("coverage")
    monitor = MonitorConstants.for_design(case.model, design)
    if monitor is None or coverage is None or coverage < 1:
        return [{"plant": name, "gain": 1.0, "delay": 0, "coverage": coverage or "", "cases": 0}]
    controller = ObserverFeedback.from_design(case.model, design)
    usual = case.parts.loop.with_default_horizon(case.model)
    loop = replace(usual, horizon_s=LONGER * usual.horizon_s)
    y0, noise = loop.draw_starts_and_noise(case.plant, 0)
    rows = []
    for gain in GAINS:
        for delay in DELAYS:
            plant = changed_plant(case.plant, gain, delay)
            run = loop.simulate(plant, controller, y0, noise)
            times = settling_times_s(run, case.plant.settling_band)
            settled = np.array([time is not None for time in times])
            flagged = flagged_at(run, case, design, monitor)
            stayed = run.stayed_within_bound
            left_at = np.where(stayed, run.u.shape[1], run.left_at_sample)
            rows.append(
                {
                    "plant": name,
                    "gain": gain,
                    "delay": delay,
                    "coverage": coverage,
                    "cases": len(settled),
                    "settled": int(settled.sum()),
                    "settled_flagged": int((settled & np.isfinite(flagged)).sum()),
                    "left": int((~stayed).sum()),
                    "left_flagged_before": int((~stayed & (flagged <= left_at)).sum()),
                    "swinging": int((stayed & ~settled).sum()),
                    "swinging_flagged": int((stayed & ~settled & np.isfinite(flagged)).sum()),
                }
            )
    return rows


def summary(path: Path) -> pd.DataFrame:
    """Sums per plant, and of the plants as they were recorded (`same`)."""
    table = pd.read_csv(path)
    counts = [name for name in table.columns if name not in (*KEY, "coverage")]
    result = table.groupby("plant", sort=False)[counts].sum()
    same = (table.gain == 1.0) & (table.delay == 0)
    result.loc["all"] = result.sum()
    result.loc["all, as recorded"] = table[same][counts].sum()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plant", nargs="+", default=[*ASIDE, *MADE])
    add_table_options(parser)
    arguments = parser.parse_args()
    if arguments.table is not None:
        print(summary(arguments.table).to_string())
        return
    there = {row["plant"] for row in rows_of(arguments.to or Path("none"))}
    plants = [plant for plant in arguments.plant if plant not in there]
    for rows in finished_results(rows_of_plant, plants, arguments.jobs):
        print(pd.DataFrame(rows).to_string(), flush=True)
        if arguments.to is not None:
            keep(arguments.to, rows, KEY, lambda one: [str(one[name]) for name in KEY])


if __name__ == "__main__":
    main()
