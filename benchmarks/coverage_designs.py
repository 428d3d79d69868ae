"""Does any design that comes out covered lose its plant? Thousands of designs of many plants.

    python -m benchmarks.coverage_designs --jobs 2 --to coverage_designs.csv
    python -m benchmarks.coverage_designs --table coverage_designs.csv

Per plant of `benchmarks/adversarial` and of `benchmarks/aside_plants.py` (those of
`benchmarks/steep_plants.py` by name) one model of order 4 is
identified (seed 0) and 100 designs are drawn from a grid far wider than that of `auto`. Each has a
line: its coverage by frequency (zero where the premise has a reason against it), what is
predicted, and how many of ten starts settle on the simulated plant, with noise and without. Ten of
those of coverage one and more also have the coverage that is decided exactly, the one that single
sines at the peaks of their own loop leave (`sine_coverage`), and what is predicted with these
(`sine_predicted`). Seeds are fixed. A minute or two of one core a plant.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.adversarial import __main__ as adversarial
from benchmarks.aside_plants import ASIDE
from benchmarks.common import add_table_options, finished_results, keep, rows_of
from benchmarks.coverage_by_seed import IdentifiedCase
from ssm_study.bounds.slopes import certified_balls
from ssm_study.loop.design_grid import RandomDesignTable
from ssm_study.loop.peers.peer import IdentificationResult
from ssm_study.synthesis.candidates import GainCandidates
from ssm_study.synthesis.measured_discs_choice import OVERESTIMATE, LoopCoverage
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate
from ssm_study.synthesis.sine_judgement import (
    measure_error_with_simulated_sines,
    sine_columns,
    sine_coverage_columns,
)
from ssm_study.synthesis.withheld_coverage import reported_coverage

KEY = ("plant", "seed", "design")
ORDER = 4
EXACT = ("coverage", "sine_coverage", "sine_predicted")
DECIDED = 10  # designs of each plant whose coverage is decided exactly
MADE = [path.stem for path in sorted((adversarial.HERE / "conf").glob("*.yaml"))]
KEPT = (
    "predicted_stable",
    "model_area",
    "stable_count",
    "stable_count_noise_free",
    "settling_time_mean_s",
    "settling_time_open_loop_s",
)


@dataclass(frozen=True, kw_only=True)
class GridTask:
    """One plant with its seed and the number of designs drawn."""

    plant: str
    seed: int
    designs: int


@dataclass(frozen=True, kw_only=True)
class DrawnDesigns:
    """Candidates of one identified plant, with the coverage of any pair of their gains."""

    case: IdentifiedCase
    candidates: GainCandidates

    def by_frequency(self, pairs: Any) -> list[float]:
        """Coverage by frequency of each pair; zero where the premise has a reason against any."""
        case = self.case
        if case.premise.insufficient_records_reason(0.0) is not None:
            return [0.0] * len(pairs)
        system = case.model.system
        balls = certified_balls(case.model)
        loop = LoopCoverage.from_model(case.model, system, balls, case.premise)
        coverages = []
        for pair in pairs:
            gains = self.candidates.gains(pair)
            coverages.append(loop.largest_disc_radius({"k": gains.k, "l": gains.l})[0])
        return coverages

    def exact(self, pair: Any, seed: int) -> dict[str, Any]:
        """Coverage of one pair that is decided exactly, and what single sines at the peaks of its
        loop leave of it and of its prediction; empty without one."""
        case = self.case
        model = case.model
        balls = certified_balls(model)
        design = self.candidates.synthesis_settings(pair).design(model, balls)
        proved = add_coverage_certificate(design, model, balls, case.premise)
        coverage = reported_coverage(proved, model, case.premise)
        source = case.parts.data
        sines = measure_error_with_simulated_sines(
            proved, model, balls, case.mismatch, source, case.plant, seed
        )
        judged = sine_columns(proved, model, balls, case.mismatch, sines)
        facts = sine_coverage_columns(proved, sines, coverage)
        return {
            "coverage": coverage or "",
            "sine_coverage": facts.get("sine_coverage") or "",
            "sine_predicted": judged.get("predicted_stable", ""),
        }


def rows_of_task(task: GridTask) -> list[dict[str, Any]]:
    """The lines of one plant."""
    case = IdentifiedCase.of(task.plant, task.seed, [f"model.order={ORDER}"], fresh=0)
    balls = certified_balls(case.model)
    known = IdentificationResult.from_data_set(case.model, balls, case.data)
    grid = RandomDesignTable(designs=task.designs)
    candidates = grid.auto.compute_candidates(case.model, balls)
    if candidates is None:
        return []
    pairs = grid.draw_gain_pairs(candidates, task.seed)
    loop = case.parts.loop.with_default_horizon(case.model)
    behaviour = [row for row in grid.rows(case.plant, known, loop, task.seed) if row["design"] > 0]
    drawn = DrawnDesigns(case=case, candidates=candidates)
    rows = []
    decided = 0
    for pair, coverage, behaved in zip(pairs, drawn.by_frequency(pairs), behaviour, strict=True):
        row: dict[str, Any] = {"plant": task.plant, "seed": task.seed, "design": behaved["design"]}
        row["coverage_by_frequency"] = coverage
        is_decided = coverage >= OVERESTIMATE and decided < DECIDED
        row |= drawn.exact(pair, task.seed) if is_decided else dict.fromkeys(EXACT, "")
        decided += is_decided
        row |= {name: behaved[name] for name in KEPT}
        rows.append(row)
    return rows


def summary(path: Path) -> pd.DataFrame:
    """Per plant: designs, those that settle all ten starts without noise, covered and predicted
    ones, and how many of these do not settle."""
    table = pd.read_csv(path)
    settles = table.stable_count_noise_free == 10
    covered = table.coverage_by_frequency >= OVERESTIMATE
    table["settle"] = settles
    table["covered"] = covered
    table["covered_lost"] = covered & ~settles
    table["exactly"] = table.coverage >= 1
    table["exactly_lost"] = table.exactly & ~settles
    with_sines = table.get("sine_coverage", table.coverage)
    is_measured = with_sines.notna()
    table["with_sines"] = table.exactly & is_measured & (with_sines >= 1)
    table["with_sines_lost"] = table.with_sines & ~settles
    table["predicted"] = table.predicted_stable
    table["predicted_lost"] = table.predicted_stable & ~settles
    names = ["settle", "covered", "covered_lost", "exactly", "exactly_lost"]
    names += ["with_sines", "with_sines_lost"]
    groups = table.groupby("plant", sort=False)
    result = groups[[*names, "predicted", "predicted_lost"]].sum()
    result.insert(0, "designs", groups.size())
    result.loc["all"] = result.sum()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plant", nargs="+", default=[*ASIDE, *MADE])
    parser.add_argument("--seed", nargs="+", type=int, default=[0])
    parser.add_argument("--designs", type=int, default=100)
    add_table_options(parser)
    arguments = parser.parse_args()
    if arguments.table is not None:
        print(summary(arguments.table).to_string())
        return
    file = arguments.to or Path("none")
    there = {(row["plant"], row["seed"]) for row in rows_of(file)}
    tasks = []
    for plant in arguments.plant:
        for seed in arguments.seed:
            if (plant, str(seed)) not in there:
                tasks.append(GridTask(plant=plant, seed=seed, designs=arguments.designs))
    with np.errstate(all="ignore"):
        for rows in finished_results(rows_of_task, tasks, arguments.jobs):
            if not rows:
                continue
            lost = [row for row in rows if row["coverage"] and row["stable_count_noise_free"] < 10]
            print(rows[0]["plant"], rows[0]["seed"], len(rows), "lost:", lost, flush=True)
            if arguments.to is not None:
                keep(arguments.to, rows, KEY, lambda one: [str(one[name]) for name in KEY])


if __name__ == "__main__":
    main()
