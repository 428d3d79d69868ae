"""Picture of a log, which `ssm-study look` draws: inputs and outputs over time, with gaps."""

from typing import TYPE_CHECKING

from ssm_study import style
from ssm_study.data.command_words import find_column_index
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
                panels[2].set_ylabel(_axis_label(log, log.disturbance, "disturbance"))
        upper.set_ylabel(_axis_label(log, log.output, "output"))
        lower.set_ylabel(_axis_label(log, log.input, "input"))
        panels[-1].set_xlabel("time (s)" if log.step_is_known else "sample")
        upper.set_title(drawable_title(log.path.name), fontsize="medium")
    return figure


def _axis_label(log: "LogOverview", name: str | None, role: str) -> str:
    """Name of a signal of a log with its unit, if the log states one."""
    if name is None:
        return role
    titles = [column.name for column in log.columns]
    place = find_column_index(titles, name)
    unit = "" if place is None else drawable_title(log.columns[place].unit)
    title = drawable_title(name)
    is_stated = bool(unit) and unit not in title
    return f"{title} ({unit})" if is_stated else title
