"""Composition of configurations by Hydra, once for a request and for all jobs of a sweep. Only this
file uses Hydra's private names.

Hydra composes a request three times, and reads every file again for each job of a sweep: a quarter
of a second each. Here the request is composed once, and so are all jobs that differ in plain values
only (`model.order=8`): those are put into copies. A test compares both with Hydra's own.
"""

import re
from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl, get_overrides_dirname
from hydra._internal.config_repository import IConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.core.utils import configure_log
from hydra.types import RunMode, TaskFunction
from omegaconf import AnyNode, DictConfig, OmegaConf, open_dict

from ssm_study.engine.settings import (
    Settings,
    as_settings,
    plain_settings,
    refuse_nonfinite_settings,
    run_name,
)

GRIDS = (
    "hydra_plugins.ssm_study_launcher.GridSweeper",
    "hydra._internal.core_plugins.basic_sweeper.BasicSweeper",
)
NAME = re.compile(r"\$\{run_name:([^${}]*)\}")


class FastConfigurationLoader(ConfigLoaderImpl):
    """Hydra's configuration loader with a faster listing of the choices in a configuration group.
    It does not copy the files that it has read (`--help` lists a hundred groups)."""

    defaults: Mapping[str, Any] = MappingProxyType({})  # by group, to be marked

    def get_group_options(
        self,
        group_name: str,
        results_filter: ObjectType | None = ObjectType.CONFIG,
        config_name: str | None = None,
        overrides: list[str] | None = None,
    ) -> list[str]:
        """Names of the choices of a configuration group, the default one marked by a star."""
        del config_name, overrides
        options = self.repository.get_group_options(group_name, results_filter)
        default = self.defaults.get(group_name)
        return [f"{option}*" if option == default else option for option in options]


class HydraCommandLine(Hydra):
    """Command line of a Hydra application whose configuration files lie in one folder. It does with
    the arguments what `hydra.main` does.

    `config` is composed when first needed, and is what `execute` then runs: it can be checked
    before Hydra makes the callbacks, the launcher and the sweeper that it names.
    """

    def __init__(self, arguments: list[str], folder: Path, name: str) -> None:
        version.setbase("1.3")
        self.asked: Namespace = get_args_parser().parse_args(arguments)
        self.name = self.asked.config_name or name
        place = Path(self.asked.config_path).absolute() if self.asked.config_path else folder
        search_path = create_config_search_path(str(place))
        if self.asked.config_dir is not None:
            address = f"file://{Path(self.asked.config_dir).absolute()}"
            search_path.prepend(provider="command-line", path=address)
        super().__init__(
            task_name=name, config_loader=FastConfigurationLoader(config_search_path=search_path)
        )
        GlobalHydra.instance().clear()
        GlobalHydra.instance().initialize(self)

    @cached_property
    def config(self) -> DictConfig:
        """Composed configuration that the command line requests. Raises Hydra's error for a request
        that cannot be composed."""
        mode = RunMode.MULTIRUN if self.asked.multirun else RunMode.RUN
        words = list(self.asked.overrides)
        if not any(word.startswith("hydra.mode=") for word in words):
            words.append(f"hydra.mode={mode.name}")
        config = self.config_loader.load_configuration(self.name, words, run_mode=mode)
        set_hydra_config(config)
        return config

    def print_help(self) -> None:
        """Print the help of the command line, with the default choices marked by a star."""
        assert isinstance(self.config_loader, FastConfigurationLoader)
        self.config_loader.defaults = dict(self.config.hydra.runtime.choices)
        self.app_help(self.name, get_args_parser(), self.asked)

    @property
    def is_sweep(self) -> bool:
        """Whether the command line requests a sweep, that is, several jobs with different
        settings."""
        return bool(self.config.hydra.mode == RunMode.MULTIRUN)

    def execute(self, task: TaskFunction) -> None:
        """Run a task once, or once for every job of a sweep."""
        run = self.multirun if self.is_sweep else self.run
        run(self.name, task, self.asked.overrides)

    def compose_config(self, *asked: Any, **further: Any) -> DictConfig:
        """Return the stored configuration instead of letting Hydra compose the same one again."""
        if self.asked.help:
            return super().compose_config(*asked, **further)
        if further.get("with_log_configuration"):
            configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        return self.config


def set_hydra_config(config: DictConfig) -> None:
    """Set the configuration from which Hydra resolves interpolations such as `${hydra:job.num}`.
    Hydra's own `set_config` would first copy its whole section (5 ms)."""
    HydraConfig.instance().cfg = config  # type: ignore[assignment]  # Hydra's type is that of the section alone


def clear_hydra_state() -> None:
    """Clear Hydra's global state, so that a program may compose another request afterwards."""
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None


def grid_combinations(config: DictConfig) -> list[list[str]]:
    """Override lists of all jobs of a grid sweep, such as `[[a=1, b=3], [a=2, b=3]]` for `a=1,2
    b=3`. Empty for a search, which chooses its values while it runs."""
    if config.hydra.sweeper._target_ not in GRIDS:
        return []
    words = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    loader = GlobalHydra.instance().config_loader()
    overrides = OverridesParser.create(config_loader=loader).parse_overrides(words)  # type: ignore[arg-type]
    return BasicSweeper.split_arguments(overrides, max_batch_size=None)[0]


@dataclass
class SharedConfiguration:
    """Composed configuration that jobs of a sweep share, and in which each job then sets its own
    values."""

    config: DictConfig
    held: dict[str, bool] = field(default_factory=dict)
    sections: dict[tuple[Any, ...], Any] = field(default_factory=dict)

    @cached_property
    def settings_tree(self) -> Settings:
        """Composed configuration as plain containers, with interpolations left unresolved and
        without Hydra's own section."""
        tree = OmegaConf.to_container(self.config, resolve=False)
        assert isinstance(tree, dict)
        return Settings(
            {str(key): as_settings(value) for key, value in tree.items() if key != "hydra"}
        )

    @cached_property
    def settings_in_run_name(self) -> tuple[str, ...] | None:
        """Settings that appear in the name of a run; None if the name has interpolations that only
        OmegaConf can resolve, which is slow."""
        interpolation = NAME.fullmatch(str(self.settings_tree.get("run", "")))
        others = [value for key, value in self.settings_tree.items() if key != "run"]
        if interpolation is None or any("${" in str(value) for value in others):
            return None
        return tuple(word.strip() for word in interpolation[1].split(","))

    def is_untyped(self, path: str) -> bool:
        """Whether the value at a dotted path of a configuration has no declared type, so that it
        may be replaced directly."""
        if path not in self.held:
            node: Any = self.config
            for word in path.split("."):
                has_children = isinstance(node, DictConfig) and not node._is_none()
                node = node._get_node(word) if has_children else None
            self.held[path] = type(node) is AnyNode
        return self.held[path]

    def job_settings(self, values: dict[str, Any]) -> Settings:
        """Settings of one job of a sweep, made by putting the job's values into the shared
        configuration. Unchanged sections are shared between jobs."""
        assert self.settings_in_run_name is not None
        settings = Settings(self.settings_tree)
        by_section: dict[str, dict[str, Any]] = {}
        for path, value in values.items():
            section, _, inner_path = path.partition(".")
            by_section.setdefault(section, {})[inner_path] = value
        for section, inner_values in by_section.items():
            settings[section] = self.job_section(section, inner_values)
        if "run" in values:
            return settings
        return Settings(settings | {"run": run_name(settings, *self.settings_in_run_name)})

    def job_section(self, name: str, values: dict[str, Any]) -> Any:
        """One section of the settings of a job, with the values that only this job has."""
        typed = [(path, type(value), value) for path, value in values.items()]
        key = (name, *typed)
        if key not in self.sections:
            section = self.settings_tree[name]
            for path, value in values.items():
                section = replace_at_path(section, path.split(".") if path else [], value)
            self.sections[key] = as_settings(section)
        return self.sections[key]


def replace_at_path(tree: Any, path: list[str], value: Any) -> Any:
    """Copy of a nested dictionary with the value at one dotted path replaced."""
    if not path:
        return value
    first, *rest = path
    return {**tree, first: replace_at_path(tree[first], rest, value)}


class Composer:
    """Composer of the configurations of a sweep's jobs, which reads the configuration files only
    once. It gives what Hydra's `load_sweep_config` gives.

    `check_configuration` is called for every composition.
    """

    def __init__(
        self,
        loader: ConfigLoader,
        sweep: DictConfig,
        check_configuration: Callable[[DictConfig], None],
    ) -> None:
        assert isinstance(loader, ConfigLoaderImpl)
        self.loader = loader
        self.sweep = sweep
        self.refuse = check_configuration
        self.parser = OverridesParser.create(config_loader=loader)
        # Every word, and whether it is a plain value.
        self.parsed: dict[str, tuple[Override, bool]] = {}
        self.composed: dict[tuple[str, ...], SharedConfiguration] = {}

    def compose_configuration(self, overrides: list[str], number: int | None = None) -> DictConfig:
        """Compose the whole configuration of one job of a sweep, including Hydra's section. The
        next call may return the same object with other values."""
        chosen, values = self._split_overrides(overrides)
        config = chosen.config
        parsed = [self._parse_override(word)[0] for word in overrides]
        ConfigLoaderImpl._apply_overrides_to_config(values, config)
        naming = config.hydra.job.config.override_dirname
        with open_dict(config):
            config.hydra.overrides.task = list(overrides)
            config.hydra.job.override_dirname = get_overrides_dirname(
                overrides=parsed,
                kv_sep=naming.kv_sep,
                item_sep=naming.item_sep,
                exclude_keys=naming.exclude_keys,
            )
            if number is not None:
                config.hydra.job.id = number
                config.hydra.job.num = number
        OmegaConf.copy_cache(from_config=self.sweep, to_config=config)
        return config

    def compose_settings(self, overrides: list[str], number: int) -> Settings:
        """Compose the settings of one job of a sweep, without Hydra's section. A value that
        OmegaConf has to resolve costs ten times as much."""
        chosen, values = self._split_overrides(overrides)
        if chosen.settings_in_run_name is not None:
            by_path = {str(override.key_or_group): override.value() for override in values}
            return chosen.job_settings(by_path)
        config = self.compose_configuration(overrides, number)
        set_hydra_config(config)
        return plain_settings(config)

    def _split_overrides(self, overrides: list[str]) -> tuple[SharedConfiguration, list[Override]]:
        """Split the overrides of a job into a configuration shared with other jobs and the job's
        own plain values."""
        parsed = [self._parse_override(word) for word in overrides]
        chosen = self._shared_composition(parsed)
        marked = []
        for override, is_plain in parsed:
            is_own = is_plain and chosen.is_untyped(str(override.key_or_group))
            marked.append((override, is_own))
        if marked != parsed:
            chosen = self._shared_composition(marked)
        return chosen, [override for override, is_own in marked if is_own]

    def _shared_composition(self, parsed: list[tuple[Override, bool]]) -> SharedConfiguration:
        """Configuration composed from parsed overrides that several jobs share, loaded when it is
        first needed."""
        choices = [str(override.input_line) for override, is_plain in parsed if not is_plain]
        # The paths, too: values are put into the composition itself, so all its jobs must give the
        # same.
        paths = [str(override.key_or_group) for override, is_plain in parsed if is_plain]
        key = (*choices, "", *paths)
        if key not in self.composed:
            config = self.loader.load_sweep_config(self.sweep, choices)
            self.refuse(config)
            self.composed[key] = SharedConfiguration(config)
        return self.composed[key]

    def _parse_override(self, word: str) -> tuple[Override, bool]:
        """Parse one command-line override, and say whether the override only sets a plain value."""
        if word not in self.parsed:
            override = self.parser.parse_override(word)
            refuse_nonfinite_settings({str(override.key_or_group): override.value()})
            self.parsed[word] = override, sets_plain_value(override, self.loader.repository)
        return self.parsed[word]


def sets_plain_value(override: Override, repository: IConfigRepository) -> bool:
    """Whether a command-line override only sets a plain value, such as `a.b=1`. Such an override
    chooses no group, adds, deletes, interpolates and instantiates nothing, and changes nothing of
    Hydra's own."""
    path = str(override.key_or_group)
    value = override.value()
    if override.type is not OverrideType.CHANGE or override.package is not None:
        return False
    if override.is_hydra_override() or path.endswith("_target_") or repository.group_exists(path):
        return False
    if value is None:
        return True
    return isinstance(value, bool | int | float | str) and "$" not in str(value)
