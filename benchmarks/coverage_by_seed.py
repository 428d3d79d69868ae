"""How many designs come out covered, and what that costs in settling time: seeds and plants.

    python -m benchmarks.coverage_by_seed --plant dc_motor --seed 0 1 2 --to
    results/reference/certificates/coverage.csv
    python -m benchmarks.coverage_by_seed --table results/reference/certificates/coverage.csv

Per row, on one model of one data seed, as `ssm-study run plant=... seed=...` makes it: the choice
of `auto` without the proof (`plain_`) and the one that prefers covered designs, each on the
simulated plant from ten starts with noise; the coverage of the latter, decided exactly, and its
reason where it is null; what fresh data sets need, and in how many of them the disc holds in time,
too. Plants are those of the project, of `benchmarks/adversarial` and of
`benchmarks/aside_plants.py`. A row takes 20 to 60 s of one core (`--jobs` runs several at once);
each is written when it is there, and rows that stand in the file are left as they are, unless
`--again`.
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

from benchmarks.adversarial import __main__ as adversarial
from benchmarks.aside_plants import ASIDE
from benchmarks.common import add_table_options, finished_results, keep, rows_of, study_of
from benchmarks.steep_plants import STEEP
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import collect_findings
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.models.metrics import Simulation
from ssm_study.plants.plant import Plant
from ssm_study.robustness.coverage import (
    ModelErrorSpectra,
    measure_error_spectra,
    running_constraint_sum,
)
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.record_errors import RecordErrors, open_loop_errors
from ssm_study.signals import DataSet
from ssm_study.synthesis import auto
from ssm_study.synthesis.decay_response import simulate_decays
from ssm_study.synthesis.measured_discs_choice import choose_covering_design
from ssm_study.synthesis.measured_discs_run import (
    add_coverage_certificate,
    coverage_columns,
    coverage_needed_column,
    disc_weights,
    relative_radii_for_further_data,
)

KEY = ("plant", "model", "order", "seed", "cover")
TRANSIENT = 0.1  # of the reference: a running sum may end as far above zero


@dataclass(frozen=True, kw_only=True)
class RowTask:
    """What one row of the table is about."""

    plant: str
    model: str
    seed: int
    order: int | None
    cover: float | None
    fresh: int
    settings: tuple[str, ...] = ()

    @property
    def key(self) -> dict[str, Any]:
        """The cells by which a row is told from others."""
        return {
            "plant": self.plant,
            "model": self.model,
            "seed": self.seed,
            "order": self.order or "",
            "cover": self.cover or "",
        }

    @property
    def overrides(self) -> list[str]:
        """The run's settings."""
        settings = [f"model={self.model}", *self.settings]
        if self.order is not None:
            settings.append(f"model.order={self.order}")
        if self.cover is not None:
            settings.append(f"synthesis.cover={self.cover}")
        return settings


def plant_of(name: str) -> Plant:
    """The plant of this name, of the project or of a benchmark."""
    written_here = {**ASIDE, **STEEP}
    return written_here[name]() if name in written_here else adversarial.plant_of(name)


@dataclass(frozen=True, kw_only=True)
class IdentifiedCase:
    """One plant, its records, the model of them and what they show of its mismatch."""

    parts: Any
    plant: Plant
    data: DataSet
    model: Any
    mismatch: Mismatch
    premise: ModelErrorSpectra
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
        model = parts.reduction.reduce_model(trained)
        records = data.validation, data.start_up_samples, data.mismatch_records
        mismatch = measure_model_error(model, *records)
        start_up = data.start_up_samples
        premise = measure_error_spectra(
            model, data.validation, mismatch, start_up, data.mismatch_records
        )
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

            return choose_covering_design(pairs, make_and_note, *others)

        balls = certified_balls(self.model)
        with patch.object(auto, "choose_covering_design", prefer_and_note):
            decays = simulate_decays(self.model, self.data.mismatch_records, self.data.validation)
            chosen: Design = (
                synthesis.prefer_covered_designs(self.premise)
                .prefer_faster_than_decays(decays)
                .design(self.model, balls, self.data.validation, self.mismatch)
            )
        plain = certified[0] if certified else chosen
        return plain, add_coverage_certificate(chosen, self.model, balls, self.premise)

    def holds_in_time(self, design: Design, records: Any) -> bool:
        """Whether the disc of a design's proof holds along fresh records in open loop, as a running
        sum: over the second of two equal periods it grows no more than the noise explains, or by
        `TRANSIENT` of its reference."""
        part = design.extra_certificates.get("coverage")
        if not isinstance(part, MeasuredDiscs):
            return False
        trials = records.mismatch_records
        start_up = self.data.start_up_samples
        errors = open_loop_errors(self.model, records.validation, trials, start_up)
        periodic = [error for error in errors if error.period is not None and error.u.any()]
        return all(growth_of_sum(part, error) <= TRANSIENT for error in periodic)

    def columns(self, design: Design) -> dict[str, Any]:
        """Prediction and loop of one design."""
        facts: dict[str, Any] = {}
        if not design.feasible:
            return facts
        balls = certified_balls(self.model)
        prediction = predict_margins(self.model, design.gain_pair, balls, self.mismatch)
        facts["predicted"] = prediction.predicts_stability(self.parts.synthesis.margin)
        controller = ObserverFeedback.from_design(self.model, design)
        loop = self.parts.loop.with_default_horizon(self.model)
        runs = loop.run_on_plant(self.plant, controller, self.parts.loop_seed)
        loop_columns = behaviour_columns(runs)
        names = ("stable_count", "settling_time_mean_s", "settling_time_open_loop_s")
        return facts | {name: loop_columns[name] for name in names}


def growth_of_sum(part: MeasuredDiscs, record: RecordErrors) -> float:
    """By how much the running sum of a disc's constraint grows over the second period of a record,
    in shares of the reference there, beyond three standard errors of white noise.

    The noise is the difference of both periods; the mean of e, an offset that no disc bounds, is
    left out.
    """
    assert record.period is not None
    period = record.period
    second = slice(record.start + period, record.start + 2 * period)
    first = slice(record.start, record.start + period)
    e = record.e - record.e[second].mean(axis=0)
    variance = float(((record.e[second] - record.e[first]) ** 2).sum()) / 2 / period
    sums = running_constraint_sum(
        disc_weights(part), part.centre, part.kappa, record.u, record.model, e
    )
    deviation = float(((e - part.centre * record.model)[second] ** 2).sum())
    growth = float(sums[second][-1] - sums[second.start - 1]) - period * variance
    reference = deviation - float(sums[second][-1] - sums[second.start - 1])
    error = 3 * np.sqrt(2 * period * variance**2 + 4 * variance * max(deviation, 0.0))
    return (growth - error) / reference


def have_same_gains(first: Design, second: Design) -> bool:
    """Whether two designs deploy the same gains."""
    if not (first.feasible and second.feasible):
        return first is second
    gains = second.gains
    return all(np.array_equal(matrix, gains[name]) for name, matrix in first.gains.items())


def row_of(task: RowTask) -> dict[str, Any]:
    """One line of the table."""
    started = time.process_time()
    case = IdentifiedCase.of(task.plant, task.seed, task.overrides, task.fresh)
    identified = time.process_time()
    plain, chosen = case.choose()
    designed = time.process_time()
    fresh = list(case.parts.data.simulate_held_out_records(case.plant, task.seed))
    start_up = case.data.start_up_samples
    needs = relative_radii_for_further_data(
        chosen, case.model, case.premise, case.mismatch, fresh, start_up
    )
    row: dict[str, Any] = dict(task.key)
    row |= {
        "evidence": case.evidence,
        "rests": case.mismatch.plant_comes_to_rest,
        "fit_test": case.fit_percent,
    }
    row |= coverage_columns(chosen, case.model, case.premise) | coverage_needed_column(needs)
    columns = case.columns(chosen)
    plain_columns = columns if have_same_gains(plain, chosen) else case.columns(plain)
    row |= columns | {f"plain_{name}": value for name, value in plain_columns.items()}
    row["fresh_sets"] = len(needs)
    coverage = row.get("coverage")
    row["fresh_sets_covered"] = sum(coverage is not None and need <= coverage for need in needs)
    row["fresh_sets_in_time"] = sum(case.holds_in_time(chosen, records) for records in fresh)
    row["needs"] = " ".join(f"{need:.3f}" for need in needs)
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
    simulates_fresh_data = table.fresh_sets > 0
    table["fresh_within"] = simulates_fresh_data & (table.fresh_sets_covered == table.fresh_sets)
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
    parser.add_argument("--again", action="store_true")
    add_table_options(parser)
    arguments = parser.parse_args()
    if arguments.table is not None:
        print(summary(arguments.table).to_string(float_format=lambda value: f"{value:.3f}"))
        return
    file = arguments.to or Path("none")
    there = [] if arguments.again else [[row[name] for name in KEY] for row in rows_of(file)]
    tasks = []
    for plant in arguments.plant:
        for seed in arguments.seed:
            task = RowTask(
                plant=plant,
                model=arguments.model,
                seed=seed,
                order=arguments.order,
                cover=arguments.cover,
                fresh=arguments.fresh,
                settings=tuple(arguments.set),
            )
            if [str(task.key[name]) for name in KEY] not in there:
                tasks.append(task)
    for row in finished_results(row_of, tasks, arguments.jobs):
        print(row, flush=True)
        if arguments.to is not None:
            keep(arguments.to, [row], KEY, lambda one: [str(one[name]) for name in KEY])


if __name__ == "__main__":
    main()
