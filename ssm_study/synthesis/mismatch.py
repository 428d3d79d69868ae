"""Will a certified design keep the plant? What its loop tolerates, against the mismatch in the validation record.

Write the true output as `y = y_model + e`; the closed loop maps `e` back to `u` by `T_ue` (`synthesis.sensitivity`).
By the small-gain theorem it survives any mismatch `u -> e` of gain below `1 / ||T_ue||_inf`. Two estimates of that
gain, both from the validation record alone:

    in total        g = ||e||_2 / ||u||_2,                margin           = 1 / (g max_w sigma_max(T_ue(w)))
    by frequency    g(w) = sqrt(S_e(w) / S_u(w)),         resolved margin  = 1 / max_w g(w) sigma_max(T_ue(w))

The total gain is an average over frequencies: a resonance that the model misses hides in it. And no record that keeps
the plant moving shows what friction or saturation do to a loop at rest: there the plant holds still and the controller
runs alone, so it must be stable by itself (`controller_radius` below one). A design is predicted to keep the plant when
its resolved margin exceeds one and its controller is stable. A predictor, not a certificate.
Source: THEORY section 5 for the margin in total; docs/closed_loop.md for what was measured of the rest.
"""

from dataclasses import dataclass

import numpy as np
import scipy.signal
from jaxtyping import Float

from ssm_study.models.free_run import free_run
from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis.sensitivity import controller_radius, sensitivity_peak, weighted_peak
from ssm_study.systems import JacobianBall

SEGMENT = 64
"""Samples per segment of Welch's estimate: bands of a tenth of a radian per sample, 60 averages in 4,000 samples."""
EXCITED = 0.01
"""Bands with less than this share of the input's mean power say nothing of the mismatch; there `g` stands in."""


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """What a validation record shows of `y - y_model` per input, in scaled units.

    `gain` in total; `by_frequency (F,)` at `angles (F,)`, radians per sample, from 0 to pi.
    """

    gain: float
    angles: Float[np.ndarray, "F"]
    by_frequency: Float[np.ndarray, "F"]

    def at(self, angles: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        """`g(w)`, linear between the bands."""
        return np.interp(angles, self.angles, self.by_frequency)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a pair of gains is expected to do on the plant."""

    margin: float
    resolved_margin: float
    controller_radius: float

    def keeps_the_plant(self, margin: float = 1.0) -> bool:
        return self.resolved_margin > margin and self.controller_radius < 1

    def columns(self) -> dict[str, float]:
        """As every table names them (all -)."""
        return {
            "mismatch_margin": self.margin,
            "resolved_margin": self.resolved_margin,
            "controller_radius": self.controller_radius,
        }


def predict(
    model: SSM,
    k: Float[np.ndarray, "m s"],
    l: Float[np.ndarray, "n p"],  # noqa: E741 - the paper's letter
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    shown: Mismatch,
) -> Prediction:
    """Margins of one controller and observer: 0 if the loop is unstable at a slope, infinite without any mismatch."""
    peak = sensitivity_peak(model.linear, k, l, input_ball, output_ball)
    weighted = weighted_peak(model.linear, k, l, input_ball, output_ball, shown.at)
    return Prediction(
        margin=_inverse(shown.gain, peak),
        resolved_margin=_inverse(1.0, weighted),
        controller_radius=float(controller_radius(model.linear, k[None], l[None], input_ball, output_ball)[0]),
    )


def mismatch(model: SSM, validation: tuple[Trajectory, ...], start_up_samples: int = 0) -> Mismatch:
    """`e = y - y_model` in free run over all validation records, in total and by frequency, in scaled units.

    With `start_up_samples` the initial state is estimated from them (`models.free_run`), and they do not count.
    Measurement noise in the record counts as mismatch. Raises `BadRequest` without a record that moves the input.
    """
    errors, drives = [], []
    for record in validation:
        missed = (record.y - free_run(model, record, start_up_samples)) / model.output_scale
        errors.append(missed[start_up_samples:])
        drives.append(((record.u - model.input_equilibrium) / model.input_scale)[start_up_samples:])
    error, drive = (float(sum((part**2).sum() for part in parts)) for parts in (errors, drives))
    require(
        drive > 0,
        "validation",
        f"{len(validation)} record(s)",
        "the input never leaves its equilibrium, so no mismatch can be measured",
        "give a validation record that excites the plant",
    )
    gain = float(np.sqrt(error / drive))
    segment = min(SEGMENT, *(len(part) for part in drives))
    power_u, power_e = _power(drives, segment), _power(errors, segment)
    excited = power_u > EXCITED * power_u.mean()
    resolved = np.sqrt(np.divide(power_e, power_u, out=np.full_like(power_u, gain**2), where=excited))
    return Mismatch(gain=gain, angles=np.linspace(0, np.pi, len(power_u)), by_frequency=resolved)


def _power(signals: list[Float[np.ndarray, "T c"]], segment: int) -> Float[np.ndarray, "F"]:
    """Welch's power density, summed over channels and records (each by its length), at equal steps from 0 to pi."""
    even = segment - segment % 2
    return sum(
        len(signal) * scipy.signal.welch(signal, nperseg=max(even, 2), detrend=False, axis=0)[1].sum(axis=1)
        for signal in signals
    )


def _inverse(gain: float, peak: float) -> float:
    if np.isinf(peak):
        return 0.0
    return float("inf") if gain * peak == 0.0 else 1.0 / (gain * peak)
