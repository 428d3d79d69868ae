"""Validation record: measured output, and the identified model's free-run simulation from the same input."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.study_folder import Study
from ssm_study.report.trajectories import Validation

LONGEST = 1200  # samples; a longer record would be a solid block of ink in a column


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.validation is None:
        return style.message("No run left a validation record.")
    return figure(run.validation, run.record.get("fit_validation_percent"))


def figure(record: Validation, fit_percent: float | None) -> Figure:
    fig = style.canvas(style.COLUMN_IN, 3.0)
    output, given = fig.subplots(2, 1, sharex=True, height_ratios=[1.6, 1])
    shown = slice(LONGEST)
    time_s = record.time_s[shown]
    output.plot(time_s, record.y[shown, 0], color=style.GREY, lw=0.7, label="measured")
    name = "model" if fit_percent is None else f"model (fit {fit_percent:.1f} % on the whole record)"
    output.plot(time_s, record.simulated[shown, 0], color=style.BLUE, lw=1.2, label=name)
    style.above(output, columns=2)
    output.set_ylabel(record.output_label)
    given.step(time_s, record.u[shown, 0], where="post", color=style.INK, lw=0.7)
    given.set(xlabel="Time (s)", ylabel=record.input_label, xlim=_ends(time_s))
    fig.align_ylabels()
    return fig


def _ends(time_s: Float[np.ndarray, "T"]) -> tuple[float, float]:
    return float(time_s[0]), float(time_s[-1])
