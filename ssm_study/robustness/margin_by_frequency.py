"""Stability margin at each frequency and amplitude, and the frequency at which it is smallest.

At one amplitude the smaller of two numbers counts, `max_w g |T_ue|` or `max_w g_r |T_ue| / |1 - M
Q|` (`robustness.prediction`). The curve is the inverse of what stands below the maximum, for the
one that counts, at the worst of the constant slopes. Its smallest value over frequencies and
amplitudes is the stability margin, except where a mixture of two amplitudes, an offset that
friction leaves, or an unstable slope gives a smaller one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import (
    AmplitudeCondition,
    LoopGains,
    LoopResponse,
    loops_at_constant_slopes,
)
from ssm_study.robustness.sensitivity import FINE_ANGLES
from ssm_study.systems import Gains, JacobianBalls


@dataclass(frozen=True, kw_only=True)
class MarginCurve:
    """Stability margin as a function of frequency, for the records of one input amplitude.

    `smallest` is the least margin, at `angle` (rad/sample), which may lie between the grid's
    angles. `amplitude` is None for what was recorded in closed loop.
    """

    amplitude: float | None
    margin: Float[np.ndarray, "F"]
    smallest: float
    angle: float


def margin_curves(
    model: Model, gains: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> list[MarginCurve]:
    """Stability margins as functions of frequency, one curve for each recorded input amplitude in
    ascending order.

    None where a loop of constant slopes is unstable: no frequency is to blame for a margin of zero.
    """
    curves: dict[float | None, _LargestLoopGain] = {}
    for linear, own_gains, slopes, records in loops_at_constant_slopes(
        model, gains, balls, mismatch
    ):
        loop = LoopResponse.from_gains(linear, own_gains, slopes)
        if loop is None:
            return []
        for view in records.views:
            condition = AmplitudeCondition.from_model_error(view, loop)
            gain = _less_conservative_gain(condition, view.by_frequency, loop)
            curve = curves.setdefault(view.amplitude, _LargestLoopGain())
            curve.include_gain(loop.angles, gain)
        if records.loop is not None:
            mismatch_gain = np.interp(loop.angles, ANGLES, records.loop.by_frequency)
            curve = curves.setdefault(None, _LargestLoopGain())
            curve.include_gain(loop.angles, mismatch_gain * loop.size)
    ordered = sorted(curves.items(), key=lambda item: (item[0] is None, item[0] or 0.0))
    return [curve.as_margin_curve(amplitude) for amplitude, curve in ordered]


def _less_conservative_gain(
    condition: AmplitudeCondition, by_frequency: Float[np.ndarray, "F"], loop: LoopResponse
) -> LoopGains:
    """Loop gain for one amplitude's model error at each frequency, by the less conservative of two
    stability conditions."""
    plain = np.interp(loop.angles, ANGLES, by_frequency) * loop.size
    if condition.is_exempt:
        return np.zeros_like(plain)
    with_phase = loop.remainder_gain_product(condition.linear_part, condition.remainder)
    if not with_phase < condition.small_gain:
        return np.asarray(plain)
    returned = loop.return_difference(condition.linear_part)
    remainder = np.interp(loop.angles, ANGLES, condition.remainder)
    gain = remainder * loop.size / np.abs(returned)
    return np.asarray(gain)


class _LargestLoopGain:
    """Largest loop gain at each frequency of a grid, over all combinations of slopes of the static
    maps."""

    def __init__(self) -> None:
        self.gain = np.zeros(len(FINE_ANGLES))
        self.largest = 0.0
        self.angle = float(FINE_ANGLES[0])

    def include_gain(self, angles: LoopGains, loop_gain: LoopGains) -> None:
        """Update the largest loop gain at each frequency with the loop gain for one more
        combination of slopes."""
        places = np.searchsorted(angles, FINE_ANGLES)
        on_grid = loop_gain[places]
        self.gain = np.maximum(self.gain, on_grid)
        peak = int(np.argmax(loop_gain))
        if loop_gain[peak] > self.largest:
            self.largest = float(loop_gain[peak])
            self.angle = float(angles[peak])

    def as_margin_curve(self, amplitude: float | None) -> MarginCurve:
        """Stability margin at each frequency, computed as the inverse of the largest loop gain
        there. It is infinite where nothing was measured."""
        with np.errstate(divide="ignore"):
            margin = 1 / self.gain
        smallest = 1 / self.largest if self.largest else float("inf")
        return MarginCurve(amplitude=amplitude, margin=margin, smallest=smallest, angle=self.angle)
