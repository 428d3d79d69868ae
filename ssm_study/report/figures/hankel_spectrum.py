"""How many states the model really uses: Hankel singular values of the best run's model, relative to the largest. A
state far below the first carries almost nothing from input to output, and is costly to control."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssm_study.bounds.hankel import hankel_singular_values
from ssm_study.report import style
from ssm_study.report.study_folder import Study


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.model is None:
        return style.message("No run left a model.")
    if run.model.linear.spectral_radius >= 1:
        return style.message("The linear part is not stable: it has no Hankel singular values.")
    return figure(hankel_singular_values(run.model.linear))


def figure(values: Float[np.ndarray, "n"]) -> Figure:
    fig = style.canvas(style.COLUMN_IN, 2.1)
    axes = fig.add_subplot()
    state = np.arange(1, len(values) + 1)
    axes.vlines(state, values.min() / values[0] / 3, values / values[0], color=style.SKY, lw=2.5)
    axes.plot(state, values / values[0], "o", color=style.BLUE)
    axes.set_yscale("log")
    axes.set(xlabel="Balanced state", ylabel="Hankel singular value\nrelative to the largest (–)")
    axes.set_title(f"largest: {values[0]:.3g}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return fig
