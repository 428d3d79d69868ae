"""Printed outcome of a run in the blocks MODEL, PROVED, PREDICTED and SEEN, with the paths of its
figures."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ssm_study.certificates.decay_time import decay_time_text, duration_text
from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT, evidence_text
from ssm_study.report.earlier_version import earlier_version_rows
from ssm_study.report.run_facts import RunFacts
from ssm_study.report.speed_up import unproved_speed_up_text
from ssm_study.report.words import NO_FASTER, SETTLED, prediction_text, verdict_per_run
from ssm_study.robustness.coverage_columns import WITHHELD

WIDTH = 80
MISSING = "–"
TRAINED_ON_VALIDATION = "trained on the training and validation records"
AHEAD = 0.1  # percent points of fit, which are printed, from which on a baseline is better
WIDE_SPREAD = 5.0  # points between the test fits of baselines that validate as well
# A simulated plant's loop knows given limits alone; the exported code, for want of others, the
# range of the records.
LIMITS_OF = {False: "Within input limits", True: "Exported, within limits"}
SCORE_UNITS = {"emps": " mm", "cascaded_tanks": " V", "ced": " ticks/s"}  # as published
DOUBTFUL_NOISE_GAIN = 2.0  # noise that reaches the output, over what the model says of it
UNFINISHED = {
    "running": "running: a process is at this run",
    "lost": "lost: the run was stopped before its end; the same command takes it up again",
}
NOTES = "ssm-study show RUN"
PAPER_THEOREMS = {"controller": "Theorem 1", "observer": "Theorem 2"}
Row = tuple[str, str, str]  # the column that must be known, label, value


def print_outcome(
    record: Mapping[str, Any],
    figures: Sequence[Path],
    console: Console,
    facts: RunFacts | None = None,
) -> None:
    """Print the table of a run's results and the paths of its figures."""
    console.print(outcome_table(record, facts or RunFacts()), width=min(WIDTH, console.width))
    for reason in outcome_reasons(record):
        console.print(Text(reason), soft_wrap=False, width=WIDTH)
    for line in figure_lines(figures):
        # a path is never broken
        console.print(Text(f"  {line}"), soft_wrap=True, highlight=False)


def figure_lines(figures: Sequence[Path]) -> list[str]:
    """Text lines that name the saved figures, such as `figures/hankel_spectrum.png, .pdf`."""
    kinds: dict[str, list[str]] = {}
    for path in figures:
        stem = str(path.with_suffix("")).removeprefix(f"{Path.cwd()}/")
        kinds.setdefault(stem, []).append(path.suffix)
    return [f"{stem}{', '.join(suffixes)}" for stem, suffixes in kinds.items()]


def outcome_table(record: Mapping[str, Any], facts: RunFacts) -> Table:
    """Table of a run's results for the terminal, in the order model, proof, prediction, plant."""
    table = Table(show_header=False, box=None, pad_edge=False, width=WIDTH)
    table.add_column(width=27, no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("Run", Text(f"{record.get('study', MISSING)}/{record.get('run', MISSING)}"))
    table.add_row("Outcome", outcome_text(record))
    blocks = (
        ("MODEL", "", model_rows(record)),
        ("PROVED", "of the model", proved_rows(record, facts)),
        ("PREDICTED", "", prediction_rows(record)),
        ("SEEN", f"on the {loop_place_text(record)}", closed_loop_rows(record)),
    )
    for title, subject, rows in blocks:
        known_rows = [(label, value) for name, label, value in rows if record.get(name) is not None]
        if known_rows:
            table.add_row(Text(title, style="bold"), subject)
        for label, value in known_rows:
            table.add_row(f"  {label}", Text(value))
    return table


def outcome_text(record: Mapping[str, Any]) -> Text:
    """Text of a run's verdict with the sentence that explains the verdict. `cannot judge` comes
    first where the evidence allows no judgement."""
    unfinished = UNFINISHED.get(str(record.get("status")))
    if unfinished is not None:
        return Text(unfinished)
    verdict = verdict_per_run(pd.DataFrame([dict(record)])).iloc[0]
    settles = verdict in (SETTLED, NO_FASTER)
    where = ", on the identified model" if settles and not _is_loop_on_plant(record) else ""
    sentence = f"{verdict.word}: {verdict.sentence}{where}"
    if record.get("evidence") != CANNOT_JUDGE:
        return Text(sentence, style=verdict.style)
    return Text(f"cannot judge: the evidence allows no judgement. {sentence}", style="bold yellow")


def _is_loop_on_plant(record: Mapping[str, Any]) -> bool:
    """Whether a run's loop was closed on a plant rather than on the identified model. A log has no
    plant, even if no loop was closed."""
    is_log = record.get("loop_on") is None and "plant" in record and record["plant"] is None
    return record.get("loop_on") != "identified model" and not is_log


def loop_place_text(record: Mapping[str, Any]) -> str:
    """Text that says where a run's loop was closed: `simulated plant` or `identified model`."""
    if not _is_loop_on_plant(record):
        return "identified model"
    place = record.get("loop_on")
    return "simulated plant" if place in (None, "plant") else str(place)


def format_column(
    record: Mapping[str, Any], name: str, number_format: str = ".3g", unit: str = ""
) -> str:
    """Text of a value in a run's record with its unit, or a dash if the value is missing."""
    value = record.get(name)
    if value is None:
        return MISSING
    return f"{value:{number_format}}{unit}" if isinstance(value, int | float) else str(value)


def prediction_fit_row(record: Mapping[str, Any], fit: str) -> tuple[str, str]:
    """Row of a run's printed results on the fit of a mean of models or of a bilinear model."""
    if record["members"] == 1:
        return "Model that predicts", f"{fit}, with products of input and state"
    return "Mean that predicts", f"{fit}, of {record['members']} models"


def model_rows(record: Mapping[str, Any]) -> Iterator[Row]:
    """Rows of a run's printed results on the identified model, such as its fit."""
    reading = log_reading_text(record)
    if reading:
        yield "evidence_reasons", "Log", reading
    fit = format_column(record, "fit_test_percent", ".1f", " %")
    started = ", run from the log before it" if record.get("piece_start") == "past" else ""
    yield "fit_test_percent", "Fit on the test record", fit + started
    if record.get("members"):
        mean = format_column(record, "fit_test_members_percent", ".1f", " %")
        yield "fit_test_members_percent", *prediction_fit_row(record, mean)
    yield "fit_baseline_percent", "Best baseline", baseline_text(record)
    yield "model_choice", "Chosen by the log", format_column(record, "model_choice")
    yield from score_rows(record, "score_test_", "Score, record")
    yield from score_rows(record, "score_members_", "Mean's score, record")
    names = f"{record.get('disturbances')}, at equilibrium in the loop, not compensated"
    yield "disturbances", "Measured disturbances", names
    lower = format_column(record, "input_slope_lower")
    upper = format_column(record, "input_slope_upper")
    slopes = f"[{lower}, {upper}] ({format_column(record, 'bound_method')})"
    yield "input_slope_lower", "Slopes of S_u", slopes
    if not record.get("neurons"):  # with neurons the linear part does not say it
        rate = max(1 - (record.get("spectral_radius") or 1.0) ** 2, 0.0)
        yield "spectral_radius", "Open loop", f"contracts at rate {rate:.3g} per sample"


def score_rows(record: Mapping[str, Any], prefix: str, heading: str) -> Iterator[Row]:
    """Rows of a run's printed results on its scores on the test records of a benchmark."""
    unit = SCORE_UNITS.get(str(record.get("benchmark")), "")
    for name in sorted(key for key in record if key.startswith(prefix)):
        number = name.removeprefix(prefix)
        yield name, f"{heading} {number}", format_column(record, name, ".4g", unit)


def baseline_text(record: Mapping[str, Any]) -> str:
    """Text that compares the model's test fit with that of the best simple baseline model."""
    fit = record.get("fit_baseline_percent")
    own = record.get("fit_test_percent")
    text = f"{format_column(record, 'fit_baseline_percent', '.1f', ' %')}, {record.get('baseline')}"
    spread = baseline_spread_text(record)
    is_ahead = fit is not None and own is not None and fit - own >= AHEAD
    return f"{text}{spread}: it predicts better than this model" if is_ahead else text + spread


def baseline_spread_text(record: Mapping[str, Any]) -> str:
    """Text with the range of test fits of the baseline models whose validation fit is nearly the
    best."""
    highest = record.get("fit_baseline_highest_percent")
    lowest = record.get("fit_baseline_lowest_percent")
    if highest is None or (lowest is not None and highest - lowest < WIDE_SPREAD):
        return ""
    least = "divergence" if lowest is None else f"{lowest:.1f}"
    return f" ({least} to {highest:.1f} % with those that validate as well)"


def log_reading_text(record: Mapping[str, Any]) -> str:
    """Text that says how a log was read and cut into records; empty for simulated data."""
    notes = str(record.get("evidence_reasons") or "")
    reading = re.search(r"note: The log was read so: (.*?)\.(?= (?:note|doubt):|$)", notes)
    cut = re.search(r"note: The log was (cut .*?)\.(?= (?:note|doubt):|$)", notes)
    parts = [match[1] for match in (reading, cut) if match is not None]
    return "; ".join(parts)


def proved_rows(record: Mapping[str, Any], facts: RunFacts) -> Iterator[Row]:
    """Rows of a run's printed results on the proved rates of contraction, one for each gain."""
    for side, paper_theorem in PAPER_THEOREMS.items():
        theorem = facts.own_theorems.get(side, paper_theorem)
        name = f"{side}_certified_rate"
        limit = f"at most {format_column(record, f'{side}_rate_limit')}"
        chosen = "chosen by auto" if side in str(record.get("rates_chosen")) else "requested"
        requested = f"{format_column(record, f'rate_{side}')} {chosen}"
        if side not in facts.own_theorems:  # the limit is that of the paper's theorems
            requested = f"{requested}, {limit}"
        requested_words = f"{requested}: {certificate_status_word(record, side)}"
        label = f"{side.capitalize()} rate"
        if record.get(name) is None:
            yield f"rate_{side}", label, requested_words
        else:
            proved = f"{format_column(record, name)} per sample ({theorem})"
            decay = decay_time_text(float(record[name]), facts.step_s)
            timed = f"{proved}, {decay}" if decay else proved
            yield name, label, f"{timed}; {requested_words}"
    unproved = unproved_speed_up_text(record, facts.step_s)
    if unproved:
        yield "controller_certified_rate", "Speed-up", unproved
    yield from input_limit_rows(record, facts)
    if facts.no_set_points_reason:
        words = f"none: {facts.no_set_points_reason}"
        yield "controller_gain_norm", "Exported, set points", words
    yield from coverage_rows(record)


def input_limit_rows(record: Mapping[str, Any], facts: RunFacts) -> Iterator[Row]:
    """Rows of a run's printed results on the contraction rate that is proved under input limits."""
    label = LIMITS_OF[_is_loop_on_plant(record)]
    if record.get("neurons") and record.get("controller_certified"):
        yield "neurons", label, "nothing is proved: the theorems on limits know no neurons"
    if "controller" in facts.own_theorems and record.get("limit_lower") is None:
        theorem = facts.own_theorems["controller"]
        yield "controller_certified", label, f"nothing is proved within them for {theorem}"
    low, high = (format_column(record, f"limit_{end}") for end in ("lower", "upper"))
    rate = format_column(record, "limited_rate")
    everywhere = "at no rate" if rate == MISSING else f"at {rate} per sample"
    outputs = "a range of each initial output (see the exported header)"
    if record.get("unlimited_from") is not None:
        first, last = (format_column(record, f"unlimited_{end}") for end in ("from", "to"))
        outputs = f"initial outputs in [{first}, {last}]{facts.output_unit}"
    limits = f"input {low} to {high}{facts.input_unit}"
    contraction = f"contracts globally {everywhere}, at the full rate from {outputs}"
    yield "limit_lower", label, f"{limits}: {contraction}"


def coverage_rows(record: Mapping[str, Any]) -> Iterator[Row]:
    """Rows of a run's printed results on whether the proof covers the recorded model error, which a
    coverage below one does not; for an older run, on the tolerated gain."""
    label = "Model error covered"
    coverage = record.get("coverage")
    if coverage is None and record.get("coverage_reason") is None:
        until = "rest is proved up to {}" if record.get("neurons") else "{} is proved"
        value = until.format(format_column(record, "certified_tolerance"))
        yield "certified_tolerance", "Mismatch tolerated", f"{value}, as a gain on the input"
        yield from earlier_version_rows(record, label)
    elif coverage is None:
        reason = str(record.get("coverage_reason"))
        words = reason if reason.startswith(WITHHELD) else f"not covered: {reason}"
        yield "coverage_reason", label, words
    elif coverage < 1:
        where = record.get("coverage_reference")
        yield "coverage", label, f"not covered: the records show more than is proved ({where})"
    else:
        times = math.floor(100 * coverage) / 100  # never rounded up to what is not proved
        covered = f"{times:.2f} times as large as the records show, at every frequency above zero"
        yield "coverage", label, covered + refit_text(record) + fresh_error_ratio_text(record)


def refit_text(record: Mapping[str, Any]) -> str:
    """Remark that the model was trained on the records that measure its error, which then show less
    of it; otherwise empty."""
    is_refitted = TRAINED_ON_VALIDATION in str(record.get("training_ended"))
    return "; the model was trained on these records" if is_refitted else ""


def fresh_error_ratio_text(record: Mapping[str, Any]) -> str:
    """Text on the ratio of the model error in data not used for training to the model error in the
    records."""
    needed = record.get("coverage_needed")
    if needed is None:
        return ""
    needed = float(needed)  # an infinite one is stored as a word
    if not math.isfinite(needed):
        return "; fresh data lie outside every such disc"
    times = f"{math.ceil(100 * needed) / 100:.2f} times"
    if unused_data_exceed_coverage(record):
        times += ", more than is covered"
    sets = record.get("fresh_sets")
    if not sets:
        return f"; the test record shows {times}"
    if sets == 1:
        return f"; a fresh data set shows {times}"
    return f"; {sets} fresh data sets show at most {times}"


def unused_data_exceed_coverage(record: Mapping[str, Any]) -> bool:
    """Whether data not used for the fit show a larger model error than the proof tolerates."""
    coverage = record.get("coverage")
    needed = record.get("coverage_needed")
    if coverage is None or needed is None:
        return False
    return 1 <= float(coverage) < float(needed)


def prediction_rows(record: Mapping[str, Any]) -> Iterator[Row]:
    """Rows of a run's printed results on the plant's behaviour as model and records predict it."""
    level = str(record.get("evidence"))
    yield "evidence", "Evidence", evidence_text(level, record.get("evidence_reasons"), NOTES)
    label = "Prediction for the plant" if _is_loop_on_plant(record) else "Prediction"
    if record.get("evidence") == CANNOT_JUDGE:
        yield "evidence", label, "none: the evidence allows no judgement"
        return
    word = "stays stable" if record.get("predicted_stable") else "not predicted to be stable"
    if record.get("predicted_faster") is False:
        word += ", no faster than without control"
    if record.get("evidence") == DOUBT:
        word += ", with doubts"
    names = ("resolved_margin", "controller_radius", "noise_peak")
    grounds = prediction_text(*(record.get(name) for name in names))
    sine_margin = record.get("sine_margin")
    if sine_margin is not None and sine_margin <= 1 < (record.get("resolved_margin") or 0.0):
        margin = format_column(record, "sine_margin")
        grounds = f"single sines show more than the other records (margin {margin})"
    words = f"{word}: {grounds}{refit_text(record)}" if grounds else word
    yield "predicted_stable", label, words
    if sine_margin is None and _is_loop_on_plant(record):
        yield from earlier_version_rows(record, "Single sines")


def closed_loop_rows(record: Mapping[str, Any]) -> Iterator[Row]:
    """Rows of a run's printed results on how many simulated starts settled, and how fast."""
    count = format_column(record, "stable_count", ".0f")
    starts = format_column(record, "initial_conditions", ".0f")
    yield "stable_count", "Initial states settled", f"{count} of {starts}"
    time_s = record.get("settling_time_mean_s")
    open_loop_s = record.get("settling_time_open_loop_s")
    ratio = f" (ratio {time_s / open_loop_s:.2f})" if time_s is not None and open_loop_s else ""
    mean = duration_text(time_s)
    comes_to_rest = open_loop_s is not None
    uncontrolled = f"{duration_text(open_loop_s)}{ratio}" if comes_to_rest else "none settles"
    column = "settling_time_open_loop_s" if comes_to_rest else "settling_time_mean_s"
    yield column, "Mean settling time", f"{mean}, uncontrolled {uncontrolled}"
    yield "stable_count_pi", "A PI from the same model", pi_comparison_text(record)
    yield "noise_gain_model", "Sensor noise", noise_effect_text(record)


def pi_comparison_text(record: Mapping[str, Any]) -> str:
    """Text that compares a textbook PI controller with the designed controller."""
    count = format_column(record, "stable_count_pi", ".0f")
    starts = format_column(record, "initial_conditions", ".0f")
    pi_time_s = record.get("settling_time_pi_s")
    own_time_s = record.get("settling_time_mean_s")
    words = f"{duration_text(pi_time_s)}, {count} of {starts}"
    all_settle = record.get("stable_count_pi") == record.get("initial_conditions")
    if all_settle and pi_time_s is not None and (own_time_s is None or pi_time_s < own_time_s):
        return f"{words}: faster than the certified controller"
    return words


def noise_effect_text(record: Mapping[str, Any]) -> str:
    """Text on how much the sensor's noise moves the output of the closed loop. A large effect means
    that the loop moves by itself, or is closer to its limit than predicted."""
    measured = record.get("noise_gain_measured")
    model = record.get("noise_gain_model")
    if measured is None:
        return f"reaches the model's output {format_column(record, 'noise_gain_model')}-fold"
    words = f"reaches the output {format_column(record, 'noise_gain_measured')}-fold"
    if measured == 0:  # friction holds it
        words = "does not move the output"
    if model is None:
        return words
    words += f", the model's {model:.3g}-fold"
    if measured > DOUBTFUL_NOISE_GAIN * model:
        return f"{words}: doubt, more than twice what the model predicts"
    return f"{words}: more than noise moves it" if measured > model else words


def certificate_status_word(record: Mapping[str, Any], side: str) -> str:
    """Word for the state of a certificate: `certified`, `not certified`, `infeasible` or `not
    reached`."""
    if record.get(f"{side}_certified"):
        return "certified"
    feasible = record.get(f"{side}_feasible")
    if feasible is None:
        return "not reached"
    return "not certified" if feasible else "infeasible"


def outcome_reasons(record: Mapping[str, Any]) -> Iterator[str]:
    """Reasons in a run's record why the run is doubtful, infeasible, not certified or failed."""
    findings = str(record.get("evidence_reasons") or "")
    for finding in re.split(r" (?=(?:note|doubt|cannot judge): )", findings):
        if finding.startswith(("doubt: ", "cannot judge: ")):
            yield f"{finding[0].upper()}{finding[1:]}"
    for name in ("infeasible_reason", "uncertified_reason", "error_message"):
        if record.get(name):
            yield f"{name.replace('_', ' ').capitalize()}: {record[name]}"
