"""How many designs come out covered, and what that costs in settling time: seeds and plants.

    python -m benchmarks.coverage_by_seed --plant dc_motor --seed 0 1 2 --to
    results/reference/certificates/coverage.csv
    python -m benchmarks.coverage_by_seed --table results/reference/certificates/coverage.csv

Per row, on one model of one data seed, as `ssm-study run plant=... seed=...` makes it: the choice
of `auto` without the proof (`plain_`) and the one that prefers covered designs, each on the
simulated plant from ten starts with noise; the coverage of the latter, decided exactly, and its
reason where it is null; what fresh data sets need. Plants are those of the project and of
`benchmarks/adversarial`. A row takes 20 to 60 s; rows that stand in the file are left as they are,
unless `--again`.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from benchmarks.adversarial.__main__ import plant_of
from benchmarks.common import keep, rows_of, study_of
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import collect_findings
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.models.metrics import Simulation
from ssm_study.plants.plant import Plant
from ssm_study.robustness.coverage import Premise, measure_premise
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.robustness.prediction import predict
from ssm_study.signals import DataSet
from ssm_study.synthesis import auto
from ssm_study.synthesis.decay_response import simulate_decays
from ssm_study.synthesis.measured_discs_choice import prefer_covered
from ssm_study.synthesis.measured_discs_run import (
    add_coverage_certificate,
    coverage_columns,
    fresh_data_column,
    fresh_data_needs,
)

KEY = ("plant", "model", "order", "seed", "cover")


@dataclass(frozen=True, kw_only=True)
class IdentifiedCase:
    """One plant, its records, the model of them and what they show of its mismatch."""

    parts: Any
    plant: Plant
    data: DataSet
    model: Any
    mismatch: Mismatch
    premise: Premise
    evidence: str
    fit_percent: float

    @classmethod
    def of(cls, plant_name: str, seed: int, settings: list[str], fresh: int) -> "IdentifiedCase":
        """Identified as `ssm-study run` does it."""
        plant = plant_of(plant_name)
        parts = study_of(f"seed={seed}", f"data.fresh_sets={fresh}", *settings)
        data = parts.data.build(plant, parts.excitation, seed)
        with TemporaryDirectory() as folder:
            trained = parts.training.identify(parts.model, data, seed, Path(folder), False).model
        model = parts.reduction.reduce(trained)
        records = data.validation, data.start_up_samples, data.mismatch_records
        mismatch = measure_mismatch(model, *records)
        start_up = data.start_up_samples
        premise = measure_premise(model, data.validation, mismatch, start_up, data.mismatch_records)
        validation = Simulation.simulate_records(model, data.validation, start_up)
        test = Simulation.simulate_records(model, data.test, start_up)
        return cls(
            parts=parts,
            plant=plant,
            data=data,
            model=model,
            mismatch=mismatch,
            premise=premise,
            evidence=collect_findings(data, model, validation, test, mismatch).level,
            fit_percent=test.fit_percent,
        )

    def choose(self) -> tuple[Design, Design]:
        """The choice of `auto` without the proof, the first that it would take, and the one that
        prefers what the proof covers."""
        synthesis = self.parts.synthesis
        if self.evidence == CANNOT_JUDGE:
            synthesis = synthesis.with_largest_margin()
        certified: list[Design] = []

        def prefer_and_note(pairs: Any, make: Any, *others: Any) -> Any:
            def make_and_note(pair: Any) -> Design | None:
                design: Design | None = make(pair)
                if design is not None:
                    certified.append(design)
                return design

            return prefer_covered(pairs, make_and_note, *others)

        balls = certified_balls(self.model)
        with patch.object(auto, "prefer_covered", prefer_and_note):
            decays = simulate_decays(self.model, self.data.mismatch_records, self.data.validation)
            chosen: Design = (
                synthesis.prefer_covered_designs(self.premise)
                .prefer_faster_than_decays(decays)
                .design(self.model, balls, self.data.validation, self.mismatch)
            )
        plain = certified[0] if certified else chosen
        return plain, add_coverage_certificate(chosen, self.model, balls, self.premise)

    def columns(self, design: Design) -> dict[str, Any]:
        """Prediction and loop of one design."""
        facts: dict[str, Any] = {}
        if not design.feasible:
            return facts
        balls = certified_balls(self.model)
        prediction = predict(self.model, design.pair, balls, self.mismatch)
        facts["predicted"] = prediction.predicts_stability(self.parts.synthesis.margin)
        controller = ObserverFeedback.from_design(self.model, design)
        loop = self.parts.loop.with_default_horizon(self.model)
        runs = loop.run_on_plant(self.plant, controller, self.parts.loop_seed)
        loop_columns = behaviour_columns(runs)
        names = ("stable_count", "settling_time_mean_s", "settling_time_open_loop_s")
        return facts | {name: loop_columns[name] for name in names}


def have_same_gains(first: Design, second: Design) -> bool:
    """Whether two designs deploy the same gains."""
    if not (first.feasible and second.feasible):
        return first is second
    gains = second.gains
    return all(np.array_equal(matrix, gains[name]) for name, matrix in first.gains.items())


def row_of(arguments: argparse.Namespace, plant: str, seed: int) -> dict[str, Any]:
    """One line of the table."""
    settings = [f"model={arguments.model}", *arguments.set]
    if arguments.order is not None:
        settings.append(f"model.order={arguments.order}")
    if arguments.cover is not None:
        settings.append(f"synthesis.cover={arguments.cover}")
    started = time.process_time()
    case = IdentifiedCase.of(plant, seed, settings, arguments.fresh)
    identified = time.process_time()
    plain, chosen = case.choose()
    designed = time.process_time()
    fresh = case.parts.data.simulate_fresh_sets(case.plant, seed)
    start_up = case.data.start_up_samples
    needs = fresh_data_needs(chosen, case.model, case.premise, case.mismatch, fresh, start_up)
    row: dict[str, Any] = {"plant": plant, "model": arguments.model, "seed": seed}
    row |= {"order": arguments.order or "", "cover": arguments.cover or ""}
    row |= {
        "evidence": case.evidence,
        "rests": case.mismatch.comes_to_rest,
        "fit_test": case.fit_percent,
    }
    row |= coverage_columns(chosen, case.model, case.premise) | fresh_data_column(needs)
    columns = case.columns(chosen)
    plain_columns = columns if have_same_gains(plain, chosen) else case.columns(plain)
    row |= columns | {f"plain_{name}": value for name, value in plain_columns.items()}
    row["fresh_sets"] = len(needs)
    coverage = row.get("coverage")
    row["fresh_sets_covered"] = sum(coverage is not None and need <= coverage for need in needs)
    row["identify_s"] = round(identified - started, 1)
    row["design_s"] = round(designed - identified, 1)
    return {name: "" if value is None else value for name, value in row.items()}


def summary(path: Path) -> pd.DataFrame:
    """Per plant: rows, covered and settled of them, settling time over that of the plain choice."""
    table = pd.read_csv(path)
    table["ratio"] = table.settling_time_mean_s / table.plain_settling_time_mean_s
    table["covered"] = table.coverage >= 1
    table["settles"] = table.stable_count == 10
    table["covered_lost"] = table.covered & ~table.settles
    has_fresh_sets = table.fresh_sets > 0
    table["fresh_within"] = has_fresh_sets & (table.fresh_sets_covered == table.fresh_sets)
    table["cheap"] = table.covered & (table.ratio <= 1.15)
    groups = table.groupby(["plant", "model", "cover"], dropna=False, sort=False)
    counts = ["covered", "cheap", "settles", "covered_lost", "fresh_within"]
    result = groups[counts].sum()
    result.insert(0, "rows", groups.size())
    result["smallest_coverage"] = groups.coverage.min()
    result["median_coverage"] = groups.coverage.median()
    result["median_ratio"] = groups.ratio.median()
    result["largest_ratio"] = groups.ratio.max()
    result["largest_needed"] = groups.coverage_needed.max()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plant", nargs="+", default=["dc_motor"])
    parser.add_argument("--seed", nargs="+", type=int, default=[0])
    parser.add_argument("--model", default="ssm")
    parser.add_argument("--order", type=int)
    parser.add_argument("--cover", type=float)
    parser.add_argument("--fresh", type=int, default=3)
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--to", type=Path)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--again", action="store_true")
    arguments = parser.parse_args()
    if arguments.table is not None:
        print(summary(arguments.table).to_string(float_format=lambda value: f"{value:.3f}"))
        return
    for seed in arguments.seed:
        for plant in arguments.plant:
            key = {"plant": plant, "model": arguments.model, "seed": seed}
            key |= {"order": arguments.order or "", "cover": arguments.cover or ""}
            there = any(
                all(row[name] == str(key[name]) for name in KEY)
                for row in rows_of(arguments.to or Path("none"))
            )
            if there and not arguments.again:
                continue
            row = row_of(arguments, plant, seed)
            print(row, flush=True)
            if arguments.to is not None:
                keep(arguments.to, [row], KEY, lambda one: [str(one[name]) for name in KEY])


if __name__ == "__main__":
    main()
