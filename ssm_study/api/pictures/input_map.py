"""Picture of a learned input map and its slope."""

import numpy as np

from ssm_study import style
from ssm_study.api.pictures.picture import Band, NothingToShow, Picture, PicturePanel, Series
from ssm_study.models.structured import Model
from ssm_study.systems import JacobianBall

REACH_IN_SCALES = 2.0  # how far training reached, in input scales
POINTS = 401
ROOM = 0.15  # beyond the certified slopes, as a share of their interval: its ends are seen
LINEAR = 1e-9  # relative spread of the slope below which a map is called linear


def input_map_picture(model: Model, slopes: JacobianBall, input_label: str) -> Picture:
    """Picture of one input's learned static map and its slope, with the certified interval of
    slopes.

    Raises `NothingToShow` for several inputs.
    """
    if model.scaffold_in.inputs != 1:
        raise NothingToShow("The input map has several inputs: there is no curve to draw.")
    scaled = np.linspace(-REACH_IN_SCALES, REACH_IN_SCALES, POINTS)
    input_equilibrium = model.scale.input_equilibrium
    input_scale = model.scale.input_scale
    physical = input_equilibrium[0] + scaled * input_scale[0]
    values = model.scaffold_in(scaled[:, None])[:, 0]
    local = np.array([model.scaffold_in.jacobian(np.array([v]))[0, 0] for v in scaled])
    ends = physical[[0, -1]]
    name = f"certified [{slopes.lower:.3g}, {slopes.upper:.3g}]"
    low = np.full(2, slopes.lower)
    high = np.full(2, slopes.upper)
    band = Band(x=ends, low=low, high=high, name=name, colour=style.SKY)
    series = (Series(x=physical, y=values),)
    room = ROOM * float(slopes.upper - slopes.lower) or 1.0
    lowest = min(slopes.lower, local.min())
    highest = max(slopes.upper, local.max())
    left = PicturePanel(
        x_label=input_label, y_label="S_u (scaled units, –)", series=series, height=1.3
    )
    right = PicturePanel(
        x_label=input_label,
        y_label="Local slope of S_u (–)",
        series=(Series(x=physical, y=local, mark="steps", name="learned"),),
        bands=(band,),
        y_range=(float(lowest) - room, float(highest) + room),
    )
    is_linear = np.ptp(local) <= LINEAR * np.abs(local).max()
    title = "Input map: linear" if is_linear else _slope_title(local)
    panels = (left, right)
    return Picture(title=title, panels=panels, columns=2)


def _slope_title(local: np.ndarray) -> str:
    """Title that says how much the slope of the input map varies."""
    ratio = np.abs(local).min() / np.abs(local).max()
    return f"Learned input map: its smallest slope is {100 * ratio:.0f} % of its largest"
