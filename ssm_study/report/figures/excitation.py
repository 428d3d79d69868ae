"""What the data could teach: how often each input amplitude was visited (left; where nothing was visited, slopes come
from initialisation, not from data), and at which frequencies the input has power (right)."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.signal import welch

from ssm_study.report import style
from ssm_study.report.study_folder import Study


def draw(study: Study) -> Figure:
    run = study.best
    record = None if run is None else run.validation
    if run is None or record is None:
        return style.message("No run left an excitation to draw.", style.PAGE_IN)
    step_s = float(record.time_s[1] - record.time_s[0])
    return figure(record.u[:, 0], step_s, record.input_label, run.record.get("input_coverage"))


def figure(u: Float[np.ndarray, "T"], step_s: float, label: str, coverage: float | None) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.2)
    amplitude, spectrum = fig.subplots(1, 2)
    counts, edges = np.histogram(u, bins=40)
    amplitude.stairs(100 * counts / len(u), edges, fill=True, color=style.BLUE)
    amplitude.set(xlabel=label, ylabel="Share of samples (%)")
    if coverage is not None:
        amplitude.set_title(f"training records cover {100 * coverage:.0f} % of the amplitude range")
    frequency, power = welch(u - u.mean(), fs=1 / step_s, nperseg=min(256, len(u)))
    spectrum.loglog(frequency[1:], power[1:], color=style.BLUE)
    unit = label[label.find("(") + 1 : label.rfind(")")] if "(" in label else "unit"
    spectrum.set(xlabel="Frequency (Hz)", ylabel=f"Power density ({unit}²/Hz)")
    return fig
