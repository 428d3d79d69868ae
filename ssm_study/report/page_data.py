"""What the report page carries: the table by columns, trajectories of the best runs, reasons, provenance."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.report import answers, verdict
from ssm_study.report.columns import CHOICES, WORDS, column, text, words
from ssm_study.report.study_folder import RunFolder, Study

MOST_TRAJECTORIES = 200  # best runs whose trajectories are embedded: about 10 kB each
LONGEST = 400  # samples of a validation record shown: more than a phone has pixels
PROVENANCE = ("git_commit", "git_dirty", "machine", "machine_processor", "machine_cores", "version_python",
              "version_ssm_study", "version_torch", "version_cvxpy", "version_clarabel")  # fmt: skip
COMPARED = ("controller", "situation", "design", "certified", "mismatch_margin", "stable_fraction",
            "stable_count", "initial_conditions", "settling_time_mean_s", "settling_time_worst_s",
            "input_peak_v", "reason")  # fmt: skip
QUESTION = (
    "How do the fit of an identified model and the contraction rate certified for it relate to how its controller "
    "behaves on the true system?"
)


def page_data(study: Study) -> dict[str, Any]:
    """Everything the page's script needs, as plain JSON values."""
    table = best_ordered(study.table)
    best = study.best
    return {
        "study": study.name,
        "question": str((best.config if best else {}).get("question") or QUESTION),
        "swept": answers.parameters_line(table),
        "counts": verdict.counts(table),
        "answers": [{"question": a.question, "sentences": a.sentences} for a in answers.answers(table)],
        "verdicts": [{"word": v.word, "sentence": v.sentence, "colour": v.colour} for v in verdict.ALL],
        "columns": {str(name): plain(table[name]) for name in table},
        "words": {str(name): words(str(name)) for name in table},
        "known_columns": list(WORDS),
        "parameters": answers.swept(table),
        "trajectories": trajectories(study, table),
        "comparisons": comparisons(study, table),
        "choices": CHOICES,
        "configuration": configuration(best),
        "provenance": provenance(table),
    }


def best_ordered(table: pd.DataFrame) -> pd.DataFrame:
    """Best first, with the two columns the plots need and the table lacks."""
    table = verdict.best_first(table).reset_index(drop=True)
    extra = {"verdict": verdict.verdicts(table)}
    ratio = column(table, "input_slope_lower") / column(table, "input_slope_upper")
    if ratio.notna().any():
        extra["slope_ratio"] = ratio
    return table.assign(**extra)


def plain(values: pd.Series) -> list[Any]:
    """Numbers (to seven digits), texts, truth values or None: JSON has no NaN."""
    return [_plain(value) for value in values.astype(object)]


def _plain(value: Any) -> Any:
    if value is None or value is pd.NA or (isinstance(value, float) and not np.isfinite(value)):
        return None
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.7g}")
    return str(value)


def trajectories(study: Study, table: pd.DataFrame) -> dict[str, Any]:
    """`{run: {...}}` for the best runs that left recordings."""
    best = text(table, "run").head(MOST_TRAJECTORIES)
    return {name: found for name in best if name and (found := _recordings(study.run(name)))}


def comparisons(study: Study, table: pd.DataFrame) -> dict[str, Any]:
    """`{run: {column: [...]}}`: controllers and situations, or certified designs, that the best runs tried."""
    best = set(text(table, "run").head(MOST_TRAJECTORIES))
    compared = study.comparison
    if compared.empty:
        return {}
    kept = [name for name in COMPARED if name in compared]
    return {
        str(run): {name: plain(rows[name]) for name in kept if rows[name].notna().any()}
        for run, rows in compared.groupby("run")
        if run in best
    }


def _recordings(run: RunFolder) -> dict[str, Any]:
    found: dict[str, Any] = {}
    loop, record, band = run.closed_loop, run.validation, run.settling_band
    if loop is not None:
        shown = slice(0, int(np.searchsorted(loop.time_s, loop.rest_s(band))) + 1)
        found["loop"] = {
            "step_s": loop.step_s,
            "band": band,
            "goal": float(loop.reference[-1, 0]),
            "input": loop.input_label,
            "output": loop.output_label,
        }
        found["loop"] |= {"y": packed(loop.y[:, shown, 0]), "u": packed(loop.u[:, shown, 0])}
        if loop.uncontrolled is not None:
            found["loop"]["alone"] = packed(loop.uncontrolled[:, shown, 0])
    if record is not None:
        shown = slice(0, LONGEST)
        found["validation"] = {"step_s": record.step_s, "output": record.output_label, "input": record.input_label}
        found["validation"] |= {"y": packed(record.y[None, shown, 0]), "u": packed(record.u[None, shown, 0])}
        found["validation"]["model"] = packed(record.simulated[None, shown, 0])
    return found


def packed(rows: Float[np.ndarray, "N T"]) -> dict[str, Any]:
    """16-bit steps of the largest value, base64: invisible in a plot, a tenth of the size of text."""
    step = float(np.abs(rows).max()) / 32767 or 1.0
    steps = np.rint(rows / step).astype("<i2")
    return {"step": step, "rows": len(rows), "steps": base64.b64encode(steps.tobytes()).decode()}


def configuration(best: RunFolder | None) -> str:
    """The resolved configuration of that run as text; empty without a run."""
    path = None if best is None else best.path / ".hydra" / "config.yaml"
    return path.read_text() if path is not None and path.is_file() else ""


def provenance(table: pd.DataFrame) -> list[tuple[str, str]]:
    """What produced these runs; several values where the runs disagree, which a reader should know."""
    found = [(name, sorted(set(text(table, name)) - {""})) for name in PROVENANCE if name in table]
    return [(name.replace("_", " "), ", ".join(values)) for name, values in found if values]


def script_json(data: Any) -> str:
    """JSON that is safe inside a `<script>` element, whatever the texts of a run contain."""
    text_ = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text_.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def asset(name: str) -> str:
    """A text that the page is built from."""
    return (Path(__file__).parent / "page_assets" / name).read_text(encoding="utf-8")
