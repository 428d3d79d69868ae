"""Whether a proved rate is larger than the rate at which the model contracts without control."""

from collections.abc import Mapping
from typing import Any

from ssm_study.api.summaries import rate_text
from ssm_study.certificates.decay_time import decay_time_text


def open_loop_rate(record: Mapping[str, Any]) -> float | None:
    """Contraction rate of a run's model without control; None if the model does not contract. With
    neurons that of the linear part, which is no less."""
    radius = record.get("spectral_radius")
    return None if radius is None or radius >= 1 else 1 - float(radius) ** 2


def unproved_speed_up_text(record: Mapping[str, Any], step_s: float | None) -> str:
    """Remark that the controller's proved rate is no larger than the rate without control; empty if
    it is larger."""
    rate = record.get("controller_certified_rate")
    alone = open_loop_rate(record)
    if rate is None or alone is None or rate > alone:
        return ""
    subject = "the model's linear part" if record.get("neurons") else "the model"
    timed = f"{rate_text(alone)} per sample ({decay_time_text(alone, step_s)})"
    words = f"Without control {subject} contracts at rates below {timed}"
    words += ": the controller's rate shows no gain"
    is_faster = bool(record.get("faster_than_open_loop"))
    return f"{words}, and the speed-up seen is not proved" if is_faster else words
