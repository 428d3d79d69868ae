"""What the data could teach: how often each input amplitude was visited (left; where nothing was visited, slopes come
from initialisation, not from data), and at which frequencies the input has power (right)."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.signal import welch

from ssm_study.report import style
from ssm_study.report.study_folder import Study
from ssm_study.report.trajectories import Excitation

LONGEST_SEGMENT = 256  # samples per periodogram: frequency resolution against a smooth estimate


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.excitation is None:
        return style.message("No run left an excitation to draw.", style.PAGE_IN)
    return figure(run.excitation, run.record.get("input_coverage"))


def figure(excitation: Excitation, coverage: float | None) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.2)
    amplitude, spectrum = fig.subplots(1, 2)
    u, label = np.concatenate(excitation.u), excitation.input_label
    counts, edges = np.histogram(u, bins=40)
    amplitude.stairs(100 * counts / len(u), edges, fill=True, color=style.BLUE)
    covered = "" if coverage is None else f"; {100 * coverage:.0f} % of the range is trained on"
    amplitude.set(xlabel=label, ylabel="Share of samples (%)", title=f"{excitation.records.capitalize()}{covered}")
    segment = min(LONGEST_SEGMENT, *(len(record) for record in excitation.u))
    powers = [welch(record - u.mean(), fs=1 / excitation.step_s, nperseg=segment) for record in excitation.u]
    frequency, power = powers[0][0], np.mean([density for _, density in powers], axis=0)
    spectrum.loglog(frequency[1:], power[1:], color=style.BLUE)
    spectrum.yaxis.set_minor_formatter(NullFormatter())
    unit = label[label.find("(") + 1 : label.rfind(")")]
    spectrum.set(xlabel="Frequency (Hz)", ylabel=f"Power density ({unit}²/Hz)")
    return fig
