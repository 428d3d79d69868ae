"""Composing a thousand configurations: members of a sweep that differ in plain values share one composition."""

import copy

from hydra._internal.config_loader_impl import ConfigLoaderImpl, get_overrides_dirname
from hydra._internal.config_repository import IConfigRepository
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf, open_dict


class Composer:
    """`compose(overrides)` is Hydra's `load_sweep_config(sweep, overrides)`, about ten times faster over a sweep.

    Hydra reads every file of every choice again for each job. But plain values (`model.order=8`) are applied after the
    composition, by one function: so the choices are composed once, copied, and the values applied by that function.
    A test holds both against each other.
    """

    def __init__(self, loader: ConfigLoader, sweep: DictConfig) -> None:
        assert isinstance(loader, ConfigLoaderImpl)
        self.loader, self.sweep = loader, sweep
        self.parser = OverridesParser.create(config_loader=loader)
        self.composed: dict[tuple[str, ...], DictConfig] = {}

    def compose(self, overrides: list[str]) -> DictConfig:
        parsed = self.parser.parse_overrides(overrides)
        values = [override for override in parsed if is_plain_value(override, self.loader.repository)]
        choices = [str(override.input_line) for override in parsed if override not in values]
        config = copy.deepcopy(self._chosen(choices))
        ConfigLoaderImpl._apply_overrides_to_config(values, config)
        with open_dict(config):
            config.hydra.overrides.task = list(overrides)
            naming = config.hydra.job.config.override_dirname
            config.hydra.job.override_dirname = get_overrides_dirname(
                overrides=parsed, kv_sep=naming.kv_sep, item_sep=naming.item_sep, exclude_keys=naming.exclude_keys
            )
        OmegaConf.copy_cache(from_config=self.sweep, to_config=config)
        return config

    def _chosen(self, choices: list[str]) -> DictConfig:
        key = tuple(choices)
        if key not in self.composed:
            self.composed[key] = self.loader.load_sweep_config(self.sweep, choices)
        return self.composed[key]


def is_plain_value(override: Override, repository: IConfigRepository) -> bool:
    """`a.b=1`: no choice of a group, nothing added or deleted, nothing of Hydra's own."""
    key = str(override.key_or_group)
    ours = override.type is OverrideType.CHANGE and not override.is_hydra_override() and override.package is None
    return ours and not override.is_sweep_override() and not repository.group_exists(key)
