"""Card of the report page on what is proved of a run, and on what the proof does not cover."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.api.summaries import rate_text
from ssm_study.certificates.decay_time import decay_time_text
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.report.outcome import fresh_error_ratio_text, refit_text, unused_data_exceed_coverage
from ssm_study.report.page.card import Card, Record
from ssm_study.report.speed_up import open_loop_rate, unproved_speed_up_text
from ssm_study.study.recordings import RecordedCases

TITLE = "Proved of the model"


@dataclass(frozen=True, kw_only=True)
class RecordedLoopFacts:
    """Facts on a recorded closed loop, in physical units, with which the report page compares the
    proof. The settling band lies around the output at rest; None if it was not recorded."""

    initial_outputs: Float[np.ndarray, "N p"]
    input_range: tuple[float, float]
    output_unit: str
    input_unit: str
    step_s: float
    output_at_rest: float = 0.0
    settling_band: float | None = None

    @classmethod
    def from_recording(cls, recording: RecordedCases) -> "RecordedLoopFacts":
        """Read the facts on a closed loop from its recording."""
        inputs = recording["input"]
        band = recording.about.get("settling_band")
        return cls(
            initial_outputs=recording["output"][:, 0],
            input_range=(float(inputs.min()), float(inputs.max())),
            output_unit=recording.unit("output"),
            input_unit=recording.unit("input"),
            step_s=recording.step_s("output"),
            output_at_rest=float(recording["reference"][0, -1, 0]),
            settling_band=None if band is None else float(band),
        )

    def is_within_settling_band(self, lower: float, upper: float) -> bool:
        """Whether all outputs between two values count as settled."""
        farthest = max(abs(lower - self.output_at_rest), abs(upper - self.output_at_rest))
        return self.settling_band is not None and farthest <= self.settling_band

    def count_initial_states_inside(self, lower: float, upper: float) -> int:
        """Number of recorded initial states all of whose outputs lie between two values."""
        is_inside = (self.initial_outputs >= lower) & (self.initial_outputs <= upper)
        return int(is_inside.all(axis=1).sum())


def certified_rates_card(record: Record, loop: RecordedLoopFacts | None = None) -> Card | None:
    """Card of the report page on the certified contraction rates and the model error that the proof
    covers."""
    rate = record.get("controller_certified_rate")
    requested = record.get("rate_controller")
    limit = record.get("controller_rate_limit")
    if rate is None:
        rate = requested
    if rate is None:
        return None
    if record.get("controller_certified") and record.get("observer_certified"):
        step_s = None if loop is None else loop.step_s
        slower = unproved_speed_up_text(record, step_s)
        lines = (slower, contraction_text(record, rate, loop), coverage_sentence(record))
        headline = f"certified rate per sample{time_constant_text(rate, loop)}"
        return Card(
            title=TITLE,
            number=rate_text(rate),
            text=f"{headline}{input_limit_text(record, loop)}",
            lines=tuple(filter(None, lines)),
            not_covered=tuple(unproved_statements(record, loop)),
        )
    if limit is None:
        return Card(title=TITLE, number="nothing", text="there is no certificate")
    requested_words = "" if requested is None else f"; requested: {requested:.3g}"
    text = f"largest rate that can be certified{requested_words}"
    return Card(title=TITLE, number=f"{limit:.3g}", text=text)


def contraction_text(record: Record, rate: float, loop: RecordedLoopFacts | None) -> str:
    """Text line that says how much the distance of two trajectories shrinks at a certified rate."""
    shrinks = 100 - 100 * math.sqrt(1 - rate)
    step = "" if loop is None else f" ({sampling_time_text(loop.step_s)})"
    observer = record.get("observer_certified_rate")
    also = ""
    if observer is not None:
        also = f"; observer: rate {rate_text(observer)}{time_constant_text(observer, loop)}"
    shrinking = f"distances shrink by {shrinks:.2g} % or more a sample{step}"
    return f"Under control, {shrinking}, their squares by the rate{also}"


def time_constant_text(rate: float, loop: RecordedLoopFacts | None) -> str:
    """Time constant of a contraction rate as text, in seconds or in samples."""
    decay = decay_time_text(rate, None if loop is None else loop.step_s)
    return f", {decay}" if decay else ""


def sampling_time_text(step_s: float) -> str:
    """Sampling time as text with its unit: milliseconds below a second."""
    return f"{1000 * step_s:.3g} ms" if step_s < 1 else f"{step_s:.3g} s"


def coverage_sentence(record: Record) -> str:
    """Sentence on how large a model error the stability proof covers, relative to the recorded one.
    Below one it covers nothing."""
    coverage = record.get("coverage")
    if record.get("evidence") == CANNOT_JUDGE:
        return ""
    if coverage is None:
        reason = record.get("coverage_reason")
        return f"No model error is covered ({reason})" if reason else ""
    if coverage < 1:
        return "The model error that the records show is not covered"
    covered = f"A model error {coverage_text(coverage)} times as large as the records show is "
    covered += "covered, at every frequency above zero: on such a plant the loop comes to rest, "
    covered += f"while the rates are those of the model{refit_text(record)}"
    if unused_data_exceed_coverage(record):  # a remark of its own says so
        return covered
    return covered + fresh_error_ratio_text(record)


def coverage_text(coverage: float) -> str:
    """Text of a coverage (tolerated model error relative to the recorded one), rounded down."""
    return f"{math.floor(100 * coverage) / 100:.2f}"


def full_rate_initial_outputs(record: Record) -> tuple[float, float] | None:
    """Range of initial outputs from which the contraction rate proved without input limits also
    holds with them."""
    names = ("limit_lower", "limit_upper", "unlimited_from", "unlimited_to")
    if any(record.get(name) is None for name in names):
        return None
    return float(record["unlimited_from"]), float(record["unlimited_to"])


def input_limit_text(record: Record, loop: RecordedLoopFacts | None) -> str:
    """Text on the input limits and the range of initial outputs for which the certified rate holds.
    It names the share of the shown starts among them."""
    start_range = full_rate_initial_outputs(record)
    if start_range is None:
        return ""
    first, last = start_range
    input_unit = "" if loop is None else f" {loop.input_unit}".rstrip()
    output_unit = "" if loop is None else f" {loop.output_unit}".rstrip()
    limits = f"{record['limit_lower']:.3g} and {record['limit_upper']:.3g}{input_unit}"
    outputs = f"{first:.3g} and {last:.3g}{output_unit}"
    share = ""
    if loop is not None:
        inside = loop.count_initial_states_inside(*start_range)
        verb = "lies" if inside == 1 else "lie"
        if loop.is_within_settling_band(*start_range):
            share = f", all within the settling band of ±{loop.settling_band:.3g}{output_unit}"
        share += f", where {inside} of the {len(loop.initial_outputs)} starts shown {verb}"
    everywhere = limited_input_rate_text(record, loop)
    return (
        f"; with the input between {limits} only from rest at outputs between {outputs}{share}; "
        f"from everywhere {everywhere}"
    )


def limited_input_rate_text(record: Record, loop: RecordedLoopFacts | None) -> str:
    """Text on the contraction rate that is proved from all initial states with a limited input."""
    rate = record.get("limited_rate")
    if rate is None:
        return "no rate is proved"
    words = f"the rate {rate_text(rate)}{time_constant_text(rate, loop)}"
    is_no_gain = rate <= (open_loop_rate(record) or 0.0)
    return f"{words} (no more than without control)" if is_no_gain else words


def unproved_statements(record: Record, loop: RecordedLoopFacts | None) -> list[str]:
    """Short statements on what the stability proof of a run does not say."""
    coverage = record.get("coverage")
    excluded = ["the plant: how far it differs from the model is not in the proof"]
    is_judged = record.get("evidence") != CANNOT_JUDGE
    is_covered = coverage is not None and coverage >= 1 and is_judged
    if coverage is not None and is_covered:
        times = coverage_text(coverage)
        excluded = [
            f"a plant whose error in the loop exceeds {times} times what the records show",
            "a steady offset (frequency zero), such as friction leaves",
        ]
    start_range = full_rate_initial_outputs(record)
    if start_range is not None:
        excluded.append(f"with the input limited, {outputs_outside_proof_text(start_range, loop)}")
    elif record.get("limit_lower") is None:
        excluded.append(unproved_limits_text(record))
    excluded += exceeded_bound_statements(record)
    excluded.append("how far noise and disturbances move the output")
    if is_covered:
        excluded.append("other set points of the plant: what is proved is that it comes to rest")
    return excluded


def unproved_limits_text(record: Record) -> str:
    """Text on input limits under which nothing is proved for a run."""
    words = "an input that is limited"
    if is_input_limited_to_records(record):
        words += ", as it is here to the range of the records"
    return f"{words}: the theorems on limits know no neurons" if record.get("neurons") else words


def is_input_limited_to_records(record: Record) -> bool:
    """Whether the simulated input of a closed loop was limited to the recorded range, as for a log
    of measurements."""
    return record.get("loop_on") == "identified model"


def exceeded_bound_statements(record: Record) -> list[str]:
    """Statement on how far the estimation error on the plant exceeded the bound that is certified
    for the model."""
    excess = record.get("certified_bound_excess_plant")
    if not excess or is_input_limited_to_records(record):
        return []
    share = f"{100 * excess:.2g} % of its value at the start"
    has_noise = record.get("noise_gain_measured") is not None
    estimate = "the estimate on the plant, with sensor noise," if has_noise else "that on the plant"
    bound = "the certified bound on the estimate is that of the model without noise"
    return [f"{bound}: {estimate} exceeded it by up to {share}"]


def outputs_outside_proof_text(
    start_range: tuple[float, float], loop: RecordedLoopFacts | None
) -> str:
    """Text on initial outputs outside the range for which a rate is proved under input limits."""
    first, last = start_range
    words = f"starts outside {first:.3g} to {last:.3g}"
    if loop is None:
        return words
    total = len(loop.initial_outputs)
    outside = total - loop.count_initial_states_inside(*start_range)
    return f"{words} {loop.output_unit}: {outside} of the {total} shown"


def exceeded_limits_text(record: Record, loop: RecordedLoopFacts | None) -> str:
    """Text line on whether the recorded input of a closed loop stayed within the limits of the
    proof."""
    if record.get("limit_lower") is None or loop is None or not record.get("controller_certified"):
        return ""
    low, high = loop.input_range
    reach = f"{low:.3g} to {high:.3g}{f' {loop.input_unit}'.rstrip()}"
    if not input_leaves_proved_range(record, loop):
        return f"The input, {reach}, stayed within the limits of the proof"
    return (
        f"The input, {reach}, went beyond the limits of the proof: the times shown are without "
        "limits; loop.input_lower and loop.input_upper apply them"
    )


def input_leaves_proved_range(record: Record, loop: RecordedLoopFacts | None) -> bool:
    """Whether the recorded input of a closed loop left the range for which the proof was made."""
    if loop is None or record.get("limit_lower") is None:
        return False
    low, high = loop.input_range
    return bool(low < record["limit_lower"] or record["limit_upper"] < high)
