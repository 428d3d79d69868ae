"""A picture as values: panels with series, rules and bands, ready to be drawn by anything."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ssm_study import style

Mark = Literal["line", "steps", "dots", "stems", "crosses", "circles", "triangles", "point"]
Values = Float[np.ndarray, "N"]


@dataclass(frozen=True, kw_only=True)
class Series:
    """One signal or set of points; NaN in `y` breaks a line. Without a name it has no legend."""

    x: Values
    y: Values
    name: str = ""
    mark: Mark = "line"
    colour: str = style.BLUE
    dashed: bool = False
    thin: bool = False


@dataclass(frozen=True, kw_only=True)
class GuideLine:
    """A straight line over the whole panel, at `y` or at `x`."""

    y: float | None = None
    x: float | None = None
    name: str = ""
    dashed: bool = True


@dataclass(frozen=True, kw_only=True)
class Band:
    """A shaded area: between `low` and `high` along `x`; with two values of x a rectangle."""

    x: Values
    low: Values
    high: Values
    name: str = ""
    colour: str = style.PALE


@dataclass(frozen=True, kw_only=True)
class PicturePanel:
    """One pair of axes. `equal` gives both axes the same scale; a range limits what is drawn."""

    x_label: str
    y_label: str
    series: tuple[Series, ...]
    title: str = ""
    rules: tuple[GuideLine, ...] = ()
    bands: tuple[Band, ...] = ()
    log_x: bool = False
    log_y: bool = False
    equal: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    height: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Panels row by row, `columns` side by side; `title` says what is seen, with its number."""

    title: str
    panels: tuple[PicturePanel, ...]
    columns: int = 1
    wide: bool = False


class NothingToShow(Exception):
    """Error that says in a sentence why a picture would be empty."""
