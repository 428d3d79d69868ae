"""Bode plot of a model at its equilibrium, beside an estimate from a record."""

import numpy as np
from jaxtyping import Complex, Float

from ssm_study import style
from ssm_study.api.pictures.picture import DASHED, Band, Picture, PicturePanel, Series
from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.signals import Trajectory
from ssm_study.systems import JacobianBall

SEGMENT = 256
FEWEST = 16  # samples of a piece at most, and at least
EXCITED = 0.01  # share of the input's mean power below which a frequency is left out
COHERENT = 0.5  # squared coherence below which a dot would be noise
POINTS = 200
ALIKE = 0.1  # relative difference of two gains below which they are drawn as one
DECADES = 3  # below half the sampling rate
Angles = Float[np.ndarray, "F"]


def bode_picture(
    model: Model,
    record: Trajectory,
    slopes: JacobianBall | None = None,
    units: tuple[str, str] = ("", ""),
) -> Picture:
    """Bode plot of a model at its equilibrium, with dots for a non-parametric estimate from a
    record.

    `slopes` of the input map shade the gains that they allow, for one input. `units` are those of
    output and input.
    """
    nyquist = 0.5 / model.step_s
    lowest_hz = 10.0**-DECADES * nyquist
    hertz = np.geomspace(lowest_hz, nyquist, POINTS)
    angles = 2 * np.pi * hertz * model.step_s
    response = frequency_response_at_equilibrium(model, angles)
    wrapped_angle = np.angle(response)
    angle = np.unwrap(wrapped_angle)
    magnitude = np.abs(response)
    gains = [Series(x=hertz, y=magnitude, name="model at rest")]
    ratio = input_map_gain_ratio(model, record)
    if ratio is not None:
        at_record = {"name": "model at the record's mean gain", "dashes": DASHED}
        gain_at_record = Series(x=hertz, y=ratio * magnitude, **at_record)  # type: ignore[arg-type]
        gains.append(gain_at_record)
    y = np.rad2deg(angle)
    phases = [Series(x=hertz, y=y)]
    u = record.u[:, 0]
    output = record.y[:, 0]
    at_hertz, estimate = estimate_frequency_response(u, output, record.step_s)
    if len(at_hertz):
        near = np.interp(at_hertz, hertz, angle)
        estimated_gain, estimated_phase = _estimated_dots(at_hertz, estimate, near)
        gains.append(estimated_gain)
        phases.append(estimated_phase)
    shared = {"x_label": "Frequency (Hz)", "log_x": True}
    gain_band = _gain_band(model, slopes, hertz, magnitude)
    upper = PicturePanel(
        y_label=f"Gain{_gain_unit(units)}",
        series=tuple(gains),
        bands=gain_band,
        log_y=True,
        height=1.2,
        **shared,  # type: ignore[arg-type]
    )
    lower = PicturePanel(y_label="Phase (degrees)", series=tuple(phases), **shared)  # type: ignore[arg-type]
    title = "Frequency response at rest"
    if ratio is not None:
        title += f"; over the record the input map's gain is {ratio:.2g} times that at rest"
    panels = (upper, lower)
    return Picture(title=title, panels=panels)


def _estimated_dots(
    hertz: Angles, estimate: Complex[np.ndarray, "F"], model_phase: Angles
) -> tuple[Series, Series]:
    """Dots for gain and phase of an estimated frequency response, unwrapped to the model's phase.
    The model's phase is `model_phase`."""
    magnitude = np.abs(estimate)
    gain = Series(x=hertz, y=magnitude, mark="dots", colour=style.GREY, name="record")
    model_turn = np.exp(-1j * model_phase)
    apart = np.angle(estimate * model_turn)
    degrees = np.rad2deg(model_phase + apart)
    phase = Series(x=hertz, y=degrees, mark="dots", colour=style.GREY)
    return gain, phase


def input_map_gain_ratio(model: Model, record: Trajectory) -> float | None:
    """Gain of the input map in a record, divided by the slope of the map at the equilibrium. None
    if this ratio is near one, or for several inputs.

    The gain of a static map that a cross spectrum shows is `E[S(u) u] / E[u^2]`, exactly so for
    Gaussian inputs. Source: Bussgang 1952.
    """
    if model.scaffold_in.inputs != 1:
        return None
    jacobian = model.scaffold_in.jacobian(np.zeros(1))
    slope_at_rest = float(jacobian[0, 0])
    deviation_in_units = record.u - model.scale.input_equilibrium
    deviation = deviation_in_units / model.scale.input_scale
    varying = deviation - deviation.mean(axis=0)
    power = float((varying**2).sum())
    if slope_at_rest == 0 or power == 0:
        return None
    mapped = model.scaffold_in(deviation)
    correlation = (mapped * varying).sum()
    gain = float(correlation) / power
    ratio = gain / slope_at_rest
    return ratio if abs(ratio - 1) > ALIKE else None


def _gain_unit(units: tuple[str, str]) -> str:
    """Unit of a gain as text, output unit per input unit, in parentheses; empty where neither is
    known."""
    if not any(units):
        return ""
    return f" ({units[0] or '1'} per {units[1] or '1'})"


def _gain_band(
    model: Model, slopes: JacobianBall | None, hertz: Angles, magnitude: Angles
) -> tuple[Band, ...]:
    """Shaded range of the frequency response's gain between the smallest and the largest slope of
    the input map."""
    if slopes is None or model.scaffold_in.inputs != 1:
        return ()
    jacobian = model.scaffold_in.jacobian(np.zeros(1))
    slope_at_rest = float(jacobian[0, 0])
    if slope_at_rest <= 0 or slopes.lower <= 0 or slopes.upper <= slopes.lower:
        return ()
    low = magnitude * slopes.lower / slope_at_rest
    high = magnitude * slopes.upper / slope_at_rest
    band = Band(x=hertz, low=low, high=high, name="slopes of the input map", colour=style.SKY)
    return (band,)


def frequency_response_at_equilibrium(model: Model, angles: Angles) -> Complex[np.ndarray, "F"]:
    """Frequency response of the model at its equilibrium, from the first input to the first output.
    `s_y J_y (C (zI - A)^-1 B + D) J_u / s_u`, `z = exp(j angle)`."""
    linear = linearise_at_equilibrium(model)
    inputs = model.scaffold_in.inputs
    zero_input = np.zeros(inputs)
    slope_in = model.scaffold_in.jacobian(zero_input)
    zero_output = np.zeros(model.scaffold_out.inputs)
    slope_out = model.scaffold_out.jacobian(zero_output)
    input_scale = model.scale.input_scale
    inward = (slope_in / input_scale)[:, 0]
    output_scale = model.scale.output_scale
    output_rows = output_scale[:, None] * slope_out
    outward = output_rows[0]
    points_on_circle = np.exp(1j * angles)
    z = points_on_circle[:, None, None]
    state_count = len(linear.a)
    shifted = z * np.eye(state_count) - linear.a
    input_column = (linear.b @ inward)[:, None]
    states = np.linalg.solve(shifted, input_column)
    through_states = (outward @ linear.c) @ states[:, :, 0].T
    direct_gain = outward @ linear.d @ inward
    return np.asarray(through_states + direct_gain)


def estimate_frequency_response(
    u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"], step_s: float
) -> tuple[Float[np.ndarray, "K"], Complex[np.ndarray, "K"]]:
    """Estimate a frequency response from a record as the ratio of cross spectrum to input power.

    By Welch's method; frequencies without input power or coherence are left out.
    """
    from scipy import signal

    quarter = len(u) // 4
    segment = min(SEGMENT, quarter)
    if segment < FEWEST:
        return np.empty(0), np.empty(0, dtype=complex)
    input_deviation = u - u.mean()
    output_deviation = y - y.mean()
    rate = 1 / step_s
    frequency, cross = signal.csd(input_deviation, output_deviation, fs=rate, nperseg=segment)
    _, power = signal.welch(input_deviation, fs=rate, nperseg=segment)
    _, output_power = signal.welch(output_deviation, fs=rate, nperseg=segment)
    cross_power = np.abs(cross) ** 2
    coherent_power = COHERENT * power * output_power
    coherent = cross_power > coherent_power
    least_power = EXCITED * power.mean()
    excited = (power > least_power) & (frequency > 0) & coherent
    estimated_response = cross[excited] / power[excited]
    return frequency[excited], estimated_response
