"""Data of the report page: the table by columns, trajectories of the best runs, reasons,
provenance."""

import base64
import re
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.report.answers import answers, parameters_line
from ssm_study.report.page.compared import comparison_json
from ssm_study.report.page.failures import MOST_REASONS, MOST_RUNS, failure_groups
from ssm_study.report.page.first_screen import (
    introduction,
    outcome_cards,
    remarks,
    row_as_record,
    settings_line,
)
from ssm_study.report.page.pictures import pictures_of_run
from ssm_study.report.study_folder import RecordedCases, RunFolder, StudyFolder
from ssm_study.report.words import VERDICTS, choice_label, column_words, verdict_counts, verdicts
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
from ssm_study.table.rank import best_first

MOST_TRAJECTORIES = 200  # best runs whose trajectories are embedded: about 10 kB each
MOST_PICTURED = 3  # best runs whose pictures are embedded
LONGEST = 400  # samples of a validation record shown: more than a phone has pixels
PROVENANCE = ("git_commit", "git_dirty", "machine", "machine_processor", "machine_cores",
              "version_python",
              "version_ssm_study", "version_torch", "version_cvxpy",
              "version_clarabel")  # fmt: skip
TREE = {
    "False": "clean",
    "True": "with uncommitted changes",
}  # git_dirty; what git does not track is left out
ALSO_FIRST = (
    "controller_certified_rate",
    "controller_gain_norm",
    "input_peak_v",
    "evidence",
)  # in the table


def page_data(study: StudyFolder) -> dict[str, Any]:
    """Collect everything that the page's script needs, as plain JSON values."""
    table = sort_for_page(study.table)
    names = [str(name) for name in table]
    data: dict[str, Any] = {"study": study.name, "folder": study.folder.resolve().name}
    data["verdicts"] = [vars(verdict) for verdict in VERDICTS]
    data["columns"] = {name: encode_repeats(table[name]) for name in names}
    data["words"] = {name: column_words(name) for name in names}
    data["menus"] = group_by_part(names)
    data["known_columns"] = [column.name for column in DECLARED if column.word]
    data["first"] = first_columns(table)
    data["parameters"] = swept_settings(table)
    data["trajectories"] = trajectories(study, table)
    data["pictures"] = pictures(study, table)
    data["comparisons"] = comparisons(study, table)
    data["slider"] = slider_settings(table)
    return data


def first_columns(table: pd.DataFrame) -> list[str]:
    """Columns that the page's table shows until the reader asks for all."""
    results = [result.name for result in RESULTS if result.shown]
    return ["run", "verdict", *swept_settings(table), "stable_count", *results, *ALSO_FIRST]


def slider_settings(table: pd.DataFrame) -> dict[str, Any] | None:
    """Settings of the page's slider over a swept number; None where no number was swept. It moves
    through the runs that share all other settings with the best, in order; a rate is preferred to
    other numbers."""
    if not len(table):
        return None
    settings = swept_settings(table)
    rated = sorted(settings, key=lambda name: not name.startswith("rate_"))
    for name in rated:
        if name == "seed" or not pd.api.types.is_numeric_dtype(table[name]):
            continue
        alike = pd.Series(True, index=table.index)
        for other in settings:
            own = requested_values(table, other).astype("string").fillna("")
            if other != name:
                alike &= (own == own.iloc[0]).astype(bool)
        numbers = pd.to_numeric(requested_values(table, name)[alike], errors="coerce").dropna()
        numbers = numbers[~numbers.duplicated()].sort_values()
        if len(numbers) > 1:
            title = column_words(name).partition(" (")[0]
            return {"title": title, "runs": numbers.index.tolist(), "values": numbers.tolist()}
    return None


def written_parts(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Text blocks of the page's HTML."""
    best = study.best
    config = best.path / ".hydra" / "config.yaml" if best else None
    on = {
        "Plant": text_column(table, "plant").map(choice_label),
        "Data": text_column(table, "data_source"),
    }
    subject = "".join(
        f"{word}: {', '.join(names)}. "
        for word, said in on.items()
        if (names := sorted({*said} - {""}))
    )
    parts: dict[str, Any] = {"title": study.name, "question": page_title(table)}
    parts["swept"] = f"{subject}{verdict_counts(table)}. {parameters_line(table)}"
    parts["several"] = len(table) > 1
    parts["answers"] = answers(table)
    parts["provenance"] = provenance(study, table)
    parts["configuration"] = config.read_text() if config and config.is_file() else ""
    parts["failures"] = failure_groups(table)
    parts["most_reasons"] = MOST_REASONS
    parts["most_runs"] = MOST_RUNS
    parts["names"] = text_column(table, "run").tolist()
    if len(table):
        first = row_as_record(table.iloc[0])
        parts["introduction"] = introduction(table)
        parts["settings"] = settings_line(table)
        parts["cards"] = outcome_cards(first)
        parts["remarks"] = list(remarks(first))
    return parts


def provenance(study: StudyFolder, table: pd.DataFrame) -> list[tuple[str, str]]:
    """Lines on the provenance of the runs, with several values where the runs disagree."""
    facts = []
    for name in PROVENANCE:
        if name not in table:
            continue
        values = sorted({TREE.get(value, value) for value in text_column(table, name)} - {""})
        if values:
            title = name.replace("git_dirty", "working tree").replace("_", " ")
            facts.append((title, " or ".join(values)))
    if len(table):
        folder, run = run_address(study, text_column(table, "run").iloc[0])
        facts.append(("to check the best run", f"ssm-study verify results/{folder}/{run}"))
    return facts


def run_address(study: StudyFolder, name: str) -> tuple[str, str]:
    """Study folder of a run, which may be another study's, and the digits of the run's name."""
    other = re.match(r"\.\./([^/]+)/", name)
    folder = other[1] if other else study.folder.resolve().name
    return folder, name.rpartition("/")[2].rpartition("-")[2]


def page_title(table: pd.DataFrame) -> str:
    """Title of the page as a question, such as `What changes with the model order?`."""
    said = (
        (name, column_words(name).partition(" (")[0].partition(",")[0].lower())
        for name in swept_settings(table)
    )
    varied = [
        word if FURTHER.matches_name(name) else f"the {word}" for name, word in said
    ]  # a setting's key is a name
    varied = (
        varied[:-1] if len(varied) > 1 and varied[-1] == "the seed" else varied
    )  # what the mean is taken over
    return (
        "What changes with "
        f"{' and '.join([', '.join(varied[:-1])] * (len(varied) > 1) + varied[-1:])}?"
    )


def sort_for_page(table: pd.DataFrame) -> pd.DataFrame:
    """Table with the best run first and with all columns that the plots need."""
    table = best_first(table).reset_index(drop=True)
    table = table.assign(verdict=verdicts(table))
    ratio = numeric_column(table, "input_slope_lower") / numeric_column(table, "input_slope_upper")
    return table.assign(slope_ratio=ratio) if ratio.notna().any() else table


def encode_repeats(values: pd.Series) -> list[Any] | dict[str, list[Any]]:
    """Compact form of a column with repeated values: the distinct values, and an index for each
    row. Without repeats it is the plain values."""
    at, distinct = pd.factorize(values, use_na_sentinel=False)
    shown = [_plain_json(value) for value in distinct]
    if 4 * len(shown) >= len(values):  # an index takes about a quarter of what a number takes
        return [shown[k] for k in at]
    return {"values": shown, "at": at.tolist() if len(shown) > 1 else []}


def _plain_json(value: Any) -> Any:
    """Value of the table as a plain JSON value: a number (to seven digits), a text, a truth value,
    or None."""
    value = value.item() if isinstance(value, np.generic) else value
    if pd.isna(value) or value in (np.inf, -np.inf):
        return None
    if isinstance(value, float):
        return float(f"{value:.7g}")
    return value if isinstance(value, (bool, int)) else str(value)


def trajectories(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Closed-loop trajectories of the best runs, keyed by the name of the run. Only runs that left
    recordings have them."""
    best = text_column(table, "run").head(MOST_TRAJECTORIES)
    return {name: found for name in best if name and (found := _run_recordings(study.run(name)))}


def pictures(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Pictures of the best few runs, keyed by the name of the run. Each picture takes 50 kB and a
    second or two."""
    best = text_column(table, "run").head(MOST_PICTURED)
    drawn = {name: pictures_of_run(study.run(name)) for name in best if name}
    return {name: pictured for name, pictured in drawn.items() if pictured}


def comparisons(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """Comparisons of controllers for the best runs that have one, keyed by the name of the run.
    Each is a table or a chart."""
    best = set(text_column(table, "run").head(MOST_TRAJECTORIES))
    compared = study.comparison
    runs = compared.groupby("run") if len(compared) else ()
    return {str(run): comparison_json(rows) for run, rows in runs if run in best}


def _run_recordings(run: RunFolder) -> dict[str, Any]:
    """Closed loop and validation free run of one run, in a compact form for the page."""
    found: dict[str, Any] = {}
    if (loop := run.closed_loop) is not None:
        until = int(np.searchsorted(loop.time_s("output"), loop.settled_time_s)) + 1
        packed_loop = _encode_signals(loop, until, y="output", u="input", alone="uncontrolled")
        packed_loop["band"] = loop.settling_band
        packed_loop["goal"] = float(loop["reference"][0, -1, 0])
        found["loop"] = packed_loop
    if (record := run.validation) is not None:
        found["validation"] = _encode_signals(record, LONGEST, y="measured", model="simulated")
    return found


def _encode_signals(recording: RecordedCases, until: int, **names: str) -> dict[str, Any]:
    """First channels of several recorded signals with labels, in a compact form for the page."""
    y = names["y"]
    about: dict[str, Any] = {"step_s": recording.step_s(y), "output": recording.label(y)}
    if "u" in names:
        about["input"] = recording.label(names["u"])
    for short, name in names.items():
        about[short] = encode_rows(recording[name][:, :until, 0])
    return about


def encode_rows(rows: Float[np.ndarray, "N T"]) -> dict[str, Any]:
    """Compact text form of rows of numbers for the page's script. 16-bit steps of the largest value
    in base64: the error is invisible in a plot, the size a tenth of text."""
    step = float(np.abs(rows).max()) / 32767 or 1.0
    steps = np.rint(rows / step).astype("<i2")  # little endian, as the script reads it
    coded_steps = base64.b64encode(steps.tobytes()).decode()
    return {"step": step, "rows": len(rows), "steps": coded_steps}
