"""Data of the report page: the study's table, the trajectories of its best runs, reasons for failed
runs, provenance."""

import base64
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.report.answers import Answer, swept_settings_line
from ssm_study.report.page.amplitudes import with_physical_amplitudes
from ssm_study.report.page.chart_looks import LOOK
from ssm_study.report.page.compared import comparison_json
from ssm_study.report.page.failures import MOST_REASONS, MOST_RUNS, failure_groups
from ssm_study.report.page.first_screen import (
    Remark,
    best_run_rule,
    outcome_cards,
    outcome_remarks,
    plain_setting_name,
    requested_setting_text,
    row_as_record,
    varied_settings_sentence,
)
from ssm_study.report.page.pictures import pictures_of_run
from ssm_study.report.page.proof_card import RecordedLoopFacts
from ssm_study.report.page.provenance import configuration_text, log_source_text, provenance_lines
from ssm_study.report.page.runner_up import choose_robust_alternative
from ssm_study.report.study_folder import RecordedCases, RunFolder, StudyFolder
from ssm_study.report.words import (
    FAILED,
    INFEASIBLE,
    VERDICTS,
    choice_label,
    printed_column_name,
    verdict_counts,
    verdict_words,
)
from ssm_study.table.columns import (
    DECLARED,
    FURTHER,
    RESULTS,
    group_by_part,
    numeric_column,
    requested_values,
    swept_settings,
    text_column,
)
from ssm_study.table.doubts import row_count_warnings
from ssm_study.table.rank import sort_best_first

MOST_TRAJECTORIES = 200  # best runs whose trajectories are embedded: about 10 kB each
MOST_PICTURED = 3  # best runs whose pictures are embedded
LARGEST_STEP = 32767  # of 16-bit steps
LONGEST = 400  # samples of a validation record shown: more than a phone has pixels
# Columns that say no more than another: numbers in total, where the number by frequency decides,
# and the reason of one side where the run's is there.
WEAKER = {
    "certified_tolerance": "coverage",  # one gain for all frequencies
    "mismatch_margin": "resolved_margin",
    "mismatch_gain": "resolved_margin",
    "mismatch_seen": "resolved_margin",
    "mismatch_spread": "resolved_margin",
    "controller_reason": "infeasible_reason",
    "observer_reason": "infeasible_reason",
}
BOOKKEEPING = ("pid", "record_version", "input_slope_lower_spectral")
ALSO_FIRST = (
    "controller_certified_rate",
    "controller_gain_norm",
    "input_peak_v",
    "evidence",
)  # in the table


def page_data(study: StudyFolder) -> dict[str, Any]:
    """Collect everything that the script of the report page needs, as plain JSON values."""
    table = with_physical_amplitudes(study, sort_for_page(study.table))
    names = [str(name) for name in table]
    data: dict[str, Any] = {"study": study.name, "folder": study.folder.resolve().name}
    data["verdicts"] = [vars(verdict) for verdict in VERDICTS]
    data["columns"] = {name: encode_repeated_values(table[name]) for name in names}
    data["words"] = {
        name: study.units.replace_words_by_units(printed_column_name(name)) for name in names
    }
    data["menus"] = group_by_part([name for name in names if is_offered_in_menus(name)])
    data["known_columns"] = comparable_columns(table)
    data["first"] = initial_columns(table)
    data["parameters"] = swept_settings(table)
    data["trajectories"] = best_run_trajectories(study, table)
    data["pictures"] = best_run_pictures(study, table)
    data["comparisons"] = best_run_comparisons(study, table)
    data["slider"] = slider_settings(table)
    data["look"] = LOOK
    return data


def is_offered_in_menus(name: str) -> bool:
    """Whether a table column can be chosen in the menus of the report page."""
    return name not in BOOKKEEPING and not name.startswith("stage_")


def comparable_columns(table: pd.DataFrame) -> list[str]:
    """Names of the table columns by which the report page compares runs. All columns stay in the
    record and in the CSV."""
    replaced = {
        name for name, better in WEAKER.items() if better in table and table[better].notna().any()
    }
    return [column.name for column in DECLARED if column.word and column.name not in replaced]


def initial_columns(table: pd.DataFrame) -> list[str]:
    """Names of the table columns that the report page shows until the reader asks for all."""
    results = [result.name for result in RESULTS if result.shown]
    return ["run", "verdict", *swept_settings(table), "stable_count", *results, *ALSO_FIRST]


def slider_settings(table: pd.DataFrame) -> dict[str, Any] | None:
    """Settings of the slider by which the report page steps through the runs of a sweep; None where
    no number was swept. It moves through the runs that share all other settings with the best, in
    order; a rate is preferred to other numbers."""
    if not len(table):
        return None
    settings = swept_settings(table)
    rates_first = sorted(settings, key=lambda name: not name.startswith("rate_"))
    for name in rates_first:
        if name == "seed" or not pd.api.types.is_numeric_dtype(table[name]):
            continue
        others = [other for other in settings if other != name]
        numbers = requested_numbers(table[has_settings_of_best_run(table, others)], name)
        if len(numbers) > 1:
            title = printed_column_name(name).partition(" (")[0]
            runs = numbers.index.tolist()
            same = shared_settings_text(table, others)
            notes = [slider_note(row_as_record(table.loc[run]), name, same) for run in runs]
            return {"title": title, "runs": runs, "values": numbers.tolist(), "notes": notes}
    return None


def shared_settings_text(table: pd.DataFrame, names: list[str]) -> str:
    """Text of the settings that all runs of the page's slider have in common, such as `, with seed
    1`."""
    record = row_as_record(table.iloc[0])
    parts = [f"{plain_setting_name(name)} {requested_setting_text(record, name)}" for name in names]
    return f", with {', '.join(parts)}" if parts else ""


def slider_note(record: dict[str, Any], name: str, shared_settings: str) -> str:
    """Text on the run at one position of the page's slider; for an infeasible run, the reason and
    the possible rate."""
    if record["verdict"] != INFEASIBLE.word:
        return f"{record['verdict']}{shared_settings}"
    limit = record.get(f"{name.removeprefix('rate_')}_rate_limit")
    reason = record.get("infeasible_reason") or "no certificate exists"
    if limit is not None and record[name] >= limit:
        reason = f"the largest possible is {limit:.3g}"
    noun = "rate" if name.startswith("rate_") else "value"
    return f"infeasible at this {noun}{shared_settings}: {reason}"


def has_settings_of_best_run(table: pd.DataFrame, settings: list[str]) -> "pd.Series[bool]":
    """For each run, whether given settings have the same values as in the best run."""
    alike = pd.Series(True, index=table.index)
    for name in settings:
        values = requested_values(table, name).astype("string").fillna("")
        alike &= (values == values.iloc[0]).astype(bool)
    return alike


def requested_numbers(table: pd.DataFrame, name: str) -> pd.Series:
    """Distinct requested values of a swept setting in ascending order."""
    requested = requested_values(table, name)
    numbers = pd.to_numeric(requested, errors="coerce").dropna()
    is_repeated = numbers.duplicated()
    return numbers[~is_repeated].sort_values()


def is_test_noise_free(study: StudyFolder) -> bool:
    """Whether the best run's test record was simulated without sensor noise."""
    data = {} if study.best_run is None else study.best_run.config.get("data") or {}
    return data.get("test_noise") is False


def page_texts(
    study: StudyFolder, table: pd.DataFrame, unplotted: Sequence[Answer]
) -> dict[str, Any]:
    """Text blocks for the HTML of the report page. `unplotted` are answers without a plot."""
    parts: dict[str, Any] = {"title": study.name}
    parts["question"] = page_title(table)
    counts = verdict_counts(table)
    subject = f"{plants_and_data_text(table)}{log_source_text(study)}"
    parts["swept"] = f"{subject}{counts}. {swept_settings_line(table)}"
    parts["several"] = len(table) > 1
    parts["answers"] = unplotted
    parts["provenance"] = provenance_lines(study, table)
    parts["configuration"] = configuration_text(study)
    parts["failures"] = failure_groups(table)
    parts["most_reasons"] = MOST_REASONS
    parts["most_runs"] = MOST_RUNS
    parts["names"] = text_column(table, "run").tolist()
    if len(table):
        first = row_as_record(table.iloc[0])
        parts["introduction"] = best_run_rule(table)
        parts["settings"] = varied_settings_sentence(table)
        parts["runner_up"] = choose_robust_alternative(table)
        parts["cards"] = outcome_cards(
            first, read_loop_facts(study, first), noise_free_test=is_test_noise_free(study)
        )
        parts["remarks"] = [*table_remarks(study, table), *outcome_remarks(first)]
    return parts


def table_remarks(study: StudyFolder, table: pd.DataFrame) -> list[Remark]:
    """Remark on runs of a study that are counted twice or are missing; empty if there are none."""
    sentences = [] if study.others else row_count_warnings(study.folder, table)
    text = " ".join(sentences)
    return [Remark(title="Runs", text=text, is_warning=True)] if sentences else []


def read_loop_facts(study: StudyFolder, record: dict[str, Any]) -> RecordedLoopFacts | None:
    """Read facts on the closed loop of a run from its recording; None if the run left no recording
    of the loop."""
    name = record.get("run")
    recording = study.run_folder(name).closed_loop if name else None
    return None if recording is None else RecordedLoopFacts.from_recording(recording)


def plants_and_data_text(table: pd.DataFrame) -> str:
    """Text that names the plants and the kind of data of a study, such as `Data: simulated.`"""
    plants = text_column(table, "plant").map(choice_label)
    sources = text_column(table, "data_source")
    words = ""
    for title, values in (("Plant", plants), ("Data", sources)):
        names = sorted({*values} - {""})
        if names:
            words += f"{title}: {', '.join(names)}. "
    return words


def page_title(table: pd.DataFrame) -> str:
    """Title of the report page as a question, such as `What changes with the model order?`."""
    varied = [setting_name_in_sentence(name) for name in swept_settings(table)]
    if len(varied) > 1 and varied[-1] == "the seed":  # what the mean is taken over
        varied = varied[:-1]
    words = varied[-1] if varied else ""
    if len(varied) > 1:
        words = f"{', '.join(varied[:-1])} and {words}"
    return f"What changes with {words}?"


def setting_name_in_sentence(name: str) -> str:
    """Printed name of a swept setting for use in a sentence, without its unit."""
    without_unit = printed_column_name(name).partition(" (")[0]
    word = without_unit.partition(",")[0].lower()
    return word if FURTHER.matches_name(name) else f"the {word}"


def sort_for_page(table: pd.DataFrame) -> pd.DataFrame:
    """Results table with the best run first and with all columns that the plots of the report page
    need."""
    table = sort_best_first(table).reset_index(drop=True)
    table = table.assign(verdict=verdict_words(table))
    table = mask_meaningless_values(table)
    lower = numeric_column(table, "input_slope_lower")
    upper = numeric_column(table, "input_slope_upper")
    ratio = lower / upper
    return table.assign(slope_ratio=ratio) if ratio.notna().any() else table


def mask_meaningless_values(table: pd.DataFrame) -> pd.DataFrame:
    """Results table without values that mean nothing for a run, such as the evidence for a design
    that was not found."""
    changed = {}
    if "evidence" in table:
        ended_early = table["verdict"].isin([INFEASIBLE.word, FAILED.word])
        changed["evidence"] = table["evidence"].mask(ended_early)
    excess = "certified_bound_excess_plant"
    if excess in table:
        on_model = text_column(table, "loop_on") == "identified model"
        changed[excess] = table[excess].mask(on_model)
    return table.assign(**changed)


def encode_repeated_values(values: pd.Series) -> list[Any] | dict[str, list[Any]]:
    """Compact JSON form of a column with repeated values: the distinct values, and an index for
    each row. Without repeats it is the plain values."""
    at, distinct = pd.factorize(values, use_na_sentinel=False)
    plain_values = [_plain_json(value) for value in distinct]
    if 4 * len(plain_values) >= len(
        values
    ):  # an index takes about a quarter of what a number takes
        return [plain_values[k] for k in at]
    places = at.tolist() if len(plain_values) > 1 else []
    return {"values": plain_values, "at": places}


def _plain_json(value: Any) -> Any:
    """Convert a value of a table to a plain JSON value: a number, a text, a truth value, or
    None."""
    value = value.item() if isinstance(value, np.generic) else value
    if pd.isna(value) or value in (np.inf, -np.inf):
        return None
    if isinstance(value, float):
        return float(f"{value:.7g}")
    return value if isinstance(value, (bool, int)) else str(value)


def best_run_trajectories(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Closed-loop trajectories of the best runs of a study, keyed by the name of the run. Only runs
    that left recordings have them."""
    return _collect_from_best_runs(study, table, MOST_TRAJECTORIES, _run_recordings)


def best_run_pictures(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Pictures of the best few runs of a study, keyed by the name of the run. Each picture takes 50
    kB and a second or two."""
    return _collect_from_best_runs(study, table, MOST_PICTURED, pictures_of_run)


def _collect_from_best_runs(
    study: StudyFolder, table: pd.DataFrame, count: int, collect: Callable[[RunFolder], Any]
) -> dict[str, Any]:
    """Parts of the report page, one for each of the best runs that has such a part, keyed by the
    name of the run."""
    by_run = {}
    for name in text_column(table, "run").head(count):
        collected = collect(study.run_folder(name)) if name else None
        if collected:
            by_run[name] = collected
    return by_run


def best_run_comparisons(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Comparisons of controllers for the best runs of a study, keyed by the name of the run. Each
    is a table or a chart."""
    best = set(text_column(table, "run").head(MOST_TRAJECTORIES))
    compared = study.controller_comparison
    runs = compared.groupby("run") if len(compared) else ()
    return {str(run): comparison_json(rows) for run, rows in runs if run in best}


def _run_recordings(run: RunFolder) -> dict[str, Any]:
    """Recordings of one run, of closed loop and validation, in a compact form for the report
    page."""
    recordings: dict[str, Any] = {}
    loop = run.closed_loop
    if loop is not None:
        time_s = loop.time_s("output")
        until = int(np.searchsorted(time_s, loop.time_after_settling_s)) + 1
        packed_loop = _encode_signals(loop, until, y="output", u="input", alone="uncontrolled")
        packed_loop["band"] = loop.settling_band
        reference = loop["reference"]
        packed_loop["goal"] = float(reference[0, -1, 0])
        recordings["loop"] = packed_loop
    record = run.validation
    if record is not None:
        recordings["validation"] = _encode_signals(record, LONGEST, y="measured", model="simulated")
    return recordings


def _encode_signals(recording: RecordedCases, until: int, **names: str) -> dict[str, Any]:
    """Encode the first channel of each of several recorded signals for the report page, together
    with axis labels and the sampling time."""
    output = names["y"]
    about: dict[str, Any] = {"step_s": recording.step_s(output)}
    about["output"] = recording.label(output)
    if "u" in names:
        about["input"] = recording.label(names["u"])
    for short, name in names.items():
        values = recording[name]
        about[short] = encode_rows(values[:, :until, 0])
    return about


def encode_rows(rows: Float[np.ndarray, "N T"]) -> dict[str, Any]:
    """Compact text form of rows of numbers, for the script of the report page."""
    largest = float(np.abs(rows).max())
    step = largest / LARGEST_STEP or 1.0
    steps = np.rint(rows / step).astype("<i2")  # little endian, as the script reads it
    coded_steps = base64.b64encode(steps.tobytes()).decode()
    return {"step": step, "rows": len(rows), "steps": coded_steps}
