"""Where the runs of a report page come from: log, configuration, code and machine."""

import re
from typing import Any

import pandas as pd

from ssm_study.report.page.proof_card import sampling_time_text
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


def log_source_text(study: StudyFolder) -> str:
    """Sentence on the file, signals and sampling time of the log from which the best run was
    made."""
    data = log_data_settings(study)
    if not data:
        return ""
    parts = [str(data["path"])]
    if data.get("input") and data.get("output"):
        parts.append(f"{data['input']} to {data['output']}")
    if data.get("step_s"):
        parts.append(sampling_time_text(float(data["step_s"])))
    return f"Log: {', '.join(parts)}. "


def log_data_settings(study: StudyFolder) -> dict[str, Any]:
    """Data settings of a study's best run if its data come from a log, else none."""
    data = {} if study.best_run is None else study.best_run.config.get("data") or {}
    return data if data.get("path") else {}


def configuration_text(study: StudyFolder) -> str:
    """Configuration of a study's best run as text, empty if the run left none. A log has neither
    the plant nor the excitation of the default configuration."""
    if study.best_run is None:
        return ""
    config = study.best_run.path / ".hydra" / "config.yaml"
    text = config.read_text() if config.is_file() else ""
    if not log_data_settings(study):
        return text
    return re.sub(r"^(?:plant|excitation):.*\n(?: +.*\n)*", "", text, flags=re.MULTILINE)


def provenance_lines(study: StudyFolder, table: pd.DataFrame) -> list[tuple[str, str]]:
    """Text lines on the machine, versions and commit by which the runs of a study were computed."""
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
        folder, run = folder_names_of_run(study, best)
        command = f"ssm-study verify results/{folder}/{run}"
        facts.append(("to check the best run", command))
    return facts


def folder_names_of_run(study: StudyFolder, name: str) -> tuple[str, str]:
    """Names of the study folder and the run folder of a run, which may belong to another study."""
    other = re.match(r"\.\./([^/]+)/", name)
    folder = other[1] if other else study.folder.resolve().name
    return folder, name.rpartition("/")[2]
