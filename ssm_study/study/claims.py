"""Checks of the settings and results that the files of a finished run state. Columns and findings
are recomputed from its files and its configuration.

Each section is a function of the run that yields `CheckedClaim` (a claim that holds or does not),
`DerivedColumns` (columns of the record, to be compared) and `UncheckedValues` (what cannot be
derived of this run, with the reason).
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssm_study.bounds.metrics import model_bound_columns
from ssm_study.columns import ITERATED, ONE_FORMULA
from ssm_study.data import metrics as data_metrics
from ssm_study.engine.records import INFEASIBLE, OK
from ssm_study.engine.settings import plain_settings
from ssm_study.evidence import metrics as evidence_metrics
from ssm_study.evidence.metrics import evidence_columns
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import Rollouts, replay_error
from ssm_study.loop.textbook_pi import textbook_pi_columns
from ssm_study.models.members import NAMES, member_columns
from ssm_study.models.metrics import Simulation, fit_columns, model_size_columns, numbered_columns
from ssm_study.models.warm_start import choose_initial_state_source, initial_state_columns
from ssm_study.signals import DataSet
from ssm_study.study.design_claims import check_certificate
from ssm_study.study.file_claims import NOT_CHOSEN_AGAIN, NOT_REPEATED, check_files
from ssm_study.study.findings import (
    CheckedClaim,
    Claims,
    DerivedColumns,
    UncheckedValues,
    UnconfirmableSettings,
    check_agreement,
    check_unknown_entries,
)
from ssm_study.study.line import STUDY, undeclared_number_columns
from ssm_study.study.loop_recordings import (
    NOISE_FREE,
    loop_place_label,
    loop_signal_pairs,
    read_loop_recordings,
)
from ssm_study.study.name_claims import check_folder_name, expected_run_name
from ssm_study.study.recording_labels import find_wrong_labels
from ssm_study.study.recordings import TRIALS, record_signal_pairs
from ssm_study.study.run_files import RunFiles
from ssm_study.study.stages.evidence import read_judgement
from ssm_study.study.stages.loop import LOOPS
from ssm_study.study.stages.model import read_averaged_models
from ssm_study.study.unreached_numbers import unverifiable_numbers
from ssm_study.table.columns import BY_NAME, FURTHER, setting_path
from ssm_study.training.metrics import records_fit_percent

# Settings that no other file of the run would contradict, by their reason.
UNSUPPORTED = {
    NOT_REPEATED: ("training.", "model.starts", "model.draws"),
    NOT_CHOSEN_AGAIN: ("synthesis.",),
}


def check_settings(run: RunFiles) -> Claims:
    """Check that the recorded settings of a run equal its configuration, and that the run's name
    has their hash."""
    yield DerivedColumns({"study": str(run.config.study), "run": expected_run_name(run)})
    yield check_folder_name(run.path.absolute(), str(run.config.run))
    # As it was stored: a record names the parts by what they were called then.
    configuration = plain_settings(run.config)
    specification = replace(run.specification, configuration=configuration)
    further_settings = [
        setting_path(column) for column in run.record if FURTHER.matches_name(column)
    ]
    settings = STUDY.parameters(specification) | undeclared_number_columns(
        configuration, further_settings
    )
    # The record holds the rates of the design, which the theorem may have chosen itself.
    rates = ("rate_controller", "rate_observer") if run.has_certifiable_model else ()
    columns = {name: value for name, value in settings.items() if name not in rates}
    yield from split_confirmable_settings(columns)
    for rate in rates:
        value = settings.get(rate)
        if value is not None:
            is_same = run.record.get(rate) == value
            yield CheckedClaim(
                claim=f"synthesis.{rate}", holds=is_same, found=f"{value} was requested"
            )


def split_confirmable_settings(
    columns: Mapping[str, Any],
) -> Iterator[DerivedColumns | UnconfirmableSettings]:
    """Split the recorded settings of a run into those that results can confirm and those that
    affect no result."""
    remaining = dict(columns)
    for reason, prefixes in UNSUPPORTED.items():
        names = [name for name in remaining if (setting_path(name) or name).startswith(prefixes)]
        repeated = {name: remaining.pop(name) for name in names}
        yield UnconfirmableSettings(repeated, reason)
    yield DerivedColumns(remaining)


def check_status(run: RunFiles) -> Claims:
    """Check that a run is recorded as infeasible exactly if its design lacks a controller or
    observer."""
    is_feasible = not run.has_certifiable_model or run.design.feasible
    yield DerivedColumns({"status": OK if is_feasible else INFEASIBLE})


def check_records(run: RunFiles) -> Claims:
    """Check a run's measured or simulated data against its configuration, by simulating or reading
    the data again.

    If a log is no longer where it was, the values that follow from it are not checked.
    """
    reason = run.missing_log_reason
    if reason:
        columns = (*data_metrics.COLUMNS, *evidence_metrics.COLUMNS, BY_NAME["fit_train_percent"])
        names = [column.name for column in columns if not column.setting]
        names += [name for name in run.record if name.startswith("score_")]
        names += ["piece_start", "fit_test_other_start_percent"]
        names += [name for name in NAMES if name in run.record]
        names += ["excitation.mcap", "evidence.json", "labels of recordings", "predicted_stable"]
        names += ["validation.mcap, as measured", "test.mcap, as measured"]
        yield UncheckedValues(dict.fromkeys(names, reason))
    else:
        yield from check_record_columns(run, run.data)


def check_record_columns(run: RunFiles, records: DataSet) -> Claims:
    """Check the recorded values and recordings that are computed from the data set of a run."""
    with warnings.catch_warnings(action="ignore"):  # the warning is a column
        yield DerivedColumns(data_metrics.data_set_columns(records))
    yield DerivedColumns(
        {"fit_train_percent": records_fit_percent(run.model, records.training, records)}
    )
    for split in ("validation", "test"):
        stored = getattr(run.model_run, split)
        pairs = record_signal_pairs(stored.records, getattr(records, split))
        pairs["start_up_samples"] = stored.start_up_samples, records.start_up_samples
        yield check_agreement(
            f"{split}.mcap records", pairs, ITERATED, "the configuration gives them"
        )
        yield from check_initial_states(run, records, split)
    yield DerivedColumns(initial_state_columns(run.model, records, run.model_run.test))
    yield DerivedColumns(member_columns(read_averaged_models(run.path), records))
    if records.mismatch_records or run.mismatch_records:
        pairs = record_signal_pairs(run.mismatch_records, records.mismatch_records)
        yield check_agreement(f"{TRIALS} records", pairs, ITERATED, "made again alike")
    if run.has_certifiable_model:
        judged = evidence_columns(run.judgement)
        stated = evidence_columns(read_judgement(run.path))
        observation = f"records and model give {judged['evidence']}"
        if stated != judged:
            observation = f"{observation}, with other findings than the file's"
        yield CheckedClaim(claim="evidence.json", holds=stated == judged, found=observation)
        yield DerivedColumns(judged)
    if "benchmark" in records.metadata:
        scores_again = data_metrics.benchmark_rmse(records, run.model_run.test.simulated)
        yield DerivedColumns(numbered_columns("score_test_", scores_again))
    excitation = excitation_pairs(run, records)
    yield check_agreement("excitation.mcap", excitation, ITERATED, "the configuration gives it")
    for file, wrong in find_wrong_labels(run, records):
        observation = "times, names, units and words are the run's"
        if wrong:
            observation = f"not those of the run: {', '.join(wrong)}"
        yield CheckedClaim(claim=f"{file} labels", holds=not wrong, found=observation)


def excitation_pairs(run: RunFiles, records: DataSet) -> dict[str, tuple[Any, Any]]:
    """Stored inputs and disturbances of the training records, each paired with its recomputed
    value."""
    inputs = [record.u for record in records.training]
    pairs = name_value_pairs(run.recorded_training_inputs, inputs, "u ")
    recomputed = [record.d for record in records.training if record.d is not None]
    pairs["disturbances"] = (len(run.training_disturbances), len(recomputed))
    if len(run.training_disturbances) == len(recomputed):
        pairs |= name_value_pairs(run.training_disturbances, recomputed, "d ")
    return pairs


def name_value_pairs(
    stored: Sequence[Any], recomputed: Sequence[Any], prefix: str = ""
) -> dict[str, tuple[Any, Any]]:
    """Pairs of a stored and a recomputed value, each under a name made of a given word and a
    running number."""
    pairs = zip(stored, recomputed, strict=True)
    return {f"{prefix}{number}": pair for number, pair in enumerate(pairs)}


def check_initial_states(run: RunFiles, records: DataSet, split: str) -> Iterator[CheckedClaim]:
    """Check that free runs of a model start from the kind of initial state that `record.json`
    states.

    Runs of version 0.1 had no choice: their initial states are estimated from the first samples.
    """
    stored = getattr(run.model_run, split).starts
    is_from_past = any(state is not None for state in stored)
    if not is_from_past and "piece_start" not in run.record:
        return
    starts = choose_initial_state_source(run.model, records)
    if is_from_past:
        pairs = name_value_pairs(stored, getattr(starts, split))
        yield check_agreement(
            f"{split}.mcap start_states", pairs, ITERATED, "the log's past gives it"
        )
    if starts.choice is None:
        return
    is_past_chosen = any(state is not None for state in starts.chosen_initial_states(split))
    agrees = starts.is_undecided or is_from_past == is_past_chosen
    observation = f"training and validation records prefer {starts.choice}"
    yield CheckedClaim(claim=f"{split}.mcap start", holds=agrees, found=observation)


def check_model(run: RunFiles) -> Claims:
    """Check the proved properties of the stored model of a run, and its sampling time."""
    if run.has_certifiable_model:
        yield DerivedColumns(model_bound_columns(run.model) | model_size_columns(run.model))
        steps = run.model.step_s, run.model_run.validation.records[0].step_s
        yield check_agreement(
            "model.json step_s", {"step_s": steps}, ONE_FORMULA, "that of the records"
        )
        yield UncheckedValues(unverifiable_numbers(run))
    yield check_unknown_entries(run, "model.json", run.model)


def check_fits(run: RunFiles) -> Claims:
    """Check that the stored model of a run reproduces the stored simulations and the recorded
    errors."""
    replayed: dict[str, Simulation] = {}
    for split in ("validation", "test"):
        stored = getattr(run.model_run, split)
        start_up = stored.start_up_samples
        replay = Simulation.simulate_records(run.model, stored.records, start_up, stored.starts)
        pairs = name_value_pairs(stored.simulated, replay.simulated)
        yield check_agreement(
            f"{split}.mcap /simulated", pairs, ONE_FORMULA, "model.json replays it"
        )
        replayed[split] = replay
    yield DerivedColumns(fit_columns(replayed["validation"], replayed["test"]))


def check_loops(run: RunFiles) -> Claims:
    """Check that a new simulation reproduces a run's recorded closed loops and the values computed
    from them."""
    yield from check_loop_files(run)
    if not run.can_close_loop:
        return
    controller = ObserverFeedback.from_design(run.model, run.design)
    stored, loop_on = read_loop_recordings(run.path)
    yield from check_loop_signals(run, controller, stored, loop_on)
    fitted = run.loop_experiment.with_default_horizon(run.model)
    on_model = fitted.run_on_model(run.plant, controller, stored.controlled.y[:, 0])
    pairs: dict[str, tuple[Rollouts | None, Rollouts | None]] = {
        "closed_loop_model.mcap": (stored.on_model, on_model)
    }
    measured = stored
    if run.plant.is_physical:
        reason = "recorded on a device, which is not run again"
        yield UncheckedValues({"closed_loop.mcap output, states": reason})
    else:
        again = fitted.run_on_plant(run.plant, controller, run.specification.loop_seed)
        yield check_loop_on_plant(stored, again)
        pairs[NOISE_FREE] = stored.noise_free, again.noise_free
        measured = replace(stored, quiet=again.quiet)  # no recording holds the run without noise
    yield DerivedColumns(
        {"loop_on": loop_on}
        | behaviour_columns(measured)
        | certified_bound_columns(stored, run.design)
    )
    for name, pair in pairs.items():
        if pair != (None, None):
            yield check_agreement(
                name, loop_signal_pairs(*pair), ITERATED, "stored model and gains give it"
            )


def check_textbook_pi(run: RunFiles) -> Claims:
    """Check the recorded results of a textbook PI controller by a new simulation on the configured
    plant."""
    specification = run.specification
    fitted = specification.loop.with_default_horizon(run.model)
    yield DerivedColumns(
        textbook_pi_columns(specification.plant, run.model, fitted, specification.loop_seed)
    )


def check_loop_files(run: RunFiles) -> Iterator[CheckedClaim]:
    """Check that a run has recordings of closed loops if and only if a loop was closed."""
    present = {name for name in LOOPS if (run.path / name).is_file()}
    if not run.can_close_loop:
        for name in sorted(present):
            yield CheckedClaim(claim=name, holds=False, found="such a run closes no loop")
        return
    needed = {"closed_loop.mcap", "closed_loop_model.mcap"}
    if run.specification.loop.comparison:
        needed.add("comparison.csv")
    for name in sorted(needed - present):
        yield CheckedClaim(claim=name, holds=False, found="is absent")


def check_loop_signals(
    run: RunFiles, controller: ObserverFeedback, stored: LoopRuns, loop_on: str
) -> Iterator[CheckedClaim]:
    """Check that the controller, fed with the recorded output of a closed loop, computes the
    recorded input. What the loop was closed on is checked, too."""
    error = replay_error(controller, stored.controlled, run.loop_experiment.limits)
    observation = f"the certified gains give it from the measured output to {error:.1e}"
    yield CheckedClaim(claim="closed_loop.mcap input", holds=error <= ITERATED, found=observation)
    holds = loop_on == loop_place_label(run.specification.plant)
    observation = f"recorded on the {loop_on}"
    yield CheckedClaim(claim="closed_loop.mcap loop_on", holds=holds, found=observation)


def check_loop_on_plant(stored: LoopRuns, recomputed: LoopRuns) -> CheckedClaim:
    """Check that the configured plant with the certified gains reproduces the recorded closed
    loops."""
    pairs = loop_signal_pairs(stored.controlled, recomputed.controlled)
    for name in ("settling_band", "input_equilibrium"):
        pairs[name] = getattr(stored, name), getattr(recomputed, name)
    pairs["uncontrolled"] = stored.uncontrolled.y, recomputed.uncontrolled.y
    source = "the configured plant with the certified gains gives it"
    return check_agreement("closed_loop.mcap", pairs, ITERATED, source)


SECTIONS: tuple[Callable[[RunFiles], Claims], ...] = (
    check_files,
    check_settings,
    check_status,
    check_records,
    check_model,
    check_certificate,
    check_fits,
    check_loops,
    check_textbook_pi,
)
OF_A_BASELINE = (check_files, check_settings, check_status, check_records, check_model, check_fits)
