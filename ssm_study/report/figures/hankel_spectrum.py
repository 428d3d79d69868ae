"""Hankel singular values of the best run's model, relative to the largest. They say how many states
the model really uses. A state far below the first carries almost nothing from input to output, and
is costly to control."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssm_study import style
from ssm_study.bounds.gramians import hankel_singular_values
from ssm_study.report.study_folder import NothingToDraw, StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the Hankel singular values of the best run's model."""
    (model,) = study.read_from_best("model", otherwise="No run left a model without neurons.")
    if model.linear.spectral_radius >= 1:
        raise NothingToDraw("The linear part is not stable: it has no Hankel singular values.")
    values = hankel_singular_values(model.linear)
    relative = values / values[0]
    state = np.arange(1, len(values) + 1)
    fig = style.new_figure(style.COLUMN_IN, 2.1)
    axes = fig.add_subplot(yscale="log")
    axes.vlines(
        state, relative.min() / 3, relative, color=style.SKY, lw=2.5
    )  # from below the smallest
    axes.plot(state, relative, "o", color=style.BLUE)
    axes.set(xlabel="Balanced state", ylabel="Hankel singular value\nrelative to the largest (–)")
    axes.set_title(f"The largest is {values[0]:.3g}.")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return fig
