"""Pictures as plain values: panels with curves, guide lines and shaded areas."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ssm_study import style

Mark = Literal["line", "steps", "dots", "stems", "crosses", "circles", "triangles", "point"]
Dashes = tuple[int, ...]
DASHED: Dashes = (5, 3)
# Of neighbouring lines: a reader who cannot tell their colours apart can tell these.
DASH_CYCLE: tuple[Dashes, ...] = ((), (7, 3), (2, 2), (8, 2, 2, 2), (14, 4), (4, 2, 1, 2, 1, 2))
Values = Float[np.ndarray, "N"]


@dataclass(frozen=True, kw_only=True)
class Series:
    """One curve or one set of points in a picture, with a name for the legend if it has one.

    `dashes` are the lengths of dash and gap in turn, in points; a solid line has none.
    """

    x: Values
    y: Values
    name: str = ""
    mark: Mark = "line"
    colour: str = style.BLUE
    dashes: Dashes = ()
    thin: bool = False


@dataclass(frozen=True, kw_only=True)
class GuideLine:
    """Straight horizontal or vertical line over a whole panel."""

    y: float | None = None
    x: float | None = None
    name: str = ""
    dashed: bool = True


@dataclass(frozen=True, kw_only=True)
class Band:
    """Shaded area of a panel between a lower and an upper curve."""

    x: Values
    low: Values
    high: Values
    name: str = ""
    colour: str = style.PALE


@dataclass(frozen=True, kw_only=True)
class PicturePanel:
    """One panel of a picture: a pair of axes with its curves, guide lines and shaded areas. `equal`
    gives both axes the same scale; a range limits what is drawn."""

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
    """Description of a picture, independent of how it is drawn: its panels, row by row, and a
    title."""

    title: str
    panels: tuple[PicturePanel, ...]
    columns: int = 1
    wide: bool = False


class EmptyPictureError(Exception):
    """Error raised where a picture would be empty, with the reason in one sentence."""
