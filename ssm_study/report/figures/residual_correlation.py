"""Correlation of the error of the free run on the test record with itself (left) and with the input
(right). Outside the grey band (95 % for white noise) something is left to explain; a free run of a
nonlinear plant hardly ever stays inside."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.api.plots import correlate
from ssm_study.report.study_folder import StudyFolder

LAGS = 25
SURE = 1.96  # standard deviations of a normal distribution that hold 95 %


def draw(study: StudyFolder) -> Figure:
    """Draw the correlations of the first input and output channel over the whole record."""
    test, record = study.of_best("test", "record", otherwise="No run left a test record.")
    start = int(record.get("start_up_samples") or 0)
    error = (test["measured"] - test["simulated"])[0, start:, :1]
    u = test["input"][0, start:, :1]
    lags = min(LAGS, len(error) // 4)
    bound = SURE / np.sqrt(len(error))
    fig = style.canvas(style.PAGE_IN, 2.2)
    own, cross = fig.subplots(1, 2, sharey=True)
    _stems(own, correlate([error], [error], 0, 0, lags, one_sided=True), bound)
    _stems(cross, correlate([error], [u], 0, 0, lags, one_sided=False), bound)
    own.set(ylabel="Correlation of the error (–)", title="With itself")
    cross.set(ylabel="Correlation with the input (–)", title="With the input")
    return fig


def _stems(axes: Axes, correlation: tuple[Any, Float[np.ndarray, "L"]], bound: float) -> None:
    lags, values = correlation
    axes.axhspan(-bound, bound, color=style.PALE, lw=0)
    axes.vlines(lags, 0, values, color=style.BLUE, lw=1.0)
    axes.plot(lags, values, "o", ms=2, color=style.BLUE)
    axes.set(xlabel="Lag (samples)")
