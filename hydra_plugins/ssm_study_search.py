"""Makes `hydra/sweeper=search` known to Hydra (extra `search`); read at each start, so nothing heavy."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


@dataclass
class SearchConf:
    _target_: str = "hydra_plugins.ssm_study_search.SearchSweeper"
    trials: int = 50  # in total: the same command goes on where it was stopped
    maximise: list[str] = field(default_factory=list)
    minimise: list[str] = field(default_factory=list)
    at_once: int = 2  # asked for before the first of them is answered
    seed: int = 0
    params: dict[str, str] = field(default_factory=dict)


ConfigStore.instance().store(group="hydra/sweeper", name="search", node=SearchConf, provider="ssm-study")


class SearchSweeper(Sweeper):
    """Optuna asks for configurations, the launcher runs them, their records answer."""

    hydra_context: HydraContext
    config: DictConfig
    launcher: Launcher

    def __init__(
        self, trials: int, maximise: list[str], minimise: list[str], at_once: int, seed: int, params: dict[str, str]
    ) -> None:
        self.trials, self.maximise, self.minimise = trials, tuple(maximise), tuple(minimise)
        self.at_once, self.seed, self.params = at_once, seed, dict(params)

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from hydra.core.plugins import Plugins

        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        from ssm_study.sweeps.search import Search

        words = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        parsed = OverridesParser.create(config_loader=self.hydra_context.config_loader).parse_overrides(words)
        space = {override.get_key_element(): override for override in parsed if override.is_sweep_override()}
        fixed = [str(override.input_line) for override in parsed if not override.is_sweep_override()]
        search = Search(
            study=Path(str(self.config.hydra.sweep.dir)),
            trials=self.trials,
            maximise=self.maximise,
            minimise=self.minimise,
            seed=self.seed,
            at_once=self.at_once,
        )
        return search.run(space, fixed, self._answer)

    def _answer(self, jobs: list[list[str]]) -> list[Mapping[str, Any] | None]:
        from ssm_study.results.records import read_record
        from ssm_study.sweeps.sweep import jobs_of

        self.launcher.launch(jobs, initial_job_idx=0)
        asked = jobs_of(self.hydra_context.config_loader, self.config, jobs, 0)
        return [read_record(job.folder) for job in asked]
