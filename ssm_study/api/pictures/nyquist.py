"""Nyquist curve of the loop, with a disc around each point for the measured model error."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from ssm_study import style
from ssm_study.api.pictures.drawing import circle_points
from ssm_study.api.pictures.picture import DASHED, EmptyPictureError, Picture, PicturePanel, Series
from ssm_study.bounds.frequency import frequency_response
from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.robustness.sensitivity import FINE_ANGLES, error_to_input_response
from ssm_study.systems import Gains

REACH = 2.2  # how far from the origin the curve is drawn: the point -1 decides
SMALLEST_DISC = 0.01  # a smaller one is not seen


def nyquist_picture(model: Model, gains: Gains, mismatch: Mismatch | None) -> Picture:
    """Nyquist plot of the loop gain at the equilibrium, with discs for the measured model error.
    The loop gain is `-C P`.

    The plant at one amplitude is `P (1 + Q)` up to a gain `g_r` from input to output, so the curve
    is `L (1 + Q)` and its discs have the radius `|C| g_r`: the loop is stable at these slopes if
    the curve does not wind around -1 and no disc holds it. The amplitude drawn is the one whose
    discs come nearest. Raises `EmptyPictureError` for several inputs or outputs.
    """
    inputs = model.scale.inputs
    if inputs != 1 or model.scale.outputs != 1:
        raise EmptyPictureError("A Nyquist curve is drawn for one input and one output.")
    plant, controller = plant_and_controller_responses(model, gains, FINE_ANGLES)
    loop = -plant * controller
    model_curve = _visible_curve(loop, "model", style.BLUE)
    series = [model_curve]
    title = "Nyquist curve of the loop at the equilibrium"
    if mismatch is not None:
        discs, distance = _nearest_discs(model, gains, mismatch.views)
        series.append(discs)
        title = (
            f"The point -1 lies {distance:.2g} outside the discs of the measured error"
            if distance > 0
            else "A disc of the measured error holds the point -1"
        )
    series.append(_critical_point())
    unit = circle_points()
    circle_series = Series(
        x=unit[0], y=unit[1], colour=style.GREY, dashes=DASHED, thin=True, name="gain 1"
    )
    x_range = (-REACH, REACH)
    y_range = (-REACH, REACH)
    all_series = (circle_series, *series)
    panel = PicturePanel(
        x_label="Real part (–)",
        y_label="Imaginary part (–)",
        series=all_series,
        equal=True,
        x_range=x_range,
        y_range=y_range,
        height=2.2,
    )
    return Picture(title=title, panels=(panel,))


def plant_and_controller_responses(
    model: Model, gains: Gains, angles: Float[np.ndarray, "F"]
) -> tuple[Complex[np.ndarray, "F"], Complex[np.ndarray, "F"]]:
    """Frequency responses of plant and controller in the closed loop. `C = T_ue / (1 + P T_ue)`."""
    linear = linearise_at_equilibrium(model)
    jacobian_in = model.scaffold_in.jacobian(np.zeros(1))
    slope_in = float(jacobian_in[0, 0])
    jacobian_out = model.scaffold_out.jacobian(np.zeros(1))
    slope_out = float(jacobian_out[0, 0])
    state_space = error_to_input_response(linear, gains, slope_in, slope_out)
    closed_loop = frequency_response(state_space, angles)
    closed = closed_loop[:, 0, 0]
    linear_response = frequency_response(linear, angles)[:, 0, 0]
    plant = slope_in * slope_out * linear_response
    return plant, closed / (1 + plant * closed)


def _nearest_discs(
    model: Model, gains: Gains, views: Sequence[ModelErrorAtAmplitude]
) -> tuple[Series, float]:
    """Discs of model error at the amplitude whose discs come nearest to the point -1, with their
    distance.

    Each amplitude has two descriptions, by size alone and with the phase of its linear part. Either
    is sufficient for stability, so the one whose discs lie farther away counts.
    """
    angles = np.maximum(ANGLES, 1e-4)
    plant, controller = plant_and_controller_responses(model, gains, angles)
    nearest: tuple[Series, float] | None = None
    for view in views:
        linear_part = 0 * view.linear
        by_size = _nyquist_discs(plant, controller, linear_part, view.by_frequency)
        with_phase = _nyquist_discs(plant, controller, view.linear, view.rest)
        farther = max(by_size, with_phase, key=lambda candidate: candidate[1])
        if nearest is None or farther[1] < nearest[1]:
            nearest = farther
    assert nearest is not None
    return nearest


def _nyquist_discs(
    plant: Complex[np.ndarray, "F"],
    controller: Complex[np.ndarray, "F"],
    linear_part: Complex[np.ndarray, "F"],
    remainder: Float[np.ndarray, "F"],
) -> tuple[Series, float]:
    """Discs around the loop gain that contain the measured model error, and their distance from the
    critical point -1. `L (1 + Q)`."""
    centres = -plant * controller * (1 + linear_part)
    radii = np.abs(controller) * remainder
    series = _disc_outlines(centres, radii)
    distance = (np.abs(centres + 1) - radii).min()
    return series, float(distance)


def _visible_curve(values: Complex[np.ndarray, "F"], name: str, colour: str) -> Series:
    """Part of a Nyquist curve that lies within the picture's range."""
    near = np.abs(values) < 2 * REACH
    y = np.where(near, values.imag, np.nan)
    visible_real = np.where(near, values.real, np.nan)
    return Series(x=visible_real, y=y, name=name, colour=colour)


def _disc_outlines(centres: Complex[np.ndarray, "F"], radii: Float[np.ndarray, "F"]) -> Series:
    """Outlines of all discs inside the visible range of a Nyquist plot, joined to one line with
    gaps."""
    rims = []
    x, y = circle_points(points=25)
    for centre, radius in zip(centres, radii, strict=True):
        if radius > SMALLEST_DISC and np.abs(centre) < 2 * REACH:
            offset = radius * (x + 1j * y)
            rim = centre + offset
            gap = complex(np.nan, np.nan)
            outline = np.append(rim, gap)
            rims.append(outline)
    points = np.concatenate(rims) if rims else np.empty(0, dtype=complex)
    return Series(
        x=points.real,
        y=points.imag,
        name="measured error, by band",
        colour=style.VERMILLION,
        thin=True,
    )


def _critical_point() -> Series:
    """Critical point -1, which the Nyquist curve must not encircle."""
    y = np.array([0.0])
    real_part = np.array([-1.0])
    return Series(x=real_part, y=y, mark="crosses", colour=style.INK, name="-1")
