"""Makes `hydra/launcher=processes` and `hydra/sweeper=grid` known to Hydra; read at each start, so
nothing heavy."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper, BasicSweeperConf
from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

import ssm_study.engine.settings  # noqa: F401  (registers ${run_name:...} wherever Hydra runs)


@dataclass
class ProcessesConf:
    _target_: str = "hydra_plugins.ssm_study_launcher.ProcessesLauncher"
    n_jobs: int | None = None  # null: as many as the cores allow
    threads: int = 1  # per job; n_jobs * threads may not exceed the cores
    # A job that takes longer is stopped and recorded as failed; null: never.
    timeout_s: float | None = None
    fail_fast: bool = False  # true: after the first failed run none is begun


ConfigStore.instance().store(
    group="hydra/launcher", name="processes", node=ProcessesConf, provider="ssm-study"
)


@dataclass
class GridConf(BasicSweeperConf):
    _target_: str = "hydra_plugins.ssm_study_launcher.GridSweeper"


ConfigStore.instance().store(
    group="hydra/sweeper", name="grid", node=GridConf, provider="ssm-study"
)


class GridSweeper(BasicSweeper):
    """Hydra's own grid, without composing every job once more: the launcher checks them all, or
    `cli/request.py`.

    A sweep that was only planned, or refused, leaves nothing behind.
    """

    def sweep(self, arguments: list[str]) -> Any:
        try:
            return super().sweep(arguments)
        finally:
            assert self.config is not None
            folder = Path(self.config.hydra.sweep.dir)
            if folder.is_dir() and [path.name for path in folder.iterdir()] == ["multirun.yaml"]:
                (folder / "multirun.yaml").unlink()
                folder.rmdir()
                with suppress(OSError):  # the results folder, where it holds nothing else
                    folder.parent.rmdir()

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        del batch


class ProcessesLauncher(Launcher):
    """One fresh process per job, from a server that has imported the heavy libraries already."""

    def __init__(self, **settings: Any) -> None:  # those of `ProcessesConf`
        self.settings = settings

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.hydra_context = hydra_context
        self.task_function = task_function
        self.config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        from ssm_study.engine.launcher import Processes, launch_sweep

        return launch_sweep(
            Processes(**self.settings),
            self,
            [list(words) for words in job_overrides],
            initial_job_idx,
        )
