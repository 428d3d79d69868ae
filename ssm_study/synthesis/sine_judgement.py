"""Test of a chosen design by experiments with single-sine inputs, at the frequencies where its
closed loop is most sensitive.

The prediction is made again with what the sines show beside the other records; it stands only where
both predict stability. The proof covers the model error only if it covers that of the sines, too.
Source: docs/trust.md, "What is measured for it" and "Covered".
"""

from collections.abc import Sequence
from typing import Any

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage_items import requirement_from_measured_sine
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sine_trials import (
    SineMismatch,
    add_sines_to_mismatch,
    line_of_smallest_margin,
    measure_errors_at_sines,
    sensitive_spectral_lines,
)
from ssm_study.synthesis.measured_discs_run import disc_weights
from ssm_study.systems import JacobianBalls


def spectral_lines_to_test(
    design: Design,
    model: Model,
    balls: JacobianBalls,
    mismatch: Mismatch,
    period: int,
    *,
    only_peaks: bool = False,
) -> list[int]:
    """Spectral lines (multiples of the record's base frequency) at which a design is to be tested
    with single sines. Empty if the noise is unknown.
    `only_peaks`: those of earlier runs."""
    if not design.feasible or not mismatch.noise:
        return []
    lines = sensitive_spectral_lines(model, design.gain_pair, balls, period)
    if only_peaks:
        return lines
    deciding = line_of_smallest_margin(model, design.gain_pair, balls, mismatch, period)
    if deciding is not None and deciding not in lines:
        lines.append(deciding)
    return lines


def measure_error_with_simulated_sines(
    design: Design,
    model: Model,
    balls: JacobianBalls,
    mismatch: Mismatch,
    data: Any,
    plant: Any,
    seed: int,
    *,
    only_peaks: bool = False,
) -> list[SineMismatch]:
    """Measure the model error at a design's critical frequencies with single sines on the simulated
    plant."""
    from ssm_study.data.simulated import PERIOD

    lines = spectral_lines_to_test(design, model, balls, mismatch, PERIOD, only_peaks=only_peaks)
    records = data.simulate_sine_experiments(plant, seed, lines)
    return measure_errors_at_sines(model, records, mismatch, PERIOD)


def sine_columns(
    design: Design,
    model: Model,
    balls: JacobianBalls,
    mismatch: Mismatch,
    sines: Sequence[SineMismatch],
) -> dict[str, Any]:
    """Table columns of stability margin and prediction with single-sine experiments included;
    empty if no such experiment was made."""
    if not sines:
        return {}
    without = predict_margins(model, design.gain_pair, balls, mismatch)
    mismatch_with_sines = add_sines_to_mismatch(mismatch, sines)
    prediction = predict_margins(model, design.gain_pair, balls, mismatch_with_sines)
    is_stable_without = without.predicts_stability()
    both = is_stable_without and prediction.predicts_stability()
    return {"sine_margin": prediction.resolved_margin, "predicted_stable": both}


def sine_coverage_columns(
    design: Design, sines: Sequence[SineMismatch], coverage: float | None
) -> dict[str, Any]:
    """Table column with the ratio of the proved model error to the one measured in single-sine
    tests; no column without such tests.

    `coverage` is that over the run's records, None where nothing is covered. The premise must hold
    for the sines, too, so where they need more, theirs takes its place.
    """
    part = design.extra_certificates.get(MeasuredDiscs.part)
    if not sines:
        return {}
    if coverage is None or not isinstance(part, MeasuredDiscs):
        return {"sine_coverage": None}
    measured = [requirement_from_measured_sine(sine, part.centre) for sine in sines]
    items = [item for item in measured if item is not None]
    need, where = disc_weights(part).largest_required_radius(items)
    if need <= 0:
        return {"sine_coverage": None}
    sine_coverage = part.kappa / need
    facts: dict[str, Any] = {"sine_coverage": sine_coverage}
    if sine_coverage < coverage:
        facts |= {"coverage": sine_coverage, "coverage_reference": where}
    return facts
