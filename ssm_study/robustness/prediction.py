"""Prediction of whether a certified design is stable on the plant, from the model error in the
records.

Write the true output as `y = y_model + e`; the closed loop maps `e` back to `u` by `T_ue`
(`robustness.sensitivity`). At each amplitude on record (`robustness.mismatch`) one of the first two
conditions must hold, and all the others, with `M = s_u s_y G T_ue`, G the model's linear part:

    small gain      max_w g(w) sigma_max(T_ue(w)) < 1
    with a phase    1 - M Q winds around zero nowhere, and
                    max_w g_r(w) |T_ue| / |1 - M Q| < 1,      where e = Q y_model + r
    offset          offset sigma_max(I + M)(0) < 1,           see `Mismatch.largest_offset`
    noise_peak      4.5 sqrt((1 / pi) int_0^pi sigma_max(M)^2 S_n dw) / band < 1,
                    at the slopes of rest
    controller      controller_radius < 1

Mixtures of neighbouring amplitudes must pass too, where these do not both pass by small gain: a
limit cycle may lie between. The stability margin, which must exceed one, is the inverse of the
largest of the first three; it is zero where the plant does not come to rest. Where the plant all
but holds still (`HOLDS`) the controller runs alone, and the last condition decides: that is what
`1 - M Q` says at Q = -1, but for integrators, where that is zero at w = 0. All this is no
certificate. Reasons: docs/trust.md, "What is measured for it"; docs/theory.md, "Small gain for the
plant".
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.bounds.frequency import frequency_response
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.structured import Model, StructuredSSM, evaluate_activations
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    ResponseCache,
    control_sensitivity_peak,
    controller_spectral_radius,
    error_to_input_response,
    largest_singular_values,
    systems_at_constant_slopes,
)
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StateSpace

# A plant that answers with less than this share of the model's power holds still most of the time.
HOLDS = 0.3
MIXTURES = (0.25, 0.5, 0.75)  # shares of the larger of two neighbouring amplitudes
SECANTS = 401  # points of S_u between which its slopes are taken
MUCH = 0.95  # of the ball's radius: slopes that fill as much are not told from all
COARSE = FINE_ANGLES[::3]  # for the power of noise
PEAK = 4.5  # standard deviations, which normal noise exceeds once in 150,000 samples

BandGains = Float[np.ndarray, "F"]
ComplexBandGains = Complex[np.ndarray, "F"]
LoopGains = Float[np.ndarray, "K"]
ComplexLoopGains = Complex[np.ndarray, "K"]
SlopePair = tuple[float, float]  # of the input map and the output map


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Prediction of whether a closed loop is stable on the plant, with its stability margins.
    Tables use the names of its fields as columns (all -)."""

    mismatch_margin: float
    resolved_margin: float
    controller_radius: float
    noise_peak: float = 0.0

    def predicts_stability(self, required_margin: float = 1.0) -> bool:
        """Whether the loop is predicted to be stable on the plant with more than a given margin."""
        is_robust = self.resolved_margin > required_margin
        return is_robust and self.controller_radius < 1 and self.noise_peak < 1


def predict_margins(
    model: Model, gains: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> Prediction:
    """Predict the stability margins on the plant of the loop with one controller and observer. They
    are zero if the loop is unstable at a slope, infinite without any model error."""
    peak = control_sensitivity_peak(model.system, gains, balls)
    total_gain = mismatch.gain * peak if np.isfinite(peak) else np.inf
    measure = worst_case_loop_gain(model, gains, balls, mismatch)
    controller_radius = controller_spectral_radius(model.system, gains, balls)
    return Prediction(
        mismatch_margin=margin_from_loop_gain(total_gain),
        resolved_margin=margin_from_loop_gain(measure),
        controller_radius=float(controller_radius),
        noise_peak=output_peak_from_noise(model, gains, balls, mismatch),
    )


def margin_from_loop_gain(loop_gain: float) -> float:
    """Stability margin as the inverse of a loop gain; infinite for a gain of zero."""
    return 1 / loop_gain if loop_gain else float("inf")


def worst_case_loop_gain(
    model: Model,
    gains: Gains,
    balls: JacobianBalls,
    mismatch: Mismatch,
    cached_responses: ResponseCache | None = None,
    stop_value: float = float("inf"),
) -> float:
    """Largest loop gain under the measured model error, over all input amplitudes and slopes; its
    inverse is the stability margin. It is infinite for an unstable loop. Mixtures of the errors at
    neighbouring amplitudes count too.

    It is taken on `FINE_ANGLES`, or those of `cached_responses`, where what pairs share is computed
    once (the same but for rounding), and at the angles of the loop's own modes, where it is
    sharpest. The search ends at the first number from `stop_value` on.
    """
    if not mismatch.plant_comes_to_rest:
        return float("inf")
    largest = 0.0
    loops = loops_at_constant_slopes(model, gains, balls, mismatch)
    for linear, own_gains, slopes, records in loops:
        loop = LoopResponse.from_gains(linear, own_gains, slopes, cached_responses)
        if loop is None:
            return float("inf")
        offset = records.largest_offset * loop.gain_of_constants
        largest = max(largest, offset, largest_loop_gain(records, loop))
        if largest >= stop_value:
            return largest
    return largest


def loops_at_constant_slopes(
    model: Model, gains: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> Iterator[tuple[StateSpace, Gains, SlopePair, Mismatch]]:
    """Linear closed loops at all combinations of constant slopes of maps and neurons, each with the
    model error that applies to it."""
    for met_balls, records in _group_by_amplitude(model, balls, mismatch):
        combinations = systems_at_constant_slopes(model.system, gains, met_balls)
        for linear, own_gains, slope_in, slope_out in combinations:
            yield linear, own_gains, (slope_in, slope_out), records


def _group_by_amplitude(
    model: Model, balls: JacobianBalls, mismatch: Mismatch
) -> list[tuple[JacobianBalls, Mismatch]]:
    """Group the recorded model errors by input amplitude, each with the slopes of the static maps
    at this amplitude. The two largest amplitudes and closed-loop records are combined with all
    slopes. The smaller amplitudes, up to the second largest, speak of loops that swing no wider
    than its sinusoid, whose peak is `sqrt(2)` times its root mean square: with a single input they
    meet only the slopes of S_u within that range, not those at an actuator's limit."""
    views = mismatch.views
    if len(views) < 3 or model.scaffold_in.inputs > 1:
        return [(balls, mismatch)]
    second_largest = views[-2]
    unit_swing = np.linspace(-1, 1, SECANTS)[:, None]
    swing = np.sqrt(2) * second_largest.amplitude * unit_swing
    input_map_values = model.scaffold_in(swing)[:, 0]
    steps = np.diff(swing[:, 0])
    secants = np.diff(input_map_values) / steps
    extreme_secants = (secants.min(), secants.max())
    ball = balls.input
    slopes = np.clip(extreme_secants, ball.lower, ball.upper)
    met_ball = JacobianBall.from_slopes(*slopes.tolist())
    if met_ball.beta >= MUCH * ball.beta:
        return [(balls, mismatch)]
    large = replace(mismatch, views=views[-2:])
    small = replace(mismatch, views=views[:-1], loop=None)
    met_balls = replace(balls, input=met_ball)
    return [(balls, large), (met_balls, small)]


@dataclass(frozen=True, kw_only=True)
class LoopResponse:
    """Frequency response of a closed loop from an error of the output to the input. `|T_ue|` at
    `angles (K,)` of one loop of constant slopes, and `M` where there is one input and one output.

    `gain_of_constants` is `sigma_max(I + M)` at rest.
    """

    angles: LoopGains
    size: LoopGains
    through: ComplexLoopGains | None
    gain_of_constants: float
    integrates: bool

    @classmethod
    def from_gains(
        cls,
        system: StateSpace,
        gains: Gains,
        slopes: SlopePair,
        cached_responses: ResponseCache | None = None,
    ) -> "LoopResponse | None":
        """Frequency response of the closed loop with each static map replaced by a constant slope;
        None if that loop is unstable."""
        loop = error_to_input_response(system, gains, *slopes)
        modes = np.linalg.eigvals(loop.a)
        if np.abs(modes).max() >= 1:
            return None
        grid = FINE_ANGLES if cached_responses is None else cached_responses.angles
        mode_angles = np.abs(np.angle(modes))
        mode_angles_on_grid = np.maximum(mode_angles, grid[0])
        angles = np.union1d(grid, mode_angles_on_grid)
        if cached_responses is None:
            closed_loop = frequency_response(loop, angles)
            open_loop = frequency_response(system, angles)
        else:
            extra = np.setdiff1d(angles, grid)
            at = np.searchsorted(grid, extra)
            responses = cached_responses.loop_response(
                system, gains.k, gains.modes, [gains.l], *slopes
            )
            closed_on_grid = responses[0]
            closed_at_modes = frequency_response(loop, extra)
            closed_loop = np.insert(closed_on_grid, at, closed_at_modes, axis=0)
            state_response = cached_responses.state_response(system.a, system.b)
            open_on_grid = system.c @ state_response + system.d
            open_at_modes = frequency_response(system, extra)
            open_loop = np.insert(open_on_grid, at, open_at_modes, axis=0)
        slope_in, slope_out = slopes
        through = slope_in * slope_out * open_loop @ closed_loop
        is_scalar = closed_loop.shape[1:] == open_loop.shape[1:] == (1, 1)
        at_constants = through[0]
        identity = np.eye(len(at_constants))
        gain_of_constants = np.linalg.norm(identity + at_constants, 2)
        size = largest_singular_values(closed_loop)
        scalar_through = through[:, 0, 0] if is_scalar else None
        is_integrator = np.diagonal(gains.modes) == 1
        return cls(
            angles=angles,
            size=size,
            through=scalar_through,
            gain_of_constants=float(gain_of_constants),
            integrates=bool(is_integrator.any()),
        )

    def small_gain_product(self, by_frequency: BandGains) -> float:
        """Largest product, over all frequencies, of the gains of closed loop and model error."""
        mismatch_gain = np.interp(self.angles, ANGLES, by_frequency)
        loop_gain = mismatch_gain * self.size
        return float(loop_gain.max())

    def return_difference(self, linear_part: ComplexBandGains) -> ComplexLoopGains:
        """Return difference `1 - M Q` of the closed loop M and the linear part Q of the model
        error, at each frequency."""
        real = np.interp(self.angles, ANGLES, linear_part.real)
        imaginary = np.interp(self.angles, ANGLES, linear_part.imag)
        assert self.through is not None
        loop_of_linear_part = self.through * (real + 1j * imaginary)
        return np.asarray(1 - loop_of_linear_part)

    def remainder_gain_product(self, linear_part: ComplexBandGains, remainder: BandGains) -> float:
        """Small-gain product for the nonlinear part of the model error, with the linear part
        included in the closed loop. Infinite if `1 - M Q` winds around zero, so that its phase at
        pi is not the one at 0."""
        if self.through is None:
            return float("inf")
        returned = self.return_difference(linear_part)
        phase = np.unwrap(np.angle(returned))
        turn = phase[-1] - phase[0]
        winds = abs(turn) > np.pi / 2
        if winds or returned[0].real <= 0:
            return float("inf")
        remainder_gain = np.interp(self.angles, ANGLES, remainder)
        plain_gain = remainder_gain * self.size
        gain = plain_gain / np.abs(returned)
        return float(gain.max())


@dataclass(frozen=True, kw_only=True)
class AmplitudeCondition:
    """Small-gain condition of stability for the model error at one input amplitude."""

    linear_part: Complex[np.ndarray, "F"]
    remainder: Float[np.ndarray, "F"]
    small_gain: float
    # The plant held still, and the controller integrates: its output grows until the plant moves.
    is_exempt: bool

    @classmethod
    def from_model_error(
        cls, view: ModelErrorAtAmplitude, loop: LoopResponse
    ) -> "AmplitudeCondition":
        """Evaluate the small-gain condition of a closed loop for the model error at one input
        amplitude. Where the plant did not move, no remainder counts."""
        held_still = view.response < HOLDS
        remainder = np.where(held_still, 0.0, view.rest)
        small_gain = loop.small_gain_product(view.by_frequency)
        is_exempt = held_still and loop.integrates
        return cls(
            linear_part=view.linear, remainder=remainder, small_gain=small_gain, is_exempt=is_exempt
        )

    def loop_gain(self, loop: LoopResponse) -> float:
        """Loop gain of the model error at one input amplitude, below one for a stable loop: the
        smaller of plain small gain and small gain with a phase."""
        with_phase = loop.remainder_gain_product(self.linear_part, self.remainder)
        return min(self.small_gain, with_phase)


def largest_loop_gain(mismatch: Mismatch, loop: LoopResponse) -> float:
    """Largest loop gain of the model error over all recorded input amplitudes. Below one, the loop
    is predicted to be stable.
    At one amplitude the smaller of two sufficient conditions counts. A loop may also swing between
    two recorded amplitudes, so mixtures of neighbours are tested too. Source: docs/theory.md,
    "Small gain for the plant".
    """
    conditions = [AmplitudeCondition.from_model_error(view, loop) for view in mismatch.views]
    gain = 0.0
    for condition in conditions:
        if condition.small_gain > gain and not condition.is_exempt:
            gain = max(gain, condition.loop_gain(loop))
    for smaller, larger in pairwise(conditions):
        if _may_hide_limit_cycle(smaller, larger, gain):
            gain_between = _largest_interpolated_gain(smaller, larger, loop)
            gain = max(gain, gain_between)
    if mismatch.loop is not None:
        gain_in_closed_loop = loop.small_gain_product(mismatch.loop.by_frequency)
        gain = max(gain, gain_in_closed_loop)
    return gain


def _may_hide_limit_cycle(
    smaller: AmplitudeCondition, larger: AmplitudeCondition, largest_gain: float
) -> bool:
    """Whether a limit cycle may exist at an amplitude between two recorded input amplitudes. It may
    unless both amplitudes pass by small gain; where the gain is infinite already, nothing is left
    to decide."""
    larger_gain = max(smaller.small_gain, larger.small_gain)
    pass_by_small_gain = larger_gain < max(largest_gain, 1.0)
    is_undecided = np.isfinite(largest_gain)
    both_exempt = smaller.is_exempt and larger.is_exempt
    return bool(not pass_by_small_gain and is_undecided and not both_exempt)


def _largest_interpolated_gain(
    smaller: AmplitudeCondition, larger: AmplitudeCondition, loop: LoopResponse
) -> float:
    """Largest small-gain product over interpolations between the model errors at two neighbouring
    input amplitudes."""
    gains = []
    for share in MIXTURES:
        rest_share = 1 - share
        linear_part = rest_share * smaller.linear_part + share * larger.linear_part
        remainder = rest_share * smaller.remainder + share * larger.remainder
        gain = loop.remainder_gain_product(linear_part, remainder)
        gains.append(gain)
    return max(gains)


def output_peak_from_noise(
    model: Model, gains: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> float:
    """Largest output amplitude that the measured sensor noise causes at the equilibrium, in
    settling bands. Zero if the noise was not measured, or the plant does not move under that
    input."""
    if not mismatch.noise:
        return 0.0
    linear, own_gains = _linearise_at_equilibrium(model, gains, balls)
    slope_in = _slope_at_equilibrium(model.scaffold_in, balls.input)
    slope_out = _slope_at_equilibrium(model.scaffold_out, balls.output)
    closed_loop = error_to_input_response(linear, own_gains, slope_in, slope_out)
    to_input = frequency_response(closed_loop, COARSE)
    to_output = slope_in * slope_out * frequency_response(linear, COARSE) @ to_input
    input_gain = largest_singular_values(to_input)
    output_gain = largest_singular_values(to_output)
    squared_gains = np.stack([input_gain, output_gain]) ** 2
    density = squared_gains * np.interp(COARSE, ANGLES, mismatch.noise)
    variances = np.trapezoid(density, COARSE) / np.pi
    at_input, at_output = np.sqrt(variances)
    amplitudes = [view.amplitude for view in mismatch.views]
    responses = [view.response for view in mismatch.views]
    noise_amplitude = PEAK * at_input / np.sqrt(2)
    response = np.interp(noise_amplitude, amplitudes, responses)
    if response < HOLDS:
        return 0.0
    return PEAK * float(at_output) / mismatch.scaled_settling_band


def _linearise_at_equilibrium(
    model: Model, gains: Gains, balls: JacobianBalls
) -> tuple[StateSpace, Gains]:
    """Linear system and observer gains, with each neuron replaced by its slope at the
    equilibrium."""
    slopes = None
    if isinstance(model, StructuredSSM):
        slopes = evaluate_activations(model.neurons, model.bias, "slope")[None]
    combinations = systems_at_constant_slopes(model.system, gains, balls, slopes)
    linear, own_gains, *_ = next(iter(combinations))
    return linear, own_gains


def _slope_at_equilibrium(scaffold: Scaffold, ball: JacobianBall) -> float:
    """Slope of a static map at the equilibrium, limited to the slopes of its ball of Jacobians."""
    equilibrium = np.zeros(scaffold.inputs)
    jacobian = scaffold.jacobian(equilibrium)
    size = np.linalg.norm(jacobian, 2)
    slope = np.sign(ball.alpha) * size
    return float(np.clip(slope, ball.lower, ball.upper))
