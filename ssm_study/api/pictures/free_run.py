"""Picture of models' free runs on a record, with their errors."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ssm_study import style
from ssm_study.api.pictures.picture import Band, GuideLine, Picture, PicturePanel, Series
from ssm_study.signals import fit_percent

LONGEST = 2000  # samples drawn: more would be a solid block of ink
Outputs = Float[np.ndarray, "T p"]


def free_run_picture(
    time_s: Float[np.ndarray, "T"],
    measured: Outputs,
    simulated: Mapping[str, Outputs],
    labels: Sequence[str],
    start_up: int = 0,
    record_words: str = "the test record",
) -> Picture:
    """Picture of free-run simulations beside the measured outputs of a record, with the errors
    below.

    Of a longer record the first `LONGEST` samples are drawn; the fit is of the whole.
    """
    drawn_series = slice(0, LONGEST)
    fits = {
        name: fit_percent(measured[start_up:], output[start_up:])
        for name, output in simulated.items()
    }
    upper = []
    lower = []
    for j, label in enumerate(labels):
        y = measured[drawn_series, j]
        start = _start_up_band(time_s[drawn_series], y, start_up)
        dots = Series(x=time_s[drawn_series], y=y, mark="dots", colour=style.GREY, name="measured")
        runs = [dots]
        errors = []
        for i, (name, output) in enumerate(simulated.items()):
            colour_number = i % len(style.CYCLE)
            colour = style.CYCLE[colour_number]
            legend = f"{name}, fit {fits[name]:.1f} %"
            drawn_output = output[drawn_series, j]
            run = Series(x=time_s[drawn_series], y=drawn_output, colour=colour, name=legend)
            runs.append(run)
            error = y - output[drawn_series, j]
            error_colour = _error_colour(i)
            series = Series(x=time_s[drawn_series], y=error, colour=error_colour, thin=True)
            errors.append(series)
        picture_panel = PicturePanel(
            x_label="Time (s)", y_label=label, series=tuple(runs), bands=start, height=1.3
        )
        upper.append(picture_panel)
        lower.append(_error_panel(errors, label))
    best = max(fits.values())
    title = f"Free run on {record_words}: fit {best:.1f} %"
    if len(measured) > LONGEST:
        title += f" (drawn: the first {LONGEST} of {len(measured)} samples)"
    panels = (*upper, *lower)
    column_count = len(labels)
    return Picture(title=title, panels=panels, columns=column_count, wide=True)


def _error_panel(errors: list[Series], label: str) -> PicturePanel:
    """Panel of a picture with the simulation errors of several models in one output, and a line at
    zero."""
    zero = GuideLine(y=0.0, dashed=False)
    are_several = len(errors) > 1
    drawn_errors = tuple(errors) if are_several else _recolour_single_error(errors)
    return PicturePanel(
        x_label="Time (s)",
        y_label=f"Error{_unit_in_label(label)}",
        series=drawn_errors,
        rules=(zero,),
        height=0.7,
    )


def _error_colour(i: int) -> str:
    """Colour of a model's error curve, the same as that of the model's free run."""
    colour_number = i % len(style.CYCLE)
    return style.CYCLE[colour_number]


def _recolour_single_error(errors: list[Series]) -> tuple[Series, ...]:
    """Copy of error curves in vermilion, for a picture of a single model."""
    recoloured = (
        Series(x=series.x, y=series.y, colour=style.VERMILLION, thin=True) for series in errors
    )
    return tuple(recoloured)


def _unit_in_label(label: str) -> str:
    """Unit at the end of an axis label, with its parentheses."""
    return f" ({label.rpartition('(')[2]}" if "(" in label else ""


def _start_up_band(
    time_s: Float[np.ndarray, "T"], values: Float[np.ndarray, "T"], samples: int
) -> tuple[Band, ...]:
    """Shaded band over the first samples of a record, which serve to estimate the initial state and
    are not scored."""
    if not samples:
        return ()
    last = min(samples, len(time_s) - 1)
    ends = time_s[[0, last]]
    lowest = values.min()
    low = np.full(2, lowest)
    highest = values.max()
    high = np.full(2, highest)
    band = Band(x=ends, low=low, high=high, name="initial state, not scored")
    return (band,)
