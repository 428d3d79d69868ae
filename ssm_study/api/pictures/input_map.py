"""Picture of a learned input map and its slope."""

import numpy as np

from ssm_study import style
from ssm_study.api.pictures.picture import Band, EmptyPictureError, Picture, PicturePanel, Series
from ssm_study.models.structured import Model
from ssm_study.systems import JacobianBall

REACH_IN_SCALES = 2.0  # how far training reached, in input scales
POINTS = 401
ROOM = 0.15  # beyond the certified slopes, as a share of their interval: its ends are seen
LINEAR = 1e-9  # relative spread of the slope below which a map is called linear


def input_map_picture(model: Model, slopes: JacobianBall, input_label: str) -> Picture:
    """Picture of the learned static map of one input and of its slope, with the certified interval
    of slopes.

    Raises `EmptyPictureError` for several inputs.
    """
    if model.scaffold_in.inputs != 1:
        raise EmptyPictureError("The input map has several inputs: there is no curve to draw.")
    scaled = np.linspace(-REACH_IN_SCALES, REACH_IN_SCALES, POINTS)
    input_equilibrium = model.scale.input_equilibrium
    input_scale = model.scale.input_scale
    deviation = scaled * input_scale[0]
    physical = input_equilibrium[0] + deviation
    input_column = scaled[:, None]
    values = model.scaffold_in(input_column)[:, 0]
    slopes_at_inputs = [model.scaffold_in.jacobian(np.array([v]))[0, 0] for v in scaled]
    local = np.array(slopes_at_inputs)
    ends = physical[[0, -1]]
    name = f"certified [{slopes.lower:.3g}, {slopes.upper:.3g}]"
    low = np.full(2, slopes.lower)
    high = np.full(2, slopes.upper)
    band = Band(x=ends, low=low, high=high, name=name, colour=style.SKY)
    map_curve = Series(x=physical, y=values)
    series = (map_curve,)
    left = PicturePanel(
        x_label=input_label, y_label="S$_u$ (scaled units, –)", series=series, height=1.3
    )
    slope_curve = Series(x=physical, y=local, mark="steps", name="learned")
    right = PicturePanel(
        x_label=input_label,
        y_label="Local slope of S$_u$ (scaled units, –)",
        series=(slope_curve,),
        bands=(band,),
        y_range=_slope_axis_range(slopes, local),
    )
    variation = np.ptp(local)
    steepest = np.abs(local).max()
    is_linear = variation <= LINEAR * steepest
    title = "Input map: linear" if is_linear else _slope_title(local)
    panels = (left, right)
    return Picture(title=title, panels=panels, columns=2)


def _slope_axis_range(slopes: JacobianBall, learned_slopes: np.ndarray) -> tuple[float, float]:
    """Range of a vertical axis that shows the certified interval of slopes and all learned
    slopes."""
    interval = slopes.upper - slopes.lower
    room = ROOM * float(interval) or 1.0
    smallest_slope = learned_slopes.min()
    lowest = min(slopes.lower, smallest_slope)
    largest_slope = learned_slopes.max()
    highest = max(slopes.upper, largest_slope)
    lower_end = float(lowest) - room
    upper_end = float(highest) + room
    return lower_end, upper_end


def _slope_title(learned_slopes: np.ndarray) -> str:
    """Title of a picture that says how much the slope of the input map varies."""
    flattest = np.abs(learned_slopes).min()
    steepest = np.abs(learned_slopes).max()
    ratio = flattest / steepest
    return f"Learned input map: its smallest slope is {100 * ratio:.0f} % of its largest"
