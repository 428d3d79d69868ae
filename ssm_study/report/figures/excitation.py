"""What the data could teach: how often each input amplitude was visited (left; where nothing was visited, slopes come
from initialisation, not from data), at which frequencies the input has power, and of which order it is persistently
exciting (right)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.signal import welch

from ssm_study.data.coverage import HIGHEST_ORDER
from ssm_study.report import style
from ssm_study.report.study_folder import Study
from ssm_study.report.trajectories import Excitation

LONGEST_SEGMENT = 256  # samples per periodogram: frequency resolution against a smooth estimate


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.excitation is None:
        return style.message("No run left an excitation to draw.", style.PAGE_IN)
    return figure(run.excitation, run.record)


def figure(excitation: Excitation, record: Mapping[str, Any]) -> Figure:
    """`record` states coverage, order and warning as they were found when the data set was made."""
    fig = style.canvas(style.PAGE_IN, 2.2)
    amplitude, spectrum = fig.subplots(1, 2)
    u, label = np.concatenate(excitation.u), excitation.input_label
    counts, edges = np.histogram(u, bins=40)
    amplitude.stairs(100 * counts / len(u), edges, fill=True, color=style.BLUE)
    title = f"{excitation.records.capitalize()}{_covered(record)}"
    amplitude.set(xlabel=label, ylabel="Share of samples (%)", title=title)
    segment = min(LONGEST_SEGMENT, *(len(record) for record in excitation.u))
    powers = [welch(record - u.mean(), fs=1 / excitation.step_s, nperseg=segment) for record in excitation.u]
    frequency, power = powers[0][0], np.mean([density for _, density in powers], axis=0)
    spectrum.loglog(frequency[1:], power[1:], color=style.BLUE)
    spectrum.yaxis.set_minor_formatter(NullFormatter())
    unit = label[label.find("(") + 1 : label.rfind(")")]
    spectrum.set(xlabel="Frequency (Hz)", ylabel=f"Power density ({unit}²/Hz)", title=_order(record))
    return fig


def _covered(record: Mapping[str, Any]) -> str:
    if record.get("excitation_warning"):
        return ": two levels, slopes of $S_u$ not identifiable"
    share = record.get("input_coverage")
    return "" if share is None else f"; {100 * share:.0f} % of the range is trained on"


def _order(record: Mapping[str, Any]) -> str:
    order = record.get("excitation_order")
    if order is None:
        return ""
    return f"Persistently exciting of order {order}{' or more' if order >= HIGHEST_ORDER else ''}"
