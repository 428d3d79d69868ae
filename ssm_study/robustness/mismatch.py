"""Model error `e = y - y_model` in the records, by frequency and input amplitude, with noise
removed.

A closed loop maps `e` back to `u`; `robustness.prediction` says what it tolerates. What a record
shows of `e` holds where it has been, so there is one `ModelErrorAtAmplitude` for each amplitude:

    in total        g    = ||e||_2 / ||u||_2
    by frequency    g(w) = sqrt(S_e(w) / S_u(w)),            measured in every band: nothing stands
    in for it
    split           e    = Q y_model + r,   Q = S_(e, y_model) / S_(y_model),   g_r(w) = sqrt(S_r(w)
    / S_u(w))

r counts by size alone. What counts, and trials in closed loop (`MOVING`): docs/trust.md, "What is
measured for it".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model
from ssm_study.refusal import require
from ssm_study.robustness.bands import ANGLES, welch_power_density
from ssm_study.robustness.record_errors import (
    EXCITED,
    ModelErrorAtAmplitude,
    RecordErrors,
    estimate_noise,
    model_error_from_averages,
    model_error_from_periods,
    model_error_in_closed_loop,
    moving_closed_loop_errors,
    open_loop_errors,
)
from ssm_study.robustness.return_to_rest import (
    AT_REST,
    FAINT,
    is_return_to_rest,
    oscillation_amplitude,
    oscillations_and_offsets_after_returns,
    output_after_motion,
    remaining_offset,
)
from ssm_study.robustness.single_sines import (
    add_sine_errors,
    has_single_sine_input,
    measure_error_at_sine,
    steady_sine_errors,
)
from ssm_study.signals import Trajectories

Records = list[RecordErrors]
BandPowers = Float[np.ndarray, "F"]

# share of the farthest start on record (of the output's scale without one) that counts as settled
BAND = 0.05
# where friction leaves the output is uniform up to the worst; all of N below `p^(1/N)` of it:
# chance p
MISSED = 0.05


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """Measured model error (plant-model mismatch), by frequency and by input amplitude. All views,
    the smallest amplitude first. `spread`: standard error of the largest's `ln g`, from blocks.

    `left_at_rest`: the most that is left of the output at rest input, as a share of its scale; None
    without such a record. `unexcited`: bands without input power in the largest record. `loop`:
    what trials in closed loop show. `stuck`: what stays of the output at rest input after it has
    moved (friction, play), where more than `AT_REST`; `farthest`: from where a decay at rest input
    was recorded; both in output scales. `noise`: the sensor's, a sample's power at `ANGLES`, in
    squares of that scale, where an input repeats.
    """

    views: tuple[ModelErrorAtAmplitude, ...]
    loop: ModelErrorAtAmplitude | None = None
    spread: float = 0.0
    left_at_rest: float | None = None
    unexcited: tuple[float, ...] = ()
    stuck: tuple[float, ...] = ()
    farthest: float = 1.0
    noise: tuple[float, ...] = ()

    @property
    def largest_offset(self) -> float:
        """Largest output offset that may remain at constant input, relative to the settling band,
        with 95 % confidence."""
        worst = 0.0
        if self.stuck:
            confidence_factor = MISSED ** (-1 / len(self.stuck))
            worst = max(self.stuck) * confidence_factor
        return worst / self.scaled_settling_band

    @property
    def scaled_settling_band(self) -> float:
        """Width of the settling band in scaled outputs."""
        return BAND * self.farthest

    @property
    def gain(self) -> float:
        """Gain from the input to the model error in the records of the largest input amplitude."""
        return self.views[-1].gain

    @property
    def plant_comes_to_rest(self) -> bool:
        """Whether the plant comes to rest in every record with constant input."""
        return self.left_at_rest is None or self.left_at_rest < AT_REST

    @property
    def largest_recorded_gain(self) -> float:
        """Largest gain from input to model error in any record. It is a lower bound on the
        incremental gain of the model error."""
        if not self.plant_comes_to_rest:
            return float("inf")
        return max(view.gain for view in self.errors_by_amplitude)

    @property
    def errors_by_amplitude(self) -> tuple[ModelErrorAtAmplitude, ...]:
        """Model error at each recorded input amplitude, and as last item the error measured in
        closed loop, if there is one."""
        return self.views if self.loop is None else (*self.views, self.loop)

    @property
    def gain_by_frequency(self) -> Float[np.ndarray, "F"]:
        """Gain from input to model error in each frequency band: the larger of its values at the
        largest amplitude and in closed loop."""
        largest = self.views[-1].by_frequency
        if self.loop is None:
            return largest
        return np.maximum(largest, self.loop.by_frequency)

    def gain_at(self, angles: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        """Gain from input to model error at given frequencies, interpolated between the frequency
        bands."""
        return np.interp(angles, ANGLES, self.gain_by_frequency)


def measure_model_error(
    model: Model,
    validation: Trajectories,
    start_up_samples: int = 0,
    mismatch_records: Trajectories = (),
) -> Mismatch:
    """Measure the model error `e = y - y_model` of a free-run simulation, in scaled units, on
    validation records and further records.

    A single sine, of `excite --after`, raises the mismatch at its frequency alone (`single_sines`).
    With `start_up_samples` the initial state is estimated from them (`models.metrics`), and they do
    not count. Raises `BadRequest` without a record that moves the input.
    """
    closed_loop_errors = moving_closed_loop_errors(model, mismatch_records, start_up_samples)
    in_open_loop = open_loop_errors(model, validation, mismatch_records, start_up_samples)
    moving = [errors for errors in in_open_loop if errors.u.any()]
    resting = [errors for errors in in_open_loop if not errors.u.any()]
    problem = "the input never leaves its equilibrium, so no mismatch can be measured"
    remedy = "give a validation record that excites the plant"
    require(bool(moving), "validation", f"{len(validation)} record(s)", problem, remedy)
    repeating = [errors for errors in moving if errors.period is not None]
    periodic = [errors for errors in repeating if not has_single_sine_input(errors)]
    noise = estimate_noise(periodic) if periodic else None
    largest = max(periodic or moving, key=RecordErrors.mean_square_input)
    views = [model_error_from_averages(moving)]
    if noise is not None:
        views = _errors_from_periods(periodic, repeating, noise)
    response = model.linear.impulse_response_length()
    returns = [trial for trial in mismatch_records if is_return_to_rest(trial)]
    still, offsets = oscillations_and_offsets_after_returns(model.scale, returns, response)
    own_offsets, swings = _offsets_and_oscillations_at_rest(moving, response)
    decays = [remaining_offset(errors.output) for errors in resting]
    starts = [float(np.abs(errors.output[0]).max()) for errors in resting]
    loop = None
    if closed_loop_errors:
        loop = model_error_in_closed_loop(closed_loop_errors, noise)
    sorted_views = sorted(views, key=lambda view: view.amplitude)
    noise_by_band = () if noise is None else tuple(noise.tolist())
    motions_at_rest = [*decays, *still, *swings]
    left_at_rest = max(motions_at_rest, default=None)
    stuck = _choose_larger_offsets(own_offsets, offsets)
    farthest = max(starts, default=1.0)
    return Mismatch(
        views=tuple(sorted_views),
        loop=loop,
        spread=largest.log_gain_standard_error(),
        noise=noise_by_band,
        left_at_rest=left_at_rest,
        stuck=tuple(stuck),
        farthest=farthest,
        unexcited=_unexcited_frequencies(largest),
    )


def _errors_from_periods(
    periodic_errors: Records, repeating_errors: Records, noise: BandPowers
) -> list[ModelErrorAtAmplitude]:
    """Model error at the input amplitude of each record with two equal periods, with the results of
    single-sine records added."""
    strength = max(errors.mean_square_input() for errors in periodic_errors)
    views = []
    for errors in periodic_errors:
        is_largest = errors.mean_square_input() == strength
        views.append(model_error_from_periods(errors, is_largest, noise))
    views = sorted(views, key=lambda view: view.amplitude)
    sines = [
        measure_error_at_sine(errors, noise) for errors in steady_sine_errors(repeating_errors)
    ]
    return [*add_sine_errors(views, sines)]


def _offsets_and_oscillations_at_rest(
    moving_errors: list[RecordErrors], response_length: int
) -> tuple[list[float], list[float]]:
    """Offsets and oscillations of the output that remain in records after the input has become
    constant. Offsets count above `AT_REST`, oscillations above `FAINT`: a decay may not show these,
    since it starts elsewhere."""
    offsets = []
    swings = []
    for errors in moving_errors:
        rest = output_after_motion(errors.moving, errors.output, response_length)
        if not len(rest):
            continue
        if (offset := remaining_offset(rest)) > AT_REST:
            offsets.append(offset)
        if (size := oscillation_amplitude(rest)) > FAINT:
            swings.append(size)
    return offsets, swings


def _choose_larger_offsets(first: list[float], second: list[float]) -> list[float]:
    """Choose, of two lists of measured output offsets, the one with the larger maximum."""
    return max(first, second, key=lambda offsets: max(offsets, default=0.0))


def _unexcited_frequencies(record_errors: RecordErrors) -> tuple[float, ...]:
    """Frequencies (rad/sample) of the bands in which the input of a record has next to no power."""
    input_power = welch_power_density([record_errors.u])
    is_unexcited = input_power < EXCITED * input_power.mean()
    band_angles = ANGLES[: len(input_power)]
    return tuple(float(angle) for angle in band_angles[is_unexcited])
