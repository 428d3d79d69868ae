"""Picture of eigenvalues in the unit circle, with the circle of the certified rate."""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Inexact

from ssm_study import style
from ssm_study.api.pictures.drawing import circle_points
from ssm_study.api.pictures.picture import DASHED, Mark, Picture, PicturePanel, Series

MARKS: tuple[Mark, ...] = ("crosses", "circles", "triangles")
COLOURS = (style.GREY, style.BLUE, style.VERMILLION)
PRINTED = {"controlled": "controlled model", "estimate": "observer's error"}
Poles = Inexact[np.ndarray, "_"]


def poles_picture(groups: Mapping[str, Poles], rate: float | None = None) -> Picture:
    """Picture of eigenvalues in the unit circle, with a circle for the certified contraction rate.
    Its radius is `sqrt(1 - rate)`."""
    unit = circle_points()
    unit_circle = Series(x=unit[0], y=unit[1], colour=style.INK, thin=True, name="unit circle")
    series = [unit_circle]
    title = "Poles at rest, per sample"
    if rate is not None:
        factor = float(np.sqrt(1 - rate))
        x, y = circle_points(factor)
        factor_words = format_below_one(factor)
        name = f"proved under control: {factor_words}"
        circle = Series(x=x, y=y, colour=style.GREY, dashes=DASHED, name=name)
        series.append(circle)
        title = f"Poles at rest; proved: distances shrink to {factor_words} or less each sample"
    for i, (name, poles) in enumerate(groups.items()):
        values = np.asarray(poles, dtype=complex)
        printed_name = PRINTED.get(name, name)
        mark = MARKS[i % len(MARKS)]
        colour = COLOURS[i % len(COLOURS)]
        dots = Series(x=values.real, y=values.imag, mark=mark, colour=colour, name=printed_name)
        series.append(dots)
    all_series = tuple(series)
    panel = PicturePanel(
        x_label="Real part (per sample)",
        y_label="Imaginary part (per sample)",
        series=all_series,
        equal=True,
        height=2.2,
    )
    return Picture(title=title, panels=(panel,))


def format_below_one(factor: float) -> str:
    """Text of a factor, rounded up, with enough digits that a factor below one is not printed as
    one."""
    for digits in range(3, 16):
        text = f"{math.ceil(factor * 10**digits) / 10**digits:.{digits}f}"
        if float(text) < 1:
            return text
    return str(factor)
