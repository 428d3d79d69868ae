"""Where the runs of a report page come from: log, configuration, code and machine."""

import re
from typing import Any

import pandas as pd

from ssm_study.report.page.proof_card import step_words
from ssm_study.report.study_folder import StudyFolder
from ssm_study.table.columns import text_column

MACHINE = ("machine", "machine_processor", "machine_cores")
PACKAGES = ("ssm_study", "torch", "cvxpy", "clarabel")
VERSIONS = tuple(f"version_{name}" for name in ("python", *PACKAGES))
PROVENANCE = ("git_commit", "git_dirty", *MACHINE, *VERSIONS)
TREE = {
    "False": "clean",
    "True": "with uncommitted changes",
}  # git_dirty; what git does not track is left out


def log_text(study: StudyFolder) -> str:
    """Sentence on the file, the signals and the sampling time of the best run's log; empty for
    simulated data."""
    data = logged_data(study)
    if not data:
        return ""
    parts = [str(data["path"])]
    if data.get("input") and data.get("output"):
        parts.append(f"{data['input']} to {data['output']}")
    if data.get("step_s"):
        parts.append(step_words(float(data["step_s"])))
    return f"Log: {', '.join(parts)}. "


def logged_data(study: StudyFolder) -> dict[str, Any]:
    """Settings of the data of the best run if it read a log, else none."""
    data = {} if study.best_run is None else study.best_run.config.get("data") or {}
    return data if data.get("path") else {}


def configuration_text(study: StudyFolder) -> str:
    """Configuration of the best run as text, empty if it left none. A log has neither the plant
    nor the excitation of the default configuration."""
    if study.best_run is None:
        return ""
    config = study.best_run.path / ".hydra" / "config.yaml"
    text = config.read_text() if config.is_file() else ""
    if not logged_data(study):
        return text
    return re.sub(r"^(?:plant|excitation):.*\n(?: +.*\n)*", "", text, flags=re.MULTILINE)


def provenance_lines(study: StudyFolder, table: pd.DataFrame) -> list[tuple[str, str]]:
    """Lines on where the runs were computed, with several values where the runs disagree."""
    facts = []
    for name in PROVENANCE:
        if name not in table:
            continue
        words = {TREE.get(value, value) for value in text_column(table, name)}
        values = sorted(words - {""})
        if values:
            title = name.replace("git_dirty", "working tree").replace("_", " ")
            facts.append((title, " or ".join(values)))
    if len(table):
        best = text_column(table, "run").iloc[0]
        folder, run = run_address(study, best)
        command = f"ssm-study verify results/{folder}/{run}"
        facts.append(("to check the best run", command))
    return facts


def run_address(study: StudyFolder, name: str) -> tuple[str, str]:
    """Study folder and run folder of a run, which may belong to another study."""
    other = re.match(r"\.\./([^/]+)/", name)
    folder = other[1] if other else study.folder.resolve().name
    return folder, name.rpartition("/")[2]
