"""Inequalities that a disc of model errors must satisfy to contain the error seen in every record.

A disc with two references bounds the mismatch `e = y - m` of the model's output m for the input u:

    sum |e - c m|^2  <=  kappa^2 sum ( floor^2 |m|^2 + |W m|^2 + |V u|^2 )

m bounds e where the model speaks, u where it is silent. A `DiscRequirement` is one piece of one
record's spectrum for which this must hold at `kappa = 1`: a band, a group of neighbouring bands,
the total. Where an input repeats, what does not repeat is noise: of two periods `D_1, D_2` of
`e - c m` the product `Re(D_1 conj D_2)` is the power that repeats, without bias. Below the largest
amplitude only what exceeds `SURE` standard errors counts, in totals whatever repeats. Where nothing
repeats, noise counts as mismatch. Source: docs/theory.md, "Measured discs".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model
from ssm_study.robustness.coverage_items import (
    DiscRequirement,
    requirement_from_sine,
    requirements_from_averaged_spectrum,
    requirements_from_periods,
)
from ssm_study.robustness.coverage_spectra import (
    AveragedSpectrum,
    MismatchSpectrum,
    Powers,
    averaged_spectrum,
    averaged_spectrum_in_loop,
    line_spectrum,
)
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import (
    estimate_noise,
    moving_closed_loop_errors,
    open_loop_errors,
)
from ssm_study.robustness.single_sines import has_single_sine_input, steady_sine_errors
from ssm_study.signals import Trajectories
from ssm_study.systems import StateSpace

INTEGRATES = (
    "the model integrates, so inputs of finite energy give outputs that have none, and no disc "
    "around them bounds a mismatch"
)
NOT_AT_REST = (
    "the plant does not come to rest by itself at rest input, so no record bounds its mismatch"
)
EMPTY = "no record moves the model's output, so nothing is known of the mismatch"
NO_MISMATCH = "the records show no mismatch at all, so there is nothing to compare the proof with"

FilterMatrix = Float[np.ndarray, "v v"]
OutputSignal = Float[np.ndarray, "T p"]


@dataclass(frozen=True, kw_only=True)
class DiscWeights:
    """Frequency weights of a disc of model errors, which say how large a model error is allowed at
    each frequency. `floor`, `W = [A_W, B_W; C_W, D_W]` on the model's output and V likewise on the
    input, one channel each.

    Stable, with poles and zeros inside the circle.
    """

    floor: float
    output: Float[np.ndarray, "v v"]
    input: Float[np.ndarray, "v2 v2"]

    def output_weight(self, angles: Powers) -> Powers:
        """Squared weight of the model's output in the allowed model error, at each frequency."""
        return self.floor**2 + squared_gain(self.output, angles)

    def input_weight(self, angles: Powers) -> Powers:
        """Squared weight of the input in the allowed model error, at each frequency."""
        return squared_gain(self.input, angles)

    def largest_required_radius(self, requirements: Sequence[DiscRequirement]) -> tuple[float, str]:
        """Smallest radius at which a disc contains the model errors in all records, and the record
        and band that determine the radius. It is infinite where a reference signal vanishes."""
        needs = [(self.required_radius(item), item.label) for item in requirements]
        return max(needs, default=(0.0, ""))

    def required_radius(self, requirement: DiscRequirement) -> float:
        """Smallest radius at which a disc contains the model error in one frequency range of a
        record."""
        if requirement.seen <= 0:
            return 0.0
        reference = self.reference_power(requirement)
        if not reference > 0:
            return float("inf")
        squared_radius = requirement.seen / reference
        return float(np.sqrt(squared_radius))

    def reference_power(self, requirement: DiscRequirement) -> float:
        """Weighted power of model output and input in one frequency range, to which the power of
        the model error is compared. `sum over the item's lines of (X model + Y input)`."""
        of_output = self.output_weight(requirement.angles) @ requirement.model_power
        of_input = self.input_weight(requirement.angles) @ requirement.input_power
        return float(of_output + of_input)


def squared_gain(filter_matrix: FilterMatrix, angles: Powers) -> Powers:
    """Squared gain of a single-channel weighting filter at each frequency. `|C (e^{jw} - A)^{-1} B
    + D|^2` of `[A, B; C, D]`."""
    order = len(filter_matrix) - 1
    a = filter_matrix[:order, :order]
    b = filter_matrix[:order, order:]
    c = filter_matrix[order:, :order]
    direct = filter_matrix[-1, -1]
    points = np.exp(1j * angles)[:, None, None]
    shifted = points * np.eye(order) - a
    b_at_each_angle = np.broadcast_to(b, (len(angles), order, 1))
    state_response = np.linalg.solve(shifted, b_at_each_angle)
    response = (c @ state_response)[:, 0, 0] + direct
    return np.asarray(np.abs(response) ** 2)


@dataclass(frozen=True, kw_only=True)
class ModelErrorSpectra:
    """Spectra of the model error in the records; a certificate whose disc contains all of them
    proves stability on the plant. `sines` are those of single sines; `reason` says why nothing can
    be covered, and is None where it can."""

    repeating: tuple[MismatchSpectrum, ...]
    averaged: tuple[AveragedSpectrum, ...]
    sines: tuple[MismatchSpectrum, ...] = ()
    reason: str | None = None

    def requirements(self, centre: float) -> list[DiscRequirement]:
        """Inequalities that a disc of model errors with a given centre must satisfy to contain the
        model error in every record. The repeating record with the largest amplitude counts without
        doubt."""
        amplitudes = [record.amplitude for record in self.repeating]
        largest = max(amplitudes, default=0.0)
        items = list[DiscRequirement]()
        for record in self.repeating:
            is_largest = record.amplitude == largest
            items += requirements_from_periods(record, centre, has_no_doubt=is_largest)
        items += [requirement_from_sine(record, centre) for record in self.sines]
        for averaged in self.averaged:
            items += requirements_from_averaged_spectrum(averaged, centre)
        return items

    @property
    def separates_noise(self) -> bool:
        """Whether some record repeats its input, so that noise can be separated from the model
        error."""
        return bool(self.repeating)

    def insufficient_records_reason(self, centre: float) -> str | None:
        """Reason why no disc of model errors with a given centre can be measured from the records;
        None if one can."""
        if self.reason is not None:
            return self.reason
        items = self.requirements(centre)
        moves_output = any(item.model_power.sum() > 0 for item in items)
        if not moves_output:
            return EMPTY
        shows_mismatch = any(item.seen > 0 for item in items)
        return None if shows_mismatch else NO_MISMATCH


def measure_error_spectra(
    model: Model,
    validation: Trajectories,
    mismatch: Mismatch,
    start_up_samples: int = 0,
    mismatch_records: Trajectories = (),
) -> ModelErrorSpectra:
    """Measure the spectra of the model error in the records, which the disc of a certificate must
    contain to prove stability on the plant. Where they are not enough, its `reason` says why."""
    reason = None
    if not mismatch.plant_comes_to_rest:
        reason = NOT_AT_REST
    elif model.linear.spectral_radius >= 1:
        reason = INTEGRATES
    in_open_loop = open_loop_errors(model, validation, mismatch_records, start_up_samples)
    driven = [run for run in in_open_loop if run.u.any()]
    with_period = [run for run in driven if run.period is not None]
    periodic = [run for run in with_period if not has_single_sine_input(run)]
    noise = estimate_noise(periodic) if periodic else None
    repeating = list[MismatchSpectrum]()
    averaged = list[AveragedSpectrum]()
    sines = list[MismatchSpectrum]()
    if noise is None:
        averaged += [averaged_spectrum(run) for run in driven]
    else:
        repeating += [line_spectrum(run, noise) for run in periodic]
        sines += [line_spectrum(run, noise) for run in steady_sine_errors(driven)]
    for run in moving_closed_loop_errors(model, mismatch_records, start_up_samples):
        averaged.append(averaged_spectrum_in_loop(run, noise))
    return ModelErrorSpectra(
        repeating=tuple(repeating), averaged=tuple(averaged), sines=tuple(sines), reason=reason
    )


def running_constraint_sum(
    weights: DiscWeights,
    centre: float,
    kappa: float,
    inputs: Float[np.ndarray, "T m"],
    model_outputs: OutputSignal,
    model_errors: OutputSignal,
) -> Float[np.ndarray, "T"]:
    """Running sum, along a record, of the quadratic constraint that bounds the model error by the
    weighted model output and input. `sum to T of |e - c m|^2 - kappa^2 (floor^2 |m|^2 + |W m|^2 +
    |V u|^2)`, filters at zero before the record."""
    deviation_signal = model_errors - centre * model_outputs
    deviation = (deviation_signal**2).sum(axis=1)
    weighted_output = apply_channel_filter(weights.output, model_outputs)
    weighted_input = apply_channel_filter(weights.input, inputs)
    output_power = (model_outputs**2).sum(axis=1)
    reference = weights.floor**2 * output_power
    reference += (weighted_output**2).sum(axis=1)
    reference += (weighted_input**2).sum(axis=1)
    excess = deviation - kappa**2 * reference
    return np.asarray(np.cumsum(excess))


def apply_channel_filter(
    filter_matrix: FilterMatrix, signal: Float[np.ndarray, "T c"]
) -> Float[np.ndarray, "T c"]:
    """Filter each channel of a signal by the same single-channel filter."""
    order = len(filter_matrix) - 1
    a = filter_matrix[:order, :order]
    b = filter_matrix[:order, order:]
    c = filter_matrix[order:, :order]
    d = filter_matrix[order:, order:]
    channel_filter = StateSpace(a=a, b=b, c=c, d=d)
    columns = []
    for i in range(signal.shape[1]):
        channel = signal[:, [i]]
        filtered, *_ = channel_filter.simulate(channel)
        columns.append(filtered)
    return np.concatenate(columns, axis=1)
