"""Picture of a log, which `ssm-study look` draws: inputs and outputs over time, with gaps."""

from typing import TYPE_CHECKING

from ssm_study import style
from ssm_study.data.plain_names import drawable_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssm_study.data.look import LogOverview


def draw_log(log: "LogOverview") -> "Figure":
    """Draw the signals of a log over time, the outputs above the inputs, and measured disturbances
    below both. Gaps of the log stay white."""
    from matplotlib.figure import Figure

    with style.paper_style():
        figure = Figure(figsize=(style.PAGE_IN, 3.6), layout="constrained")
        panels = figure.subplots(2 if log.disturbance is None else 3, 1, sharex=True)
        upper = panels[0]
        lower = panels[1]
        for record in log.records:
            time_s = record.first * record.step_s + record.time_s
            upper.plot(time_s, record.y[:, 0], color=style.BLUE, linewidth=0.8)
            lower.step(time_s, record.u[:, 0], where="post", color=style.VERMILLION, linewidth=0.8)
            if record.d is not None:
                panels[2].plot(time_s, record.d[:, 0], color=style.GREEN, linewidth=0.8)
                panels[2].set_ylabel(drawable_title(log.disturbance or "disturbance"))
        upper.set_ylabel(drawable_title(log.output or "output"))
        lower.set_ylabel(drawable_title(log.input or "input"))
        panels[-1].set_xlabel("time (s)" if log.step_is_known else "sample")
        upper.set_title(drawable_title(log.path.name), fontsize="medium")
    return figure
