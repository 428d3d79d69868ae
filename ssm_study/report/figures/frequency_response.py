"""Frequency response of the model at rest (line) beside the estimate that the validation record
gives without any model (dots: averaged cross spectra, where the input has power and output and
input are coherent). First input to first output, in physical units."""

from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.figure import Figure
from scipy.signal import csd, welch

from ssm_study import style
from ssm_study.models.structured import Model, at_rest
from ssm_study.report.study_folder import StudyFolder

SEGMENT = 256
FEWEST = 16  # samples of a piece at most, and at least
EXCITED = 0.01  # share of the input's mean power below which a frequency is left out
COHERENT = 0.5  # squared coherence below which a dot would be noise
POINTS = 200


def draw(study: StudyFolder) -> Figure:
    model, record = study.of_best(
        "any_model", "validation", otherwise="No run left a model and a validation record."
    )
    step_s = record.step_s("measured")
    hertz = np.geomspace(0.5e-3 / step_s, 0.5 / step_s, POINTS)
    response = response_at_rest(model, 2 * np.pi * hertz * step_s)
    angle = np.unwrap(np.angle(response))
    seen = estimated_response(record["input"][0, :, 0], record["measured"][0, :, 0], step_s)
    fig = style.canvas(style.COLUMN_IN, 3.2)
    gain, phase = fig.subplots(2, 1, sharex=True)
    gain.loglog(hertz, np.abs(response), color=style.BLUE, label="model at rest", zorder=3)
    phase.semilogx(hertz, np.rad2deg(angle), color=style.BLUE, zorder=3)
    if len(seen[0]):
        look: dict[str, Any] = {"ls": "", "marker": ".", "ms": 3, "color": style.GREY}
        gain.loglog(seen[0], np.abs(seen[1]), label="validation record", **look)
        # of all angles that agree up to a turn the one nearest to the model's
        near = np.interp(seen[0], hertz, angle)
        apart = np.angle(seen[1] * np.exp(-1j * near))
        phase.semilogx(seen[0], np.rad2deg(near + apart), **look)
    units = [record.label(name).rpartition("(")[2].rstrip(")") for name in ("measured", "input")]
    gain.set(ylabel=f"Gain ({units[0]} per {units[1]})")
    phase.set(xlabel="Frequency (Hz)", ylabel="Phase (degrees)")
    style.above(gain, columns=2)
    fig.align_ylabels()
    return fig


def response_at_rest(model: Model, angles: Float[np.ndarray, "F"]) -> Complex[np.ndarray, "F"]:
    """`s_y J_y (C (zI - A)^-1 B + D) J_u / s_u` of the first channels at `z = exp(j angle)`."""
    linear = at_rest(model)
    slope_in = model.scaffold_in.jacobian(np.zeros(model.scaffold_in.inputs))
    slope_out = model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))
    inward = (slope_in / model.scale.input_scale)[:, 0]
    outward = (model.scale.output_scale[:, None] * slope_out)[0]
    z = np.exp(1j * angles)[:, None, None]
    states = np.linalg.solve(z * np.eye(len(linear.a)) - linear.a, (linear.b @ inward)[:, None])
    return np.asarray((outward @ linear.c) @ states[:, :, 0].T + outward @ linear.d @ inward)


def estimated_response(
    u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"], step_s: float
) -> tuple[Float[np.ndarray, "K"], Complex[np.ndarray, "K"]]:
    """Frequencies in Hz and the ratio of cross spectrum to input power; empty for a short
    record."""
    segment = min(SEGMENT, len(u) // 4)
    if segment < FEWEST:
        return np.empty(0), np.empty(0, dtype=complex)
    frequency, cross = csd(u - u.mean(), y - y.mean(), fs=1 / step_s, nperseg=segment)
    power = welch(u - u.mean(), fs=1 / step_s, nperseg=segment)[1]
    whole = welch(y - y.mean(), fs=1 / step_s, nperseg=segment)[1]
    coherent = np.abs(cross) ** 2 > COHERENT * power * whole
    excited = (power > EXCITED * power.mean()) & (frequency > 0) & coherent
    return frequency[excited], cross[excited] / power[excited]
