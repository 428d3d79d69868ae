"""Excitation by the training records: how often each input value was visited (left) and the power
at each frequency (right). At an input value that was never visited, the slope of the input map
comes from the initial weights, not from data. The order of persistent excitation bounds the order
of a linear model that the records can identify."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.signal import welch

from ssm_study import style
from ssm_study.data.metrics import HIGHEST_ORDER
from ssm_study.report.study_folder import StudyFolder

LONGEST_SEGMENT = 256  # samples per periodogram: frequency resolution against a smooth estimate


def draw(study: StudyFolder) -> Figure:
    """Draw the amplitude histogram and the spectrum of the first input of a study's training
    records. Coverage, order and warning are those found when the data set was made."""
    recording, record = study.read_from_best(
        "excitation", "record", otherwise="No run left an excitation to draw."
    )
    fig = style.new_figure(style.PAGE_IN, 2.2)
    amplitude, spectrum = fig.subplots(1, 2)
    inputs = recording.signals("input")
    label = recording.label("input")
    records = [signal.values[:, 0] for signal in inputs]
    u = np.concatenate(records)
    counts, edges = np.histogram(u, bins=40)
    amplitude.stairs(100 * counts / len(u), edges, fill=True, color=style.BLUE)
    amplitude.set(
        xlabel=label,
        ylabel="Share of samples (%)",
        title=f"Training records{_input_coverage_title(record)}",
    )
    segment = min(
        LONGEST_SEGMENT, *map(len, records)
    )  # equal for all, so that the densities can be averaged
    powers = [
        welch(own - u.mean(), fs=1 / recording.step_s("input"), nperseg=segment) for own in records
    ]
    frequency = powers[0][0]
    power = np.mean([density for _, density in powers], axis=0)
    spectrum.loglog(frequency[1:], power[1:], color=style.BLUE)  # the mean was taken out
    spectrum.yaxis.set_minor_formatter(NullFormatter())
    unit = inputs[0].channels[0].unit or "input unit"
    order = record.get("excitation_order")
    exciting = (
        f"Persistently exciting of order {order}{' or more' if order >= HIGHEST_ORDER else ''}"
        if order
        else ""
    )
    spectrum.set(xlabel="Frequency (Hz)", ylabel=f"Power density ({unit}²/Hz)", title=exciting)
    return fig


def _input_coverage_title(record: Mapping[str, Any]) -> str:
    """Title that says which fraction of the input range the training records cover."""
    if record.get("excitation_warning"):
        return ": two levels, slopes of $S_u$ not identifiable"
    share = record.get("input_coverage")
    return "" if share is None else f"; {100 * share:.0f} % of the range is trained on"
