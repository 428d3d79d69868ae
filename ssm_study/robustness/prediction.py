"""Will a certified design be stable on the plant? What its loop tolerates against the mismatch that
the records show.

Write the true output as `y = y_model + e`; the closed loop maps `e` back to `u` by `T_ue`
(`synthesis.sensitivity`).
At each amplitude on record (`synthesis.mismatch`) one of the first two must hold, and all the
others, with
`M = s_u s_y G T_ue`, G the model's linear part. Mixtures of neighbouring amplitudes must pass too,
where these do not
both pass by small gain: a limit cycle may lie between.

    small gain      max_w g(w) sigma_max(T_ue(w)) < 1
    with a phase    1 - M Q winds around zero nowhere,  max_w g_r(w) |T_ue| / |1 - M Q| < 1,    e =
    Q y_model + r
    offset          offset sigma_max(I + M)(0) < 1,    what stays off at rest input in bands, see
    `Mismatch.offset`
    noise_peak      4.5 sqrt((1 / pi) int_0^pi sigma_max(M)^2 S_n dw) / band < 1,    slopes as they
    are at rest
    own radius      controller_radius < 1

The margin, which must exceed one, is the inverse of the largest of the first three; zero where the
plant does not rest.
Where the plant all but holds still (`HOLDS`) the controller runs alone, and the last decides: what
`1 - M Q` says at
Q = -1, but for integrators, where that is zero at w = 0. All this is no certificate.
Reasons: docs/trust.md, "What is measured for it"; docs/theory.md, "Small gain for the plant".
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.bounds.frequency import frequency_response
from ssm_study.models.structured import Model, StructuredSSM, phi
from ssm_study.robustness import sensitivity as loops
from ssm_study.robustness.mismatch import ANGLES, Mismatch
from ssm_study.systems import Balls, Gains, JacobianBall

HOLDS = 0.3  # A plant that answers with less than this share of the model's power holds still most of the time
MIXTURES = (0.25, 0.5, 0.75)  # shares of the larger of two neighbouring amplitudes
SECANTS = 401  # points of S_u between which its slopes are taken
MUCH = 0.95  # of the ball's radius: slopes that fill as much are not told from all
COARSE = loops.FINE_ANGLES[::3]  # for the power of noise
PEAK = 4.5  # standard deviations, which normal noise exceeds once in 150,000 samples


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a pair of gains is expected to do on the plant; every table names its columns so (all
    -)."""

    mismatch_margin: float
    resolved_margin: float
    controller_radius: float
    noise_peak: float = 0.0

    def predicts_stability(self, margin: float = 1.0) -> bool:
        return self.resolved_margin > margin and self.controller_radius < 1 and self.noise_peak < 1


def predict(model: Model, pair: Gains, balls: Balls, shown: Mismatch) -> Prediction:
    """Margins of one controller and observer: 0 if the loop is unstable at a slope, infinite
    without any mismatch."""
    peak, number = (
        loops.sensitivity_peak(model.system, pair, balls),
        worst(model, pair, balls, shown),
    )
    total = shown.gain * peak if np.isfinite(peak) else np.inf
    return Prediction(
        mismatch_margin=1 / total if total else float("inf"),
        resolved_margin=1 / number if number else float("inf"),
        controller_radius=float(loops.controller_radius(model.system, pair, balls)),
        noise_peak=noise_peak(model, pair, balls, shown),
    )


def worst(
    model: Model,
    pair: Gains,
    balls: Balls,
    shown: Mismatch,
    shared: loops.Responses | None = None,
    refused: float = float("inf"),
) -> float:
    """The largest number that must stay below one, over views, mixtures and slopes; infinite for an
    unstable loop.

    On `FINE_ANGLES`, or those of `shared`, where what pairs share is computed once (the same but
    for rounding),
    and at the angles of the loop's own modes, where it is sharpest. It ends at the first number
    from `refused` on.
    """
    if not shown.rests:
        return float("inf")
    integrates = bool((np.diagonal(pair.modes) == 1).any())
    largest, grid = 0.0, loops.FINE_ANGLES if shared is None else shared.angles
    tested = (
        (end, part)
        for met, part in _tested(model, balls, shown)
        for end in loops.ends(model.system, pair, met)
    )
    for (linear, own, *slope), part in tested:
        loop = loops.sensitivity(linear, own, *slope)
        modes = np.linalg.eigvals(loop.a)
        if np.abs(modes).max() >= 1:
            return float("inf")
        angles = np.union1d(grid, np.maximum(np.abs(np.angle(modes)), grid[0]))
        if shared is None:
            answer, open_loop = frequency_response(loop, angles), frequency_response(linear, angles)
        else:
            extra = np.setdiff1d(angles, grid)
            at, on_grid = (
                np.searchsorted(grid, extra),
                shared.of(linear, pair.k, pair.modes, [own.l], *slope)[0],
            )
            answer = np.insert(on_grid, at, frequency_response(loop, extra), axis=0)
            on_grid = linear.c @ shared.to_state(linear.a, linear.b) + linear.d
            open_loop = np.insert(on_grid, at, frequency_response(linear, extra), axis=0)
        moved = slope[0] * slope[1] * open_loop @ answer
        through = moved[:, 0, 0] if answer.shape[1:] == open_loop.shape[1:] == (1, 1) else None
        parts = _Loop(
            angles=angles, size=loops.sizes(answer), through=through, integrates=integrates
        )
        left = part.offset * float(np.linalg.norm(np.eye(len(moved[0])) + moved[0], 2))
        largest = max(largest, left, _over_views(part, parts))
        if largest >= refused:
            return largest
    return largest


def noise_peak(model: Model, pair: Gains, balls: Balls, shown: Mismatch) -> float:
    """The peak of what the noise does to the output at rest, in bands; none where the plant holds
    under that input."""
    if not shown.noise:
        return 0.0
    at = phi(model.neurons, model.bias, "slope")[None] if isinstance(model, StructuredSSM) else None
    system, pair = next(
        (linear, own) for linear, own, *_ in loops.ends(model.system, pair, balls, at)
    )
    parts = ((model.scaffold_in, balls.input), (model.scaffold_out, balls.output))
    at_rest = [
        np.sign(ball.alpha) * np.linalg.norm(s.jacobian(np.zeros(s.inputs)), 2) for s, ball in parts
    ]
    slope = [
        np.clip(found, ball.lower, ball.upper)
        for found, (_, ball) in zip(at_rest, parts, strict=True)
    ]
    answer = frequency_response(loops.sensitivity(system, pair, *slope), COARSE)
    moved = slope[0] * slope[1] * frequency_response(system, COARSE) @ answer
    density = np.stack([loops.sizes(answer), loops.sizes(moved)]) ** 2 * np.interp(
        COARSE, ANGLES, shown.noise
    )
    at_input, at_output = np.sqrt(np.trapezoid(density, COARSE) / np.pi)
    amplitudes, responses = np.transpose([(view.amplitude, view.response) for view in shown.views])
    answered = np.interp(PEAK * at_input / np.sqrt(2), amplitudes, responses)
    return 0.0 if answered < HOLDS else PEAK * float(at_output) / shown.band


def _tested(model: Model, balls: Balls, shown: Mismatch) -> list[tuple[Balls, Mismatch]]:
    """Which views are tested at which slopes: the two largest, and what trials in closed loop show,
    at all.

    The smaller ones, up to the second largest, speak of loops that swing no wider than its
    sinusoid, whose peak is
    `sqrt(2)` times its root mean square: of one S_u they meet the slopes within it, not those at an
    actuator's limit.
    """
    if len(shown.views) < 3 or model.scaffold_in.inputs > 1:
        return [(balls, shown)]
    within = np.sqrt(2) * shown.views[-2].amplitude * np.linspace(-1, 1, SECANTS)[:, None]
    ball, secants = balls.input, np.diff(model.scaffold_in(within)[:, 0]) / np.diff(within[:, 0])
    met = JacobianBall.from_slopes(
        *np.clip((secants.min(), secants.max()), ball.lower, ball.upper).tolist()
    )
    if met.beta >= MUCH * ball.beta:
        return [(balls, shown)]
    large, small = (
        replace(shown, views=shown.views[-2:]),
        replace(shown, views=shown.views[:-1], loop=None),
    )
    return [(balls, large), (replace(balls, input=met), small)]


@dataclass(frozen=True, kw_only=True)
class _Loop:
    """`|T_ue|` at `angles (K,)`, and `M` where there is one input and one output."""

    angles: Float[np.ndarray, "K"]
    size: Float[np.ndarray, "K"]
    through: Complex[np.ndarray, "K"] | None
    integrates: bool

    def small_gain(self, by_frequency: Float[np.ndarray, "F"]) -> float:
        return float((np.interp(self.angles, ANGLES, by_frequency) * self.size).max())

    def with_phase(self, linear: Complex[np.ndarray, "F"], rest: Float[np.ndarray, "F"]) -> float:
        """Infinite if `1 - M Q` winds around zero: its phase at pi must be the one at 0."""
        if self.through is None:
            return float("inf")
        q = np.interp(self.angles, ANGLES, linear.real) + 1j * np.interp(
            self.angles, ANGLES, linear.imag
        )
        returned = 1 - self.through * q
        phase = np.unwrap(np.angle(returned))
        if abs(phase[-1] - phase[0]) > np.pi / 2 or returned[0].real <= 0:
            return float("inf")
        return float((np.interp(self.angles, ANGLES, rest) * self.size / np.abs(returned)).max())


def _over_views(shown: Mismatch, loop: _Loop) -> float:
    views = [
        (loop.small_gain(view.by_frequency), view.response < HOLDS, view) for view in shown.views
    ]
    split = [(view.linear, np.where(holds, 0.0, view.rest)) for _, holds, view in views]
    largest = 0.0
    for (value, holds, _), parts in zip(views, split, strict=True):
        if value > largest and not (holds and loop.integrates):
            largest = max(largest, min(value, loop.with_phase(*parts)))
    for ((small, holds, _), (large, above_too, _)), (below, above) in zip(
        pairwise(views), pairwise(split), strict=True
    ):
        passed = max(small, large) < max(largest, 1.0)
        if not passed and np.isfinite(largest) and not (holds and above_too and loop.integrates):
            mixed = [
                [(1 - t) * a + t * b for a, b in zip(below, above, strict=True)] for t in MIXTURES
            ]
            largest = max(largest, *(loop.with_phase(*one) for one in mixed))
    return largest if shown.loop is None else max(largest, loop.small_gain(shown.loop.by_frequency))
