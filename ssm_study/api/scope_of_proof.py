"""Lines of a design's summary that say what its proof covers and what it leaves unproved."""

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from ssm_study.certificates.decay_time import plain_digits
from ssm_study.refusal import BadRequest, require
from ssm_study.stored_yaml import read_stored_yaml

if TYPE_CHECKING:
    from pathlib import Path

    from ssm_study.api.design import Design
    from ssm_study.api.model import Model

ANGLE = re.compile(r"(\d+\.\d+)(?: to (\d+\.\d+))? rad/sample")
AMPLITUDE = re.compile(r"^input of rms \S+")
ONE_AMPLITUDE = "All records have one amplitude"
UNEXCITED = re.compile(r"no power in (\d+ of \d+ bands, from (\S+) Hz)")
SETTINGS = {"state_feedback": "rate_controller", "observer": "rate_observer"}


def requested_rate(design: "Design", side: str) -> float | None:
    """Contraction rate that was requested for the controller or the observer of a design; None
    where it was chosen from the records."""
    settings = _read_synthesis_settings(design)
    if settings is None:
        part: Any = design.certificate.certificates_by_name[side]
        return float(part.rate)
    for name in (SETTINGS[side], "rate"):
        try:
            return float(settings[name])
        except (KeyError, TypeError, ValueError):  # left at auto
            continue
    return None


def _read_synthesis_settings(design: "Design") -> dict[str, Any] | None:
    """Settings with which the gains of a design were computed; None where all rates were given as
    numbers."""
    if design.run_folder is not None:
        configuration = design.run_folder / ".hydra" / "config.yaml"
        is_study_run = configuration.is_file()
        return _read_stored_settings(configuration) if is_study_run else None
    pairs = [word.lstrip("+").partition("=") for word in design.overrides]
    methods = [value for key, _, value in pairs if key == "synthesis"]
    if not methods or not methods[-1].startswith("auto"):
        return None
    prefix = "synthesis."
    return {key.removeprefix(prefix): value for key, _, value in pairs if key.startswith(prefix)}


def _read_stored_settings(configuration: "Path") -> dict[str, Any]:
    """Settings of the gain computation in a stored configuration file; empty if the file cannot be
    read."""
    try:
        settings = yaml.safe_load(read_stored_yaml(configuration))
        return dict(settings["synthesis"])
    except (BadRequest, KeyError, TypeError, ValueError):
        return {}


def describe_deciding_band(design: "Design") -> str:
    """Text on the frequency band that decides how much model error the proof covers. It also tells
    of missing input power there; empty where no band decides."""
    facts = design.result_columns
    stored_reference = facts.get("coverage_reference") or ""
    reference = str(stored_reference)
    words = smallest_coverage_band_text(reference, design.model.step_s)
    if not words:
        return ""
    amplitude = AMPLITUDE.match(reference)
    if amplitude is not None and ONE_AMPLITUDE not in str(facts.get("evidence_reasons")):
        words += f" with an {amplitude[0].rstrip(',')} input scales"
    return f", decided {words}{weak_input_power_text(design, reference)}"


def smallest_coverage_band_text(reference: str, step_s: float) -> str:
    """Text in Hz of the frequency range where a proof tolerates the least model error relative to
    the measured one; empty if none is given."""
    angles = ANGLE.search(reference)
    if angles is None:
        return ""
    hertz = [float(angle) / (2 * np.pi * step_s) for angle in angles.groups() if angle]
    if hertz[-1] == 0:
        return "at the lowest frequencies"
    place = " to ".join(f"{frequency:.3g}" for frequency in hertz)
    return f"{'from' if len(hertz) > 1 else 'at'} {place} Hz"


def weak_input_power_text(design: "Design", reference: str) -> str:
    """Text that warns if the input has almost no power in the frequency band where the tolerated
    model error is smallest relative to the measured one. For a loaded design the text quotes its
    evidence, if the band lies above the first band without excitation."""
    from ssm_study.api.steps import measure_error_to_cover
    from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs

    extra_certificates = design.certificate.extra_certificates
    part = extra_certificates.get(MeasuredDiscs.part)
    if design.origin is None or not isinstance(part, MeasuredDiscs):
        evidence_reasons = str(design.result_columns.get("evidence_reasons"))
        note = UNEXCITED.search(evidence_reasons)
        angle = ANGLE.search(reference)
        if note is None or angle is None:
            return ""
        lowest_angle = float(angle[1])
        turns_to_hz = 2 * np.pi * design.model.step_s
        hertz = lowest_angle / turns_to_hz
        from_hz = float(note[2])
        return f" (the input has no power in {note[1]})" if hertz >= from_hz else ""
    data = design.origin.data
    mismatch = design.origin.mismatch
    spectra = measure_error_to_cover(design.model, data, mismatch)
    items = spectra.requirements(part.centre)
    is_dark = any(item.dark for item in items if item.label == reference)
    return (
        ", where the deciding record has next to no input power and noise counts as error"
        if is_dark
        else ""
    )


def describe_simulated_loop(design: "Design") -> str:
    """Text on how many simulated initial states settle, how fast, and how fast without control."""
    try:
        record = design.record
    except BadRequest as error:
        return f"no loop: {error.problem}"
    starts = record.get("initial_conditions")
    if starts is None:
        return "no loop"
    place = record.get("loop_on") or "plant"
    words = f"on the {place} {record.get('stable_count')} of {starts} starts settle"
    mean_s = record.get("settling_time_mean_s")
    if mean_s is None:
        return words
    words += f", in {plain_digits(mean_s)} s on average"
    open_loop_s = record.get("settling_time_open_loop_s")
    return (
        words if open_loop_s is None else f"{words} ({plain_digits(open_loop_s)} s without control)"
    )


def unproved_properties_text(design: "Design") -> str:
    """Text on what the certificates of a controller design do not prove."""
    if design.origin is None and not design.stored_record:
        return "a rate of the loop of both; a loop whose input is limited; any other plant"
    words = "a rate of the loop of both; a loop in which a limit cuts the input"
    coverage = design.result_columns.get("coverage") or 0.0
    if coverage < 1:
        words += "; that the plant itself comes to rest"
    return f"{words}; amplitudes, frequencies and starts that no record visits"


def refuse_picture_without_records(origin: "Model | None", folder: "Path | None") -> None:
    """Raise `BadRequest` for a picture that needs records if a design has no records. A loaded
    design has none, nor has one of given matrices."""
    problem = "comes without its model's records, with which the picture compares the proof"
    remedy = "st.load the saved model, or st.fit it again, and give it to st.control"
    has_model = origin is not None
    require(has_model or folder is None, "loaded design", folder, problem, remedy)
    problem = "has no records, with which the picture compares the proof"
    remedy = "identify a model with st.fit and give it to st.control"
    require(origin is not None, "design", "matrices", problem, remedy)
