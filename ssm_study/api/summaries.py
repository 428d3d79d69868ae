"""Summaries of models and designs, with one value per line, as text and as a table for
notebooks."""

import math
import re
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ssm_study.api.loop_of_both import describe_loop_verdict, maps_text, unstable_example_text
from ssm_study.api.scope_of_proof import (
    describe_deciding_band,
    describe_simulated_loop,
    requested_rate,
    unproved_properties_text,
)
from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.certificates.certificate import Infeasible
from ssm_study.certificates.decay_time import decay_time_text
from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT, evidence_text
from ssm_study.evidence.metrics import NO_JUDGEMENT
from ssm_study.models.identified import SSM
from ssm_study.models.structured import StructuredSSM
from ssm_study.robustness.coverage_columns import WITHHELD
from ssm_study.signals import DataSet
from ssm_study.synthesis.loop_poles import moves_poles
from ssm_study.synthesis.withheld_coverage import IDLE

if TYPE_CHECKING:
    from ssm_study.api.design import Design
    from ssm_study.api.model import Model

PROVED = {True: "certified in exact arithmetic", False: "not certified"}
# Settings of a study, in the sentences of a certificate, and what a Python user gives instead.
PYTHON_ARGUMENTS = {
    "raise the slope floor (model.slope_lower)": "raise the lowest slope (slopes= of st.fit)",
    "drop states (reduction.truncate_to)": "take fewer states (order= of st.fit)",
    "try synthesis=riccati": "try method='riccati'",
    " or use a scaffolding with slopes bounded by construction": "",
}
STABILITY = {True: "stays stable", False: "may not stay stable", None: "no prediction"}


def summarise_model(model: "Model") -> pd.Series:
    """Table of an identified model's properties: class, size, fits, poles, slopes and evidence."""
    facts = model.result_columns
    data = model.data
    model_class = type(model.simulator).__name__
    lines: dict[str, Any] = {"class": model_class}
    input_names = [channel.name_with_unit for channel in data.inputs]
    lines["inputs"] = ", ".join(input_names)
    output_names = [channel.name_with_unit for channel in data.outputs]
    lines["outputs"] = ", ".join(output_names)
    if data.disturbances:
        disturbance_names = [channel.name_with_unit for channel in data.disturbances]
        lines["measured disturbances"] = ", ".join(disturbance_names)
    lines["sampling time"] = f"{data.step_s:g} s"
    lines["samples"] = sample_counts_text(data)
    for part in ("train", "validation", "test"):
        name = "training" if part == "train" else part
        lines[f"fit on the {name} records"] = f"{facts[f'fit_{part}_percent']:.1f} %"
    if "members" in facts:
        fit = facts["fit_test_members_percent"]
        fit_words = f"fit on the test records {fit:.1f} %"
        if facts["members"] == 1:
            lines["model that predicts"] = f"products of input and state, {fit_words}"
        else:
            lines["mean that predicts"] = f"{facts['members']} models, {fit_words}"
    if model.identification.chosen:
        chosen_settings = model.identification.chosen
        lines["chosen by the records"] = choice_summary(chosen_settings)
    if isinstance(model.simulator, SSM | StructuredSSM):
        lines |= summarise_state_space(model, model.simulator)
    return pd.Series(lines, name="model", dtype=object)


def summarise_state_space(model: "Model", simulator: SSM | StructuredSSM) -> dict[str, Any]:
    """Summary lines that only a state-space model has: its size, its slowest pole, its slopes and
    how well data support the model."""
    facts = model.result_columns
    moduli = np.abs(model.eigenvalues())
    slowest = moduli.max()
    sizes = chosen_sizes(model.identification.chosen)
    order_reason = sizes.get("order")
    lines: dict[str, Any] = {"states": size_text(simulator.order, order_reason)}
    neurons = facts.get("neurons", 0)
    neurons_reason = sizes.get("neurons")
    lines["neurons"] = size_text(neurons, neurons_reason)
    lines["slowest pole"] = f"{slowest:.4f} per sample"
    lower = facts.get("input_slope_lower")
    upper = facts.get("input_slope_upper")
    if lower is not None and upper is not None:
        lines["slopes of the input map"] = f"{lower:.3g} to {upper:.3g}"
    evidence = model.evidence
    lines["evidence"] = evidence_text(evidence.level, evidence.reasons, "print(model.evidence)")
    return lines


def choice_summary(chosen: str) -> str:
    """Text on the settings of a model that were chosen from the records."""
    for value, answer in (("none", "no"), ("free", "yes")):
        chosen = chosen.replace(f"input path {value}", f"input drives the neurons {answer}")
    return chosen


def chosen_sizes(chosen: str) -> dict[str, int]:
    """Numbers of states and neurons as chosen from the records, before training removed unused
    states or neurons."""
    sizes = re.findall(r"\b(order|neurons) (\d+)", chosen)
    return {name: int(size) for name, size in sizes}


def size_text(count: int, chosen: int | None) -> int | str:
    """Number of states or neurons of a model, with a note where training removed some."""
    if chosen is None or count >= chosen:
        return count
    return f"{count} (of the {chosen} chosen, the others were not needed)"


def summarise_design(design: "Design") -> pd.Series:
    """Table of what is proved and what is predicted for a controller design, with units."""
    lines: dict[str, Any] = {}
    certificate = design.certificate
    for name, side in (("controller", "state_feedback"), ("observer", "observer")):
        part = certificate.certificates_by_name[side]
        if isinstance(part, Infeasible):
            lines[name] = f"no certificate: {replace_settings_by_arguments(part.reason)}"
            continue
        rate = certificate.certified_rate(side)
        requested = requested_rate(design, side)
        step_s = design.model.step_s
        lines |= summarise_gain_certificate(name, part, rate, step_s, requested)
        if name == "observer" and part.certified and design.unknown_maps:
            lines[name] += f", if it computes the plant's own {maps_text(design.unknown_maps)}"
    example = unstable_example_text(certificate) if design.unknown_maps else None
    lines["loop of both"] = describe_loop_verdict(design.verdicts, design.unknown_maps, example)
    lines["not proved"] = unproved_properties_text(design)
    if not certificate.feasible:
        return pd.Series(lines, name="design", dtype=object)
    if design.unknown_maps:
        lines["drawn and simulated"] = "with the gain in the middle of these slopes"
    poles = design.eigenvalues()
    slowest = {name: np.abs(values).max() for name, values in poles.items()}
    open_loop_rate = 0.0
    if isinstance(design.model, SSM):
        open_loop_rate = 1 - slowest["model"] ** 2
        proved_rate = certificate.certified_rate("state_feedback")
        lines["without control"] = describe_open_loop(open_loop_rate, proved_rate)
    acts = moves_poles(poles["model"], poles["controlled"])
    if not acts:
        lines["effect of the controller"] = "hardly any: the poles are those without control"
    lines |= summarise_slowest_poles(slowest)
    if design.origin is not None or design.stored_record:
        lines["simulated"] = describe_simulated_loop(design)
    if "evidence" in design.result_columns:
        lines |= summarise_input_limits(design.result_columns, open_loop_rate)
        where = describe_deciding_band(design)
        lines |= summarise_prediction(design.result_columns, acts, where)
    elif design.origin is None and not design.stored_record:
        lines |= summarise_assumptions(certificate)
    return pd.Series(lines, name="design", dtype=object)


def summarise_slowest_poles(slowest: dict[str, float]) -> dict[str, str]:
    """Summary lines with the moduli of the slowest poles of model, controlled model and
    observer."""
    sides = {"open loop": "model", "controlled": "controlled", "observer": "estimate"}
    return {
        f"slowest pole, {name}": f"{slowest[key]:.4f} per sample" for name, key in sides.items()
    }


def replace_settings_by_arguments(sentence: str) -> str:
    """Replace names of study settings by names of Python arguments in a sentence of a
    certificate."""
    for setting, argument in PYTHON_ARGUMENTS.items():
        sentence = sentence.replace(setting, argument)
    return sentence


def describe_open_loop(open_loop_rate: float, proved_rate: float | None) -> str:
    """Text on the contraction rate of a model without control, with a remark where the controller's
    proved rate is no larger."""
    if open_loop_rate <= 0:
        return "the model does not contract"
    words = f"the model contracts at rates below {rate_text(open_loop_rate)}"
    shows_no_gain = proved_rate is not None and proved_rate <= open_loop_rate
    return f"{words}: the controller's rate shows no gain" if shows_no_gain else words


def summarise_input_limits(facts: dict[str, Any], open_loop_rate: float) -> dict[str, str]:
    """Summary lines on what is proved where the input is limited to the recorded range."""
    rate = facts.get("limited_rate")
    lower = facts.get("limit_lower")
    upper = facts.get("limit_upper")
    if rate is None or lower is None or upper is None:
        return {}
    words = f"rate {rate_text(rate)} per sample with inputs from {lower:.3g} to {upper:.3g}"
    if rate <= open_loop_rate:
        words += " (no more than without control)"
    return {"controller, input limited": words}


def summarise_assumptions(certificate: Certificates) -> dict[str, str]:
    """Summary lines on the assumptions about the static maps of a system given as matrices."""
    feedback, observer = certificate.controller_and_observer()
    assumed = {}
    for name, part in (("input map", feedback), ("output map", observer)):
        lower = part.alpha - part.beta
        upper = part.alpha + part.beta
        slopes = f"{lower:.6g} to {upper:.6g}" if lower < upper else f"{lower:.6g}"
        assumed[f"slopes of the {name}"] = slopes
    return assumed


def rate_text(rate: float, digits: int = 3) -> str:
    """Text of a contraction rate, rounded down so that no more is stated than is proved."""
    if rate <= 0:
        return f"{rate:.{digits}g}"
    exponent = math.floor(math.log10(rate))
    step = 10.0 ** (exponent - digits + 1)
    text = f"{rate:.{digits}g}"
    return text if float(text) <= rate else f"{float(text) - step:.{digits}g}"


def summarise_gain_certificate(
    name: str, certificate: Any, rate: float | None, step_s: float, requested: float | None = None
) -> dict[str, str]:
    """Summary lines on the certificate of a controller or observer, with the reason where exact
    arithmetic does not confirm it. `requested` is the rate that was asked for."""
    value = "no rate"
    if rate is not None:
        value = f"rate {rate_text(rate)}"
        if requested is not None and rate_text(rate) != rate_text(requested):
            value += f" (asked {requested:g})"
        value += f" per sample ({decay_time_text(rate, step_s)})"
    limit = f"any gain: below {rate_text(certificate.rate_limit)}"
    lines = {name: f"{value}, {PROVED[certificate.certified]} ({limit})"}
    if not certificate.certified:
        lines[f"{name}, reason"] = replace_settings_by_arguments(certificate.solver_status)
    lines[f"{name} gain"] = f"norm {certificate.gain_norm:.3g}"
    return lines


def summarise_prediction(
    facts: dict[str, Any], controller_acts: bool = True, deciding_band: str = ""
) -> dict[str, str]:
    """Summary lines that predict how the plant behaves in closed loop. If the controller hardly
    acts, its margin and coverage are not presented as a success. `deciding_band` says at which
    frequency the coverage is decided."""
    margin = facts.get("resolved_margin")
    judged = facts["evidence"] != CANNOT_JUDGE
    suffix = ""
    if margin is not None and judged and controller_acts:
        suffix = f" (stability margin {margin:.3g})"
    coverage = facts.get("coverage")
    reason = str(facts.get("coverage_reason"))
    covered = reason if reason.startswith(WITHHELD) else "not covered"
    if coverage is not None and coverage >= 1:
        covered = f"a model error {coverage:.3g} times as large as the records show{deciding_band}"
        if not controller_acts:
            covered = IDLE
    if not judged and (coverage is not None or reason == NO_JUDGEMENT):
        covered = f"{WITHHELD}: the records do not show the model error"
    prediction = STABILITY[facts.get("predicted_stable")]
    if facts.get("predicted_faster") is False:
        prediction += ", no faster than without control"
    elif facts.get("predicted_faster") and facts.get("predicted_stable"):
        prediction += ", settles sooner than without control"
    if facts["evidence"] == DOUBT:
        prediction += ", with doubts"
    where = 'record["evidence_reasons"]'
    evidence_reasons = facts.get("evidence_reasons")
    evidence = evidence_text(str(facts["evidence"]), evidence_reasons, where)
    return {
        "covered by the proof": covered,
        "predicted for the plant": prediction + suffix,
        "evidence": evidence,
    }


def sample_counts_text(data: DataSet) -> str:
    """Text with the numbers of samples in the training, validation and test records."""
    counts = []
    for part in ("training", "validation", "test"):
        records = getattr(data, part)
        samples = sum(len(record) for record in records)
        counts.append(f"{samples} {part}")
    return ", ".join(counts)


def render_text_table(title: str, summary: pd.Series) -> str:
    """Render a summary of names and values as lines of text in two columns."""
    name_lengths = map(len, summary.index)
    width = max(name_lengths)
    rows = [f"  {name:<{width}}  {value}" for name, value in summary.items()]
    return "\n".join([title, *rows])


def html_table(title: str, summary: pd.Series) -> str:
    """Render a summary of names and values as an HTML table for notebooks."""
    rows = [
        f"<tr><th style='text-align:left'>{escape(str(name))}</th>"
        f"<td style='text-align:left'>{escape(str(value))}</td></tr>"
        for name, value in summary.items()
    ]
    return f"<table><caption>{escape(title)}</caption>{''.join(rows)}</table>"
