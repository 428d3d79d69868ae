"""Command-line program that is made from a task: Hydra's overrides, and `-m` for sweeps."""

from collections.abc import Mapping
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore

from ssm_study.engine.task import Task

COMMON = {
    "study": "study",
    "results_dir": "results",
    "run": "${run_name:seed:seed}",
    "retry_failed": False,
}
CHOICES = {
    "launcher": "processes",
    "sweeper": "grid",
    "job_logging": "none",
    "hydra_logging": "none",
}
FOLDERS = {
    "output_subdir": None,
    "run": {"dir": "${results_dir}/${study}/${run}"},
    "sweep": {"dir": "${results_dir}/${study}", "subdir": "${run}"},
}


def main(task: Task[Any], settings: Mapping[str, Any]) -> None:
    """Run a task with its settings, changed by the overrides on the command line; all options of
    Hydra can be used."""
    choices = [{f"override hydra/{group}": choice} for group, choice in CHOICES.items()]
    defaults = {"defaults": ["_self_", *choices]}
    node = defaults | COMMON | {"dry_run": False} | dict(settings) | {"hydra": FOLDERS}
    ConfigStore.instance().store(name="task", node=node)
    hydra.main(version_base="1.3", config_path=None, config_name="task")(task.run_job)()
