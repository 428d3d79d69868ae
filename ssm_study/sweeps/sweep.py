"""The jobs of a sweep, composed and checked before any of them starts."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from ssm_study.refusal import BadRequest
from ssm_study.results.allow_list import refuse_foreign_targets
from ssm_study.results.runs import Outcome, run_folder
from ssm_study.sweeps.compose import Composer
from ssm_study.sweeps.server import Child


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What Hydra hands to a launcher."""

    hydra_context: HydraContext
    task_function: TaskFunction
    config: DictConfig


@dataclass(kw_only=True)
class Job:
    """One configuration of the sweep and, once started, its process.

    One with `members` is no run: it trains their `models` (several runs may need the same) before they start.
    """

    overrides: list[str]
    config: DictConfig
    folder: Path
    outcome: Outcome | None = None
    process: Child | None = None
    started: float = field(default=0.0)
    members: tuple["Job", ...] = ()
    models: int = 1
    checked: Any = None

    @property
    def name(self) -> str:
        return self.folder.name

    def returned(self, outcome: Outcome | None) -> JobReturn:
        """The outcome as Hydra wants it."""
        ended = JobReturn(self.overrides, self.config, working_dir=str(Path.cwd()), task_name=self.name)
        ended.status, ended.return_value = JobStatus.COMPLETED, outcome
        return ended


def jobs_of(loader: ConfigLoader, config: DictConfig, overrides: Sequence[list[str]], first_number: int) -> list[Job]:
    """Every configuration of the sweep that `config` describes, numbered as Hydra numbers them; see `job_of`."""
    composer = Composer(loader, config)
    return [job_of(composer, words, number) for number, words in enumerate(overrides, first_number)]


def job_of(composer: Composer, overrides: list[str], number: int) -> Job:
    """The configuration of one job and the folder it names; raises `BadRequest` if that leaves the results folder."""
    config = composer.compose(overrides)
    with open_dict(config):
        config.hydra.job.id = number
        config.hydra.job.num = number
    adopt(config)
    folder = Path(str(config.hydra.sweep.dir)) / str(config.hydra.sweep.subdir)
    run_folder(folder.parent.parent, folder.parent.name, folder.name)
    return Job(overrides=overrides, config=config, folder=folder.absolute())


def adopt(config: DictConfig) -> None:
    """`${hydra:...}` is read from this; Hydra's own `set_config` copies its whole section first (5 ms)."""
    HydraConfig.instance().cfg = config  # type: ignore[assignment]  # Hydra's type is that of the section alone


def check_all(task_function: TaskFunction, jobs: list[Job]) -> None:
    """The allow-list and `check(configuration)` of the task's module on every job, before any starts.

    What `check` returns, or else the configuration, is what the further hooks get (`Job.checked`). The `BadRequest`
    names the job.
    """
    check = task_hook(task_function, "check")
    for job in jobs:
        try:
            adopt(job.config)
            refuse_foreign_targets(job.config)
            checked = check(job.config) if check is not None else None
            job.checked = job.config if checked is None else checked
        except BadRequest as refusal:
            where = f"{refusal.field} (of the run {' '.join(job.overrides)})"
            raise BadRequest(where, refusal.value, refusal.problem, refusal.remedy) from refusal


def task_hook(task_function: TaskFunction, name: str) -> Any:
    """The function `name` in the module of the task, or None."""
    return getattr(sys.modules[task_function.__module__], name, None)
