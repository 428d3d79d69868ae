"""What the files of a run and its configuration give, section by section: columns derived again and
findings.

Each section is a function of the run that yields `Checked` (a claim that holds or does not),
`Derived` (columns of the
record, to be compared) and `NotChecked` (what cannot be derived of this run, with the reason).
"""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssm_study.bounds.metrics import bound_facts
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import SIDES, WITHDRAWN, Infeasible, StateFeedback
from ssm_study.certificates.theorem import UNFIT, Theorem, condition, margin
from ssm_study.certificates.theorems.integral_action import (
    augmented,
    controlled_system,
    internal_model,
    output_gain,
)
from ssm_study.certificates.theorems.unlimited_start import UnlimitedStart
from ssm_study.columns import EIGENVALUE, ITERATED, ONE_FORMULA
from ssm_study.data import metrics as data_metrics
from ssm_study.durable import contents, unsealed
from ssm_study.engine.records import INFEASIBLE, OK, RECORD
from ssm_study.engine.settings import plain, run_name
from ssm_study.engine.store import MANIFEST, damaged_files
from ssm_study.evidence import metrics as evidence_metrics
from ssm_study.evidence.metrics import evidence_facts, withheld
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour, certified
from ssm_study.loop.rollout import Rollouts, replay_error
from ssm_study.models.metrics import Simulation, fit_facts, size_facts
from ssm_study.refusal import BadRequest
from ssm_study.robustness.coverage import measure_premise
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.signals import DataSet, input_limits
from ssm_study.study import recordings, trials
from ssm_study.study.line import STUDY, further
from ssm_study.study.recording_labels import mislabelled
from ssm_study.study.run_files import CONFIGURATION, OVERRIDES, RunFiles, one_line, unknown
from ssm_study.study.stages import DATASET, LOOPS, MODEL, SCORE, STAGES, read_judgement
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.input_inversion import shown_behind
from ssm_study.synthesis.measured_discs_run import coverage_facts
from ssm_study.synthesis.metrics import design_facts
from ssm_study.systems import System
from ssm_study.table.columns import BY_NAME, FURTHER, setting_of
from ssm_study.table.gather import PARQUET
from ssm_study.training.metrics import mean_fit

READ = frozenset({".csv", ".json", ".mcap"})  # the kinds of file that somebody reads as a run's
STAGES_OF_A_BASELINE = (DATASET, MODEL, SCORE)
MADE_OF_RUNS = "made from runs; ssm-study gather, report and export make them anew"
NOT_REPEATED = "training is not repeated (see ssm-study reproduce)"


@dataclass(frozen=True, kw_only=True)
class Checked:
    """One claim, whether it holds, and what was found."""

    claim: str
    holds: bool
    found: str

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}  {self.claim}: {self.found}"


@dataclass(frozen=True)
class Derived:
    """Columns as the run's files give them."""

    columns: Mapping[str, Any]


@dataclass(frozen=True)
class NotChecked:
    """Columns or files by name, each with the reason why it cannot be checked."""

    reasons: Mapping[str, str]


Claims = Iterator[Checked | Derived | NotChecked]


def files(run: RunFiles) -> Claims:
    """Every file that such a run leaves is there, sealed, and as it was written."""
    manifest = unsealed(contents(run.path / MANIFEST)) if (run.path / MANIFEST).is_file() else None
    sums = manifest["files"] if manifest else {}
    damaged = damaged_files(run.path, manifest) if manifest else [MANIFEST]
    changed = f"changed since: {', '.join(damaged)}"
    yield Checked(
        claim="files", holds=not damaged, found=changed if damaged else "as they were written"
    )
    if not (run.path / CONFIGURATION).is_file():
        yield Checked(claim=CONFIGURATION, holds=False, found="is absent")
        return
    needed = {CONFIGURATION, "model.json", "validation.mcap", "test.mcap", "excitation.mcap"}
    needed |= {"certificate.json", "evidence.json"} if run.claims_certificate else set()
    there = {CONFIGURATION, *(path.name for path in run.path.iterdir() if path.suffix in READ)} - {
        MANIFEST,
        RECORD,
    }
    stages = (*STAGES, trials.TRIALS) if run.claims_certificate else STAGES_OF_A_BASELINE
    made = {CONFIGURATION, OVERRIDES, *(name for stage in stages for name in stage.files)}
    made -= {"comparison.csv"} if run.specification.loop.comparison is None else set()
    for found, names in {
        "is absent": {name for name in needed if not (run.path / name).is_file()},
        "is not sealed": there - sums.keys(),
        "no stage of such a run writes it": sums.keys() - made,
    }.items():
        yield from (Checked(claim=name, holds=False, found=found) for name in sorted(names))
    yield NotChecked({"runs.parquet, runs.csv, report.html, figures and exports": MADE_OF_RUNS})
    repeated = ("training_curve.json, choice.json", "certificate.json seconds, solver_status")
    yield NotChecked(
        dict.fromkeys(repeated, NOT_REPEATED) | {OVERRIDES: "the configuration alone says what ran"}
    )
    if run.specification.loop.comparison is not None:
        yield NotChecked({"comparison.csv": "its loops are not kept"})
    if isinstance(run.specification.refine, int):
        yield NotChecked(
            {trials.TRIED: "its loops are made again; that these designs were chosen is not"}
        )


def requested(run: RunFiles) -> Claims:
    """The settings are those of the configuration, and the run's name is its hash."""
    name, hashed = (
        str(run.config.run),
        run_name(run.config),
    )  # what a name shows before its hash is the user's choice
    yield Derived(
        {"study": str(run.config.study), "run": name if name.endswith(hashed) else f"...-{hashed}"}
    )
    study, folder = run.path.absolute().parent, run.path.absolute().name
    alone = folder == name or not ((study / PARQUET).exists() or (study / name).exists())
    told = (
        "stands once"
        if alone
        else f"counts as one more run of its study: delete it, or name it {name}"
    )
    yield Checked(claim="folder", holds=alone, found=f"{folder} {told}")
    # As it was stored: a record names the parts by what they were called then.
    configuration = plain(run.config)
    specification = replace(run.specification, configuration=configuration)
    named = [setting_of(name) for name in run.record if FURTHER.covers(name)]
    asked = STUDY.parameters(specification) | further(configuration, named)
    # The record holds the rates of the design, which the theorem may have chosen itself.
    designed = {"rate_controller", "rate_observer"} if run.claims_certificate else set()
    yield Derived({name: value for name, value in asked.items() if name not in designed})
    for name in sorted(designed & {name for name, rate in asked.items() if rate is not None}):
        same = run.record.get(name) == asked[name]
        yield Checked(claim=f"synthesis.{name}", holds=same, found=f"{asked[name]} was requested")


def status(run: RunFiles) -> Claims:
    """A run is infeasible exactly if a part of its design is missing."""
    yield Derived(
        {"status": OK if not run.claims_certificate or run.design.feasible else INFEASIBLE}
    )


def data(run: RunFiles) -> Claims:
    """The records are those that the configuration gives, simulated or read anew.

    A recording of somebody else's may be elsewhere by now: then what follows from it is not
    checked.
    """
    try:
        records = run.data
    except (BadRequest, OSError) as error:
        if run.specification.plant is not None and not run.specification.plant.real:
            raise
        reason = f"the recorded data cannot be read: {one_line(error)}"
        columns = (*data_metrics.COLUMNS, *evidence_metrics.COLUMNS, BY_NAME["fit_train_percent"])
        names = [column.name for column in columns if not column.setting]
        names += [name for name in run.record if name.startswith("score_test_")]
        names += ["excitation.mcap", "evidence.json", "labels of recordings", "predicted_stable"]
        yield NotChecked(dict.fromkeys(names, reason))
    else:
        yield from data_read(run, records)


def data_read(run: RunFiles, records: DataSet) -> Claims:
    """The columns and recordings that follow from the records."""
    with warnings.catch_warnings(action="ignore"):  # the warning is a column
        yield Derived(data_metrics.data_facts(records))
    yield Derived({"fit_train_percent": mean_fit(run.model, records.training, records)})
    for split in ("validation", "test"):
        kept, made = getattr(run.simulated, split), getattr(records, split)
        pairs = recordings.of_records(kept.records, made)
        pairs["start_up_samples"] = kept.start_up_samples, records.start_up_samples
        yield agreement(f"{split}.mcap records", pairs, ITERATED, "the configuration gives them")
    if records.mismatch_records or run.trials:
        pairs = recordings.of_records(run.trials, records.mismatch_records)
        yield agreement(f"{recordings.TRIALS} records", pairs, ITERATED, "made again alike")
    if run.claims_certificate:
        judged, stated = evidence_facts(run.judgement), evidence_facts(read_judgement(run.path))
        found = f"records and model give {judged['evidence']}"
        yield Checked(claim="evidence.json", holds=stated == judged, found=found)
        yield Derived(judged)
    if "benchmark" in records.metadata:
        scores_again = data_metrics.benchmark_rmse(records, run.simulated.test.simulated)
        yield Derived({f"score_test_{i + 1}": score for i, score in enumerate(scores_again)})
    inputs = {
        f"u {i}": (u, one.u)
        for i, (u, one) in enumerate(zip(run.inputs, records.training, strict=True))
    }
    yield agreement("excitation.mcap", inputs, ITERATED, "the configuration gives it")
    for file, wrong in mislabelled(run, records):
        found = (
            f"not those of the run: {', '.join(wrong)}"
            if wrong
            else "times, names, units and words are the run's"
        )
        yield Checked(claim=f"{file} labels", holds=not wrong, found=found)


def model(run: RunFiles) -> Claims:
    """What is proved of the stored model, and that it runs at the records' sampling time."""
    if run.claims_certificate:
        yield Derived(bound_facts(run.model) | size_facts(run.model))
        steps = run.model.step_s, run.simulated.validation.records[0].step_s
        yield agreement("model.json step_s", {"step_s": steps}, ONE_FORMULA, "that of the records")
    yield entries(run, "model.json", run.model)


def entries(run: RunFiles, file: str, read: Any) -> Checked:
    """Whether the file says only what its reader reads."""
    extra = unknown(run.stored(file), read.to_json())
    return Checked(
        claim=f"{file} entries",
        holds=not extra,
        found=f"unknown: {', '.join(extra)}" if extra else "known",
    )


def certificate(run: RunFiles) -> Claims:
    """Both theorems in exact rational arithmetic on the stored matrices, and the columns that
    follow from them."""
    design, system, spec = run.design, run.model.system, run.specification.loop
    balls, feedback = certified_balls(run.model), run.design.state_feedback
    controlled = requested_system(run)
    broken = failed_checks(run.certificate, system, balls, controlled)
    yield entries(run, "certificate.json", design)
    if unfit := [sentence for sentence in broken if sentence.endswith(UNFIT)]:
        yield Checked(claim="certificate.json", holds=False, found="; ".join(unfit))
        return
    yield NotChecked({f"certificate.{label}": WITHDRAWN for label in design.withdrawn})
    for label, part in design.content.items():
        wrong = [
            sentence for sentence in broken if re.match(rf"{label}\b", sentence)
        ] + information(part)
        if label in SIDES and part.method != run.record.get("synthesis_method"):
            wrong.append(f"method {part.method}: another one was requested")
        why = part.reason if isinstance(part, Infeasible) else part.solver_status
        found = f"exact arithmetic finds it {'certified' if part.certified else f'without certificate: {why}'}"
        at = f" at rate {part.rate:.6g}" if hasattr(part, "rate") else ""
        yield Checked(
            claim=f"certificate.{label}{at}", holds=not wrong, found="; ".join(wrong) or found
        )
    if (words := getattr(run.specification.synthesis, "modes", ())) and isinstance(
        feedback, StateFeedback
    ):
        asked = internal_model(words, run.model.step_s, run.model.scale.outputs)
        made = {"modes": (feedback.a[run.model.order :, run.model.order :], asked)}
        yield agreement(
            "certificate internal model", made, ONE_FORMULA, f"{', '.join(words)} was requested"
        )
    told = {
        label: part
        for label, part in design.extra_certificates.items()
        if isinstance(part, UnlimitedStart)
    }
    ends = run.model.scale.scaled_input(
        np.stack(input_limits(spec.input_lower, spec.input_upper, run.applied))
    ).T
    pairs = {label: (part.limits, ends) for label, part in told.items()}
    yield from (
        [agreement("certificate limits", pairs, ONE_FORMULA, "given, or the records' range")]
        if told
        else []
    )
    kept = run.simulated.validation
    shown = (shown_behind if design.inverts else measure_mismatch)(
        run.model, kept.records, kept.start_up_samples, run.trials
    )
    facts = design_facts(design, run.model, balls, shown)
    facts |= coverage_again(run)
    yield Derived(withheld(facts, run.record.get("evidence")))


def coverage_again(run: RunFiles) -> dict[str, Any]:
    """The columns of the coverage, from the run's own recordings: what they need is measured
    again."""
    kept, test = run.simulated.validation, run.simulated.test
    records = kept.records, kept.start_up_samples, run.trials
    shown = measure_mismatch(run.model, *records)
    premise = measure_premise(run.model, kept.records, shown, kept.start_up_samples, run.trials)
    fresh = None
    if run.specification.plant is None:
        fresh = measure_premise(run.model, test.records, shown, test.start_up_samples)
    return coverage_facts(run.design, run.model, premise, fresh)


def requested_system(run: RunFiles) -> System:
    """What the state feedback is certified for, or would be: the model, and the internal model.

    A design without a state feedback states none, so the one that was requested counts.
    """
    feedback = run.design.state_feedback
    if isinstance(feedback, StateFeedback):
        return controlled_system(run.model, feedback)
    words = getattr(run.specification.synthesis, "modes", ())
    if not words:
        return run.model.system
    modes = internal_model(words, run.model.step_s, run.model.scale.outputs)
    return augmented(run.model.system, output_gain(run.model), modes)


def information(part: Theorem | Infeasible) -> list[str]:
    """What stands beside the matrices and decides nothing: the margin and the condition number,
    derived again."""
    if isinstance(part, Infeasible):
        return []
    again = margin(next(iter(part.as_floats(**part.numbers).values())))
    wrong = (
        []
        if abs(again - part.margin) <= ITERATED * abs(again) + EIGENVALUE
        else [f"margin: it is {again:.6g}"]
    )
    number = condition(getattr(part, part.metric_matrix))
    return wrong + (
        [] if abs(number / part.condition - 1) <= ITERATED else [f"condition: it is {number:.6g}"]
    )


def fits(run: RunFiles) -> Claims:
    """The stored model replays the stored simulations, and the errors are theirs."""
    again = {}
    for split in ("validation", "test"):
        kept = getattr(run.simulated, split)
        made = Simulation.of(run.model, kept.records, kept.start_up_samples)
        pairs = {
            str(i): pair for i, pair in enumerate(zip(kept.simulated, made.simulated, strict=True))
        }
        yield agreement(f"{split}.mcap /simulated", pairs, ONE_FORMULA, "model.json replays it")
        again[split] = made
    yield Derived(fit_facts(again["validation"], again["test"]))


def loop(run: RunFiles) -> Claims:
    """The recorded loops are those of the stored model and gains on the configured plant; the
    columns are theirs."""
    there = {name for name in LOOPS if (run.path / name).is_file()}
    needed = {"closed_loop.mcap", "closed_loop_model.mcap"} if run.closes_loop else set()
    needed |= {"comparison.csv"} if run.closes_loop and run.specification.loop.comparison else set()
    yield from (
        Checked(claim=name, holds=False, found="is absent") for name in sorted(needed - there)
    )
    if not run.closes_loop:
        yield from (
            Checked(claim=name, holds=False, found="such a run closes no loop")
            for name in sorted(there)
        )
        return
    spec, plant, controller = (
        run.specification,
        run.plant,
        ObserverFeedback.of(run.model, run.design),
    )
    kept, loop_on = recordings.read_experiment(run.path)
    apart = replay_error(controller, kept.controlled, run.loop.limits)
    said = f"the certified gains give it from the measured output to {apart:.1e}"
    yield Checked(claim="closed_loop.mcap input", holds=apart <= ITERATED, found=said)
    same = loop_on == recordings.closed_on(spec.plant)
    yield Checked(claim="closed_loop.mcap loop_on", holds=same, found=f"recorded on the {loop_on}")
    yield Derived({"loop_on": loop_on} | behaviour(kept) | certified(kept, run.design))
    fitted = run.loop.fitted(run.model)
    on_model = fitted.on_model(plant, controller, kept.controlled.y[:, 0])
    made: dict[str, tuple[Rollouts | None, Rollouts | None]] = {
        "closed_loop_model.mcap": (kept.on_model, on_model)
    }
    if plant.real:
        yield NotChecked(
            {"closed_loop.mcap output, states": "recorded on a device, which is not run again"}
        )
    else:
        again = fitted.on_plant(plant, controller, spec.loop_seed)
        pairs = recordings.of_rollouts(kept.controlled, again.controlled)
        pairs |= {
            name: (getattr(kept, name), getattr(again, name))
            for name in ("settling_band", "input_equilibrium")
        }
        pairs["uncontrolled"] = kept.uncontrolled.y, again.uncontrolled.y
        yield agreement(
            "closed_loop.mcap",
            pairs,
            ITERATED,
            "the configured plant with the certified gains gives it",
        )
        made[recordings.NOISE_FREE] = kept.noise_free, again.noise_free
    for name, pair in made.items():
        if pair != (None, None):
            yield agreement(
                name, recordings.of_rollouts(*pair), ITERATED, "stored model and gains give it"
            )


def agreement(
    claim: str, pairs: Mapping[str, tuple[Any, Any]], tolerance: float, said: str
) -> Checked:
    """Whether each stored value is the one made again, to `tolerance` of its largest entry."""
    apart = {name: recordings.distance(*pair) for name, pair in pairs.items()}
    worst = max(apart, key=lambda name: apart[name])
    wrong = [name for name in apart if not apart[name] <= tolerance]  # so written that NaN is wrong
    found = (
        f"{said} to {apart[worst]:.1e}"
        if not wrong
        else f"{', '.join(wrong)} differ by up to {apart[worst]:.1e}"
    )
    return Checked(claim=claim, holds=not wrong, found=found)


SECTIONS: tuple[Callable[[RunFiles], Claims], ...] = (
    files,
    requested,
    status,
    data,
    model,
    certificate,
    fits,
    loop,
)
OF_A_BASELINE = (files, requested, status, data, model, fits)
