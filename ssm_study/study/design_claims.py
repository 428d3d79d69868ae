"""Checks of the certificates of a run in exact arithmetic, and of the columns computed from
them."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import (
    BESIDE,
    OF_LIMITS,
    SIDES,
    WITHDRAWN,
    Infeasible,
    StateFeedback,
)
from ssm_study.certificates.theorem import (
    UNFIT,
    Theorem,
    scaled_condition_number,
    smallest_eigenvalue,
)
from ssm_study.certificates.theorems.integral_action import (
    augmented_system,
    controlled_system,
    internal_model,
    linear_output_gain,
)
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.certificates.theorems.unlimited_start import UnlimitedStart
from ssm_study.certificates.withdrawn_parts import TOLERANCE
from ssm_study.columns import EIGENVALUE, ITERATED, ONE_FORMULA
from ssm_study.data.simulated import SimulatedData
from ssm_study.engine.records import VERSION
from ssm_study.evidence.metrics import withhold_predictions
from ssm_study.models.identified import SSM
from ssm_study.robustness.coverage import ModelErrorSpectra, measure_error_spectra
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.signals import input_limits
from ssm_study.study.findings import (
    CheckedClaim,
    Claims,
    DerivedColumns,
    UncheckedValues,
    check_agreement,
    check_unknown_entries,
)
from ssm_study.study.run_files import RunFiles
from ssm_study.synthesis.deployed import scaled_equilibrium_states
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.expected_response import faster_response_column
from ssm_study.synthesis.measured_discs_run import (
    PART,
    UNPROVED,
    UNSOUGHT,
    add_coverage_certificate,
    chooses_gains_by_coverage,
    coverage_columns,
    coverage_needed_column,
    relative_radii_for_further_data,
)
from ssm_study.synthesis.metrics import design_columns
from ssm_study.synthesis.sine_judgement import (
    measure_error_with_simulated_sines,
    sine_columns,
    sine_coverage_columns,
)
from ssm_study.synthesis.withheld_coverage import withhold_coverage
from ssm_study.systems import JacobianBalls, System

NOT_SEARCHED_AGAIN = "the file claims no such proof; the search for one is not repeated"
COVERAGE_COLUMNS = ("coverage", "coverage_reason", "coverage_reference", "coverage_needed")


def check_certificate(run: RunFiles) -> Claims:
    """Check every certificate of a run in exact arithmetic, and the recorded values computed from
    the certificates."""
    design = run.design
    balls = certified_balls(run.model)
    sentences = failed_checks(
        run.certificate, run.model.system, balls, system_for_state_feedback(run)
    )
    yield check_unknown_entries(run, "certificate.json", design)
    misfits = [sentence for sentence in sentences if sentence.endswith(UNFIT)]
    if misfits:
        yield CheckedClaim(claim="certificate.json", holds=False, found="; ".join(misfits))
        return
    yield UncheckedValues({f"certificate.{label}": WITHDRAWN for label in design.withdrawn})
    if TOLERANCE in design.withdrawn:
        yield UncheckedValues({"certified_tolerance": WITHDRAWN})
    yield UncheckedValues(missing_certificate_reasons(run))
    for label, part in design.certificates_by_name.items():
        yield check_stored_certificate(run, label, part, sentences)
    yield from check_internal_model(run)
    yield from check_input_limits(run)
    yield from check_unlimited_initial_states(run)
    mismatch = remeasure_mismatch(run)
    facts = design_columns(design, run.model, balls, mismatch)
    facts |= recompute_coverage_columns(run)
    if not run.may_lack_columns("predicted_faster"):
        records = run.model_run.validation.records, run.mismatch_records
        facts |= faster_response_column(design, run.model, mismatch, *records)
    facts |= recompute_sine_columns(run, balls, mismatch, facts.get("coverage"))
    yield DerivedColumns(withhold_predictions(facts, run.record.get("evidence")))
    yield UncheckedValues(missing_column_reasons(run) | unrepeated_search_reason(run))


def missing_certificate_reasons(run: RunFiles) -> dict[str, str]:
    """Certificates that a design could also have but does not store, each with the reason why the
    search for it is not repeated."""
    design = run.design
    if not design.feasible:
        return {}
    possible = [label for label in BESIDE if isinstance(run.model, SSM) or label not in OF_LIMITS]
    stored = {*design.extra_certificates, *design.withdrawn}
    absent = [f"certificate.{label}" for label in possible if label not in stored]
    return dict.fromkeys(absent, NOT_SEARCHED_AGAIN)


def missing_column_reasons(run: RunFiles) -> dict[str, str]:
    """Columns that a record of an earlier version lacks, each with the reason.

    So a column that was removed from an older record is listed as not checked.
    """
    design = run.design
    if not design.feasible:
        return {}
    columns = ["predicted_faster"]
    if run.specification.has_sine_trials:
        columns.append("sine_margin")
        if run.record.get("coverage") is not None:
            columns.append("sine_coverage")
    reason = f"a record of version {run.record_version} need not have it"
    absent = [name for name in columns if run.may_lack_columns(name)]
    if lacks_coverage(run):
        absent += [name for name in COVERAGE_COLUMNS if run.record.get(name) is None]
    return dict.fromkeys(absent, reason)


def unrepeated_search_reason(run: RunFiles) -> dict[str, str]:
    """Reason why a failed search for a proof that covers the recorded model error is not repeated;
    otherwise empty."""
    is_unproved = run.record.get("coverage_reason") == UNPROVED
    if not is_unproved or is_coverage_search_repeated(run):
        return {}
    reason = "it is not repeated: it takes a minute and more, or is of an earlier version"
    return {"search for a proof of coverage": reason}


def lacks_coverage(run: RunFiles) -> bool:
    """Whether a run was written by an earlier version whose files do not state how much model error
    the stability proof covers."""
    is_claimed = any(run.record.get(name) is not None for name in COVERAGE_COLUMNS[:2])
    is_old = run.record_version < VERSION
    return is_old and not is_claimed and MeasuredDiscs.part not in run.design.extra_certificates


def check_stored_certificate(
    run: RunFiles, label: str, part: Theorem | Infeasible, sentences: list[str]
) -> CheckedClaim:
    """Check one stored certificate in exact arithmetic, and that it was made by the requested
    method."""
    wrong = [sentence for sentence in sentences if re.match(rf"{label}\b", sentence)]
    wrong += stored_number_errors(part)
    if label in SIDES and part.method != run.record.get("synthesis_method"):
        wrong.append(f"method {part.method}: another one was requested")
    reason = part.reason if isinstance(part, Infeasible) else part.solver_status
    verdict = "certified" if part.certified else f"without certificate: {reason}"
    at_rate = f" at rate {part.rate:.6g}" if hasattr(part, "rate") else ""
    observation = "; ".join(wrong) or f"exact arithmetic finds it {verdict}"
    return CheckedClaim(claim=f"certificate.{label}{at_rate}", holds=not wrong, found=observation)


def check_internal_model(run: RunFiles) -> Iterator[CheckedClaim]:
    """Check that the internal model in the state feedback of a run is the requested one."""
    words = getattr(run.specification.synthesis, "internal_model_signals", ())
    feedback = run.design.state_feedback
    if not words or not isinstance(feedback, StateFeedback):
        return
    order = run.model.order
    requested = internal_model(words, run.model.step_s, run.model.scale.outputs)
    pairs = {"modes": (feedback.a[order:, order:], requested)}
    source = f"{', '.join(words)} was requested"
    yield check_agreement("certificate internal model", pairs, ONE_FORMULA, source)


def check_input_limits(run: RunFiles) -> Iterator[CheckedClaim]:
    """Check that the certificates of a run use the input limits of its loop or of its records."""
    loop = run.specification.loop
    physical = np.stack(input_limits(loop.input_lower, loop.input_upper, run.training_inputs))
    limits = run.model.scale.scaled_input(physical).T
    pairs = {}
    for label, part in run.design.extra_certificates.items():
        if isinstance(part, UnlimitedStart):
            pairs[label] = (part.limits, limits)
    if pairs:
        source = "given, or the records' range"
        yield check_agreement("certificate limits", pairs, ONE_FORMULA, source)


def check_unlimited_initial_states(run: RunFiles) -> Iterator[CheckedClaim]:
    """Check the stored initial states for which a closed loop is proved never to reach an input
    limit."""
    model = run.model
    for part in run.design.extra_certificates.values():
        if isinstance(part, UnlimitedStart) and isinstance(model, SSM):
            yield check_stored_initial_states(part, scaled_equilibrium_states(model, part.starts))


def check_stored_initial_states(
    part: UnlimitedStart, starts: Float[np.ndarray, "S n"] | None
) -> CheckedClaim:
    """Check that the initial states in a certificate equal the initial states computed from the
    model."""
    claim = "certificate starts"
    if starts is None or starts.shape != part.starts.shape:
        observation = "the outputs at rest do not tell the states of this model"
        return CheckedClaim(claim=claim, holds=False, found=observation)
    source = "states at rest at the corners of a box of outputs"
    comparison = check_agreement(claim, {"starts": (part.starts, starts)}, ITERATED, source)
    derived_variables = part.variables | {"starts": starts}
    if comparison.holds and not part.holds(**derived_variables):
        problem = "beyond the level set where they are at rest"
        return CheckedClaim(claim=claim, holds=False, found=problem)
    return comparison


def remeasure_mismatch(run: RunFiles) -> Any:
    """Measure the model error again from the recordings of a run."""
    validation = run.model_run.validation
    return measure_model_error(
        run.model, validation.records, validation.start_up_samples, run.mismatch_records
    )


def recompute_coverage_columns(run: RunFiles) -> dict[str, Any]:
    """Recompute, from a run's recordings, the recorded values on how much model error the
    certificate covers."""
    if lacks_coverage(run):
        return {}  # a run of before these columns claims nothing of them
    validation = run.model_run.validation
    start_up = validation.start_up_samples
    mismatch = measure_model_error(run.model, validation.records, start_up, run.mismatch_records)
    spectra = measure_error_spectra(
        run.model, validation.records, mismatch, start_up, run.mismatch_records
    )
    fresh = None
    if run.specification.plant is None:
        test = run.model_run.test
        fresh = measure_error_spectra(run.model, test.records, mismatch, test.start_up_samples)
    design = run.design
    if is_coverage_search_repeated(run):
        # No word is believed: what the search finds is compared with what the record states.
        design = add_coverage_certificate(design, run.model, certified_balls(run.model), spectra)
    facts = coverage_columns(design, run.model, spectra, fresh)
    stated = run.record.get("coverage_reason")
    is_unproved = facts.get("coverage_reason") == UNPROVED
    if stated == UNSOUGHT and is_unproved and is_search_optional(run, spectra):
        facts["coverage_reason"] = UNSOUGHT
    facts |= recompute_fresh_data_column(run, spectra, mismatch)
    is_old = run.record_version < VERSION
    if not design.feasible or (is_old and run.record.get("coverage") is not None):
        return facts  # true of the proof; a run of before such numbers were withheld has them
    return withhold_coverage(facts, run.model, design.gain_pair)


def is_search_optional(run: RunFiles, spectra: ModelErrorSpectra) -> bool:
    """Whether a record may state that no proof was searched for. Earlier versions did not look for
    models with neurons whose records cannot separate noise from model error."""
    is_proved = PART in run.design.extra_certificates
    return not is_proved and not chooses_gains_by_coverage(run.model, None, spectra)


def is_coverage_search_repeated(run: RunFiles) -> bool:
    """Whether a run records that no proof covers its model error, and the search for a proof is
    fast enough to be repeated.

    With neurons it takes a minute and more; another version may have searched less.
    """
    is_unproved = run.record.get("coverage_reason") == UNPROVED
    return is_unproved and isinstance(run.model, SSM) and run.record_version == VERSION


def recompute_fresh_data_column(
    run: RunFiles, spectra: ModelErrorSpectra, mismatch: Mismatch
) -> dict[str, Any]:
    """Recompute, by simulating further data sets of the plant again, the largest ratio of their
    model error to the recorded one."""
    specification = run.specification
    if not specification.simulates_fresh_data:
        return {}
    assert isinstance(specification.data, SimulatedData)
    assert specification.plant is not None
    start_up = run.model_run.validation.start_up_samples
    fresh = specification.data.simulate_held_out_records(specification.plant, specification.seed)
    return coverage_needed_column(
        relative_radii_for_further_data(run.design, run.model, spectra, mismatch, fresh, start_up)
    )


def recompute_sine_columns(
    run: RunFiles, balls: JacobianBalls, mismatch: Mismatch, coverage: float | None
) -> dict[str, Any]:
    """Recompute the recorded results of single-sine tests by simulating the tests again. Empty for
    a run made before such tests existed; `coverage` is that over the run's records, which earlier
    runs did not compare with the sines."""
    specification = run.specification
    if run.may_lack_columns("sine_margin") or not specification.has_sine_trials:
        return {}
    sines = measure_error_with_simulated_sines(
        run.design,
        run.model,
        balls,
        mismatch,
        specification.data,
        specification.plant,
        specification.seed,
        only_peaks=run.may_lack_columns("sine_coverage"),
    )
    facts = sine_columns(run.design, run.model, balls, mismatch, sines)
    if not run.may_lack_columns("sine_coverage"):
        facts |= sine_coverage_columns(run.design, sines, coverage)
    return facts


def system_for_state_feedback(run: RunFiles) -> System:
    """System for which a state feedback is to be certified: the model, joined with an internal
    model if there is one.

    A design without a state feedback states none, so the one that was requested counts.
    """
    feedback = run.design.state_feedback
    if isinstance(feedback, StateFeedback):
        return controlled_system(run.model, feedback)
    words = getattr(run.specification.synthesis, "internal_model_signals", ())
    if not words:
        return run.model.system
    modes = internal_model(words, run.model.step_s, run.model.scale.outputs)
    return augmented_system(run.model.system, linear_output_gain(run.model), modes)


def stored_number_errors(part: Theorem | Infeasible) -> list[str]:
    """Sentences on wrong numbers that a certificate states beside its proof: margin and condition
    number."""
    if isinstance(part, Infeasible):
        return []
    again = smallest_eigenvalue(next(iter(part.float_conditions(**part.variables).values())))
    wrong = []
    # So written that NaN is wrong.
    if not abs(again - part.margin) <= ITERATED * abs(again) + EIGENVALUE:
        wrong.append(f"margin: it is {again:.6g}")
    number = scaled_condition_number(getattr(part, part.metric_matrix))
    if not abs(number / part.condition - 1) <= ITERATED:
        wrong.append(f"condition: it is {number:.6g}")
    return wrong
