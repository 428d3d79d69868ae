"""Data that the report page carries: the table by columns, trajectories of the best runs, reasons,
provenance."""

import base64
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.report.answers import answers, parameters_line
from ssm_study.report.page.pictures import pictures_of_run
from ssm_study.report.study_folder import RecordedCases, RunFolder, StudyFolder
from ssm_study.report.words import CHOICES, VERDICTS, counts, spoken, verdicts, words
from ssm_study.table.columns import DECLARED, FURTHER, RESULTS, by_part, column, swept, text
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
COMPARED = ("controller", "situation", "design", "certified", "mismatch_margin", "stable_fraction",
            "stable_count", "initial_conditions", "settling_time_mean_s", "settling_time_worst_s",
            "input_peak_v", "reason")  # fmt: skip


def page_data(study: StudyFolder) -> dict[str, Any]:
    """Everything the page's script needs, as plain JSON values."""
    table = best_ordered(study.table)
    best = study.best
    named = [
        (name, sorted({TREE.get(v, v) for v in text(table, name)} - {""}))
        for name in PROVENANCE
        if name in table
    ]
    config = best.path / ".hydra" / "config.yaml" if best else None
    on = {"Plant": text(table, "plant").map(spoken), "Data": text(table, "data_source")}
    subject = "".join(
        f"{word}: {', '.join(names)}. "
        for word, said in on.items()
        if (names := sorted({*said} - {""}))
    )
    return {
        "study": study.name,
        "folder": study.folder.resolve().name,
        "question": question(table),
        "swept": f"{subject}{counts(table)}. {parameters_line(table)}",
        "answers": [vars(answer) for answer in answers(table)],
        "verdicts": [vars(verdict) for verdict in VERDICTS],
        "columns": {str(name): coded(table[name]) for name in table},
        "words": {str(name): words(name) for name in table},
        "menus": by_part(map(str, table)),
        "known_columns": [c.name for c in DECLARED if c.word],
        "first": [
            "run",
            "verdict",
            *swept(table),
            "stable_count",
            *(c.name for c in RESULTS if c.shown),
            *ALSO_FIRST,
        ],
        "parameters": swept(table),
        "trajectories": trajectories(study, table),
        "pictures": pictures(study, table),
        "comparisons": comparisons(study, table),
        "choices": CHOICES,
        "configuration": config.read_text() if config and config.is_file() else "",
        # Several values where the runs disagree, which a reader should know.
        "provenance": [
            (name.replace("git_dirty", "working tree").replace("_", " "), " or ".join(v))
            for name, v in named
            if v
        ],
    }


def question(table: pd.DataFrame) -> str:
    """The question of a sweep: `What changes with the model order and the controller rate?`."""
    said = (
        (name, words(name).partition(" (")[0].partition(",")[0].lower()) for name in swept(table)
    )
    varied = [
        word if FURTHER.covers(name) else f"the {word}" for name, word in said
    ]  # a setting's key is a name
    varied = (
        varied[:-1] if len(varied) > 1 and varied[-1] == "the seed" else varied
    )  # what the mean is taken over
    return (
        "What changes with "
        f"{' and '.join([', '.join(varied[:-1])] * (len(varied) > 1) + varied[-1:])}?"
    )


def best_ordered(table: pd.DataFrame) -> pd.DataFrame:
    """Best first, with the two columns the plots need and the table lacks."""
    table = best_first(table).reset_index(drop=True)
    table = table.assign(verdict=verdicts(table))
    ratio = column(table, "input_slope_lower") / column(table, "input_slope_upper")
    return table.assign(slope_ratio=ratio) if ratio.notna().any() else table


def coded(values: pd.Series) -> list[Any] | dict[str, list[Any]]:
    """The plain values, or where few differ each once and which of them stands where; nowhere, if
    all are the same."""
    at, distinct = pd.factorize(values, use_na_sentinel=False)
    shown = [_plain(value) for value in distinct]
    if 4 * len(shown) >= len(values):  # an index takes about a quarter of what a number takes
        return [shown[k] for k in at]
    return {"values": shown, "at": at.tolist() if len(shown) > 1 else []}


def _plain(value: Any) -> Any:
    """A number (to seven digits), a text, a truth value, or None: JSON has no NaN."""
    value = value.item() if isinstance(value, np.generic) else value
    if pd.isna(value) or value in (np.inf, -np.inf):
        return None
    if isinstance(value, float):
        return float(f"{value:.7g}")
    return value if isinstance(value, (bool, int)) else str(value)


def trajectories(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """`{run: {...}}` for the best runs that left recordings."""
    best = text(table, "run").head(MOST_TRAJECTORIES)
    return {name: found for name in best if name and (found := _recordings(study.run(name)))}


def pictures(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """`{run: [picture, ...]}` for the best few runs: each takes 50 kB and a second or two."""
    best = text(table, "run").head(MOST_PICTURED)
    drawn = {name: pictures_of_run(study.run(name)) for name in best if name}
    return {name: pictured for name, pictured in drawn.items() if pictured}


def comparisons(study: StudyFolder, table: pd.DataFrame) -> dict[str, Any]:
    """`{run: {column: [...]}}`: controllers and situations, or certified designs, that the best
    runs tried."""
    best = set(text(table, "run").head(MOST_TRAJECTORIES))
    compared = study.comparison
    kept = [name for name in COMPARED if name in compared]
    return {
        str(run): {
            name: [_plain(value) for value in rows[name]]
            for name in kept
            if rows[name].notna().any()
        }
        for run, rows in (compared.groupby("run") if len(compared) else ())
        if run in best
    }


def _recordings(run: RunFolder) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if (loop := run.closed_loop) is not None:
        until = int(np.searchsorted(loop.time_s("output"), loop.rest_s)) + 1
        found["loop"] = _packed(loop, until, y="output", u="input", alone="uncontrolled")
        found["loop"] |= {"band": loop.settling_band, "goal": float(loop["reference"][0, -1, 0])}
    if (record := run.validation) is not None:
        found["validation"] = _packed(record, LONGEST, y="measured", u="input", model="simulated")
    return found


def _packed(recording: RecordedCases, until: int, **names: str) -> dict[str, Any]:
    """The first channel of these signals and what is printed of them."""
    y = names["y"]
    u = names["u"]
    about = {
        "step_s": recording.step_s(y),
        "input": recording.label(u),
        "output": recording.label(y),
    }
    return about | {short: packed(recording[name][:, :until, 0]) for short, name in names.items()}


def packed(rows: Float[np.ndarray, "N T"]) -> dict[str, Any]:
    """16-bit steps of the largest value, base64: invisible in a plot, a tenth of the size of
    text."""
    step = float(np.abs(rows).max()) / 32767 or 1.0
    steps = np.rint(rows / step).astype("<i2")  # little endian, as the script reads it
    return {"step": step, "rows": len(rows), "steps": base64.b64encode(steps.tobytes()).decode()}
