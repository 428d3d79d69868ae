"""Picture of the stability margin over frequency."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ssm_study import style
from ssm_study.api.pictures.picture import (
    DASH_CYCLE,
    EmptyPictureError,
    GuideLine,
    Picture,
    PicturePanel,
    Series,
)
from ssm_study.models.structured import Model
from ssm_study.robustness.margin_by_frequency import MarginCurve
from ssm_study.robustness.sensitivity import FINE_ANGLES

HIGHEST = 1e3  # margins above say no more than "far": the axis ends there
DECADES = 3  # below half the sampling rate
InputScale = tuple[float, str]  # input scale in physical units, and their name


def margin_picture(
    curves: Sequence[MarginCurve],
    step_s: float,
    margin: float | None = None,
    input_scale: InputScale | None = None,
) -> Picture:
    """Picture of the stability margin over frequency, with a line for each recorded amplitude.

    `margin` is the design's own: where it lies below every curve, a mixture of amplitudes or an
    offset decides it, and a dashed line shows it. With `input_scale`, amplitudes are printed in
    physical units. Raises `EmptyPictureError` without a curve.
    """
    drawn = [curve for curve in curves if np.isfinite(curve.smallest)]
    if not curves:
        raise EmptyPictureError("A loop of constant slopes is unstable: the margin is zero.")
    if not drawn:
        raise EmptyPictureError("The records show no model error beyond their noise.")
    turn_s = 2 * np.pi * step_s
    hertz = FINE_ANGLES / turn_s
    least = min(drawn, key=lambda curve: curve.smallest)
    lowest_hz = hertz[-1] / 10**DECADES
    at_hertz = least.angle / turn_s
    first = min(lowest_hz, at_hertz)
    visible = hertz >= first
    series = [_margin_curve(curve, hertz, visible, i, input_scale) for i, curve in enumerate(drawn)]
    guide_line = GuideLine(y=1.0, dashed=False, name="1: below, no prediction")
    rules = [guide_line]
    decided_by_curve = margin is None or least.smallest <= 1.001 * margin
    if decided_by_curve:
        dot = _smallest_margin_dot(at_hertz, least.smallest)
        series.append(dot)
        title = f"Stability margin {least.smallest:.3g}, decided at {at_hertz:.3g} Hz"
    else:
        margin_line = GuideLine(y=margin, name="the design's margin, between two amplitudes")
        rules.append(margin_line)
        title = f"Stability margin {margin:.3g}, decided between two amplitudes or by an offset"
    all_series = tuple(series)
    all_rules = tuple(rules)
    panel = PicturePanel(
        x_label="Frequency (Hz)",
        y_label="Stability margin (–)",
        series=all_series,
        rules=all_rules,
        log_x=True,
        log_y=True,
        height=1.5,
    )
    return Picture(title=title, panels=(panel,))


def _margin_curve(
    curve: MarginCurve,
    hertz: Float[np.ndarray, "F"],
    visible: Bool[np.ndarray, "F"],
    number: int,
    input_scale: InputScale | None,
) -> Series:
    """Curve of the stability margin over frequency at one recorded amplitude."""
    drawn_margin = np.where(curve.margin < HIGHEST, curve.margin, np.nan)
    return Series(
        x=hertz[visible],
        y=drawn_margin[visible],
        name=_curve_label(curve, input_scale),
        colour=style.CYCLE[number % len(style.CYCLE)],
        dashes=DASH_CYCLE[number % len(DASH_CYCLE)],
    )


def _smallest_margin_dot(hertz: float, margin: float) -> Series:
    """Dot of a picture at the frequency with the smallest stability margin."""
    at_hertz = np.array([hertz])
    at_margin = np.array([margin])
    return Series(
        x=at_hertz,
        y=at_margin,
        mark="point",
        colour=style.INK,
        name=f"decides: {margin:.3g} at {hertz:.3g} Hz",
    )


def _curve_label(curve: MarginCurve, input_scale: InputScale | None) -> str:
    """Legend entry of one curve of the stability margin."""
    if curve.amplitude is None:
        return "trials in closed loop"
    return amplitude_text(curve.amplitude, input_scale)


def physical_input_scale(model: Model, unit: str) -> InputScale | None:
    """Scale of a model's input in physical units, with the name of the unit; None for several
    inputs."""
    scales = model.scale.input_scale
    has_one_input = len(scales) == 1
    return (float(scales[0]), unit) if has_one_input else None


def amplitude_text(amplitude: float, input_scale: InputScale | None) -> str:
    """Text of an input amplitude in physical units or, if the scale of the input is unknown, in
    input scales."""
    if input_scale is None:
        return f"input of rms {amplitude:.2g} input scales"
    size, unit = input_scale
    return f"input of rms {amplitude * size:.2g} {unit}".rstrip()
