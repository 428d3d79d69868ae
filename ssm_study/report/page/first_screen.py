"""First screen of the report page, with the best run in four cards, and remarks below them."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ssm_study.certificates.decay_time import plain_digits
from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT, evidence_text
from ssm_study.report.outcome import (
    fresh_error_ratio_text,
    loop_place_text,
    pi_comparison_text,
    refit_text,
    unused_data_exceed_coverage,
)
from ssm_study.report.page.card import Card, Record
from ssm_study.report.page.proof_card import (
    RecordedLoopFacts,
    certified_rates_card,
    exceeded_limits_text,
    input_leaves_proved_range,
)
from ssm_study.report.words import (
    SETTLED,
    VERDICTS,
    Verdict,
    format_beside_bound,
    printed_column_name,
)
from ssm_study.table.columns import swept_settings

SUPPORT = {
    "sound": "No check of the records speaks against the prediction.",
    DOUBT: "The records leave a doubt.",
    CANNOT_JUDGE: "The records allow no judgement.",
}
NO_PLANT = "No plant was tried: the loop was closed on the model alone."
FINDING = re.compile(r" (?=(?:note|doubt|cannot judge): )")
REASONS = ("infeasible_reason", "uncertified_reason", "error_message")


@dataclass(frozen=True, kw_only=True)
class Remark:
    """Remark below the result cards of the report page, possibly folded away or marked as a
    warning. `notes` are folded away, a warning stands out."""

    title: str
    text: str
    notes: tuple[str, ...] = ()
    is_warning: bool = False


def row_as_record(row: "pd.Series[Any]") -> dict[str, Any]:
    """Row of the results table as a plain dictionary with None for missing values."""
    return {str(name): None if pd.isna(value) else value for name, value in row.items()}


def best_run_rule(table: pd.DataFrame) -> str:
    """Text that states the rule by which the best run of a study is chosen."""
    record = row_as_record(table.iloc[0])
    if len(table) == 1:
        return "Run: "
    if record["verdict"] != SETTLED.word:
        return "No run is certified and settles; the nearest: "
    stable = ", predicted to be stable" if record.get("predicted_stable") else ""
    return f"Best run (the fastest of those that are certified{stable} and settle): "


def varied_settings_sentence(table: pd.DataFrame) -> str:
    """Sentence on the settings of the best run that differ between the runs of a study; empty if
    none do."""
    record = row_as_record(table.iloc[0])
    parts = [
        f"{plain_setting_name(name)} {requested_setting_text(record, name)}"
        for name in swept_settings(table)
    ]
    return f". Its settings: {', '.join(parts)}." if parts else ""


def plain_setting_name(name: str) -> str:
    """Printed name of a setting in lower case, without mathematical symbol and unit."""
    return re.sub(r"[ ,]*[(,ρ].*", "", printed_column_name(name)).lower()


def requested_setting_text(record: Record, name: str) -> str:
    """Text of a setting's value as a run requested it. A contraction rate that the program chose
    itself reads as the word `auto`."""
    chosen = str(record.get("rates_chosen") or "")
    if name.startswith("rate_") and name.removeprefix("rate_") in chosen:
        return "auto"
    value = record.get(name)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def outcome_cards(
    record: Record, loop: RecordedLoopFacts | None = None, *, noise_free_test: bool = False
) -> list[Card]:
    """Cards of the report page on a run's model, proof, prediction and closed loop."""
    built = [
        model_card(record, noise_free_test=noise_free_test),
        certified_rates_card(record, loop),
        prediction_card(record),
        closed_loop_card(record, loop),
    ]
    return [card for card in built if card is not None]


def model_card(record: Record, *, noise_free_test: bool = False) -> Card | None:
    """Card of the report page that says how well the model predicts."""
    fit = record.get("fit_test_percent")
    if fit is None:
        return None
    return Card(
        title="Model",
        number=f"{fit:.1f} %",
        text="fit on the test record, which training has not seen (100 %: a perfect free run)",
        lines=("the simulated test record has no sensor noise",) if noise_free_test else (),
    )


def prediction_card(record: Record) -> Card | None:
    """Card of the report page with the predicted behaviour of the plant in closed loop."""
    title = f"Predicted for the {'model' if is_loop_closed_on_model(record) else 'plant'}"
    evidence = record.get("evidence")
    if evidence == CANNOT_JUDGE:
        return Card(title=title, number="nothing", text=SUPPORT[CANNOT_JUDGE].lower().rstrip("."))
    stable = record.get("predicted_stable")
    margin = record.get("resolved_margin")
    if stable is None or margin is None:
        return None
    word = "it stays stable" if stable else "the loop may be unstable"
    if stable and evidence == DOUBT:
        word += ", with doubts"
    text = f"stability margin (above 1 is needed): {word}"
    radius = record.get("controller_radius")
    if radius is not None:
        spectral = format_beside_bound(radius)
        alone = "is stable by itself" if radius < 1 else "is unstable by itself"
        text += f"; the controller {alone}: spectral radius {spectral} (below 1 is needed)"
    text += refit_text(record)
    return Card(title=title, number=format_beside_bound(margin), text=text)


def closed_loop_card(record: Record, loop: RecordedLoopFacts | None = None) -> Card | None:
    """Card of the report page on how many initial states settled, how fast, and how a PI controller
    compares."""
    count = record.get("stable_count")
    if count is None:
        return None
    text = "starts settle"
    if input_leaves_proved_range(record, loop):
        text += " without input limits"
    mean_s = record.get("settling_time_mean_s")
    if mean_s is not None:
        text += f", in {plain_digits(mean_s)} s on average"
    alone_s = record.get("settling_time_open_loop_s")
    if alone_s is not None:
        text += f"; uncontrolled in {plain_digits(alone_s)} s"
    if record.get("stable_count_pi") is not None:
        text += f"; a PI tuned from the same model: {pi_comparison_text(record)}"
    number = f"{count:.0f} of {record.get('initial_conditions'):.0f}"
    lines = tuple(filter(None, [exceeded_limits_text(record, loop)]))
    title = f"Seen on the {short_loop_place_text(record)}"
    return Card(title=title, number=number, text=text, lines=lines)


def short_loop_place_text(record: Record) -> str:
    """Short text that says whether a loop was closed on the plant or on the identified model."""
    return loop_place_text(record).replace("identified model", "model")


def is_loop_closed_on_model(record: Record) -> bool:
    """Whether a run's loop was closed on the identified model, as for a log of measurements."""
    return short_loop_place_text(record) == "model"


def record_verdict(record: Record) -> Verdict:
    """Verdict on a run, such as certified or failed, taken from its record."""
    return next(verdict for verdict in VERDICTS if verdict.word == record["verdict"])


def failure_reasons(record: Record) -> list[str]:
    """Reasons in a run's record why the run is infeasible, not certified or failed.

    The verdict stands before them, so an infeasible rate is not called infeasible once more.
    """
    texts = [str(record[name]) for name in REASONS if record.get(name)]
    return [text.replace(" is infeasible: ", ": ", 1) for text in texts]


def outcome_remarks(record: Record) -> Iterator[Remark]:
    """Remarks on why a run is unsuccessful, and on the evidence for its prediction."""
    verdict = record_verdict(record)
    if verdict != SETTLED:
        sentences = [f"{verdict.word}: {verdict.sentence}", *failure_reasons(record)]
        yield Remark(title="Outcome", text=join_sentences(sentences), is_warning=True)
    if unused_data_exceed_coverage(record):
        sentence = "Data that neither fit nor design has used show a larger model error than the "
        sentence += f"proof covers{fresh_error_ratio_text(record).replace(';', ':', 1)}."
        yield Remark(title="Fresh data", text=sentence, is_warning=True)
    evidence = record.get("evidence")
    if evidence:
        findings = FINDING.split(str(record.get("evidence_reasons") or ""))
        notes = [text for text in findings if text.startswith("note: ")]
        serious = [text for text in findings if text and text not in notes]
        plain = [re.sub(r"^[a-z ]+: ", "", text) for text in serious]
        support = SUPPORT.get(str(evidence))  # None of a word that another version wrote
        untried = NO_PLANT if is_loop_closed_on_model(record) else None
        support_and_doubts = " ".join(filter(None, [support, untried, *plain]))
        is_warning = evidence in (DOUBT, CANNOT_JUDGE)
        yield Remark(
            title=f"Evidence: {evidence_text(str(evidence), ' '.join(notes), 'below')}",
            text=support_and_doubts,
            notes=tuple(map(capitalise_first_letter, notes)),
            is_warning=is_warning,
        )


def join_sentences(parts: Sequence[str]) -> str:
    """Join parts of a text to sentences, each with a capital letter first and a full stop last."""
    return " ".join(f"{capitalise_first_letter(part).rstrip('.')}." for part in parts)


def capitalise_first_letter(text: str) -> str:
    """Copy of a text with a capital first letter and the other letters unchanged."""
    return text[:1].upper() + text[1:]
