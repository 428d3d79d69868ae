"""Settings of a run as plain containers, their canonical text, and names that are derived from that
text.

A stage is called by the SHA-256 of all that its result depends on, a run by that of its
configuration: so every launcher, today and tomorrow, finds it in the same folder.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Set
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

from ssm_study.refusal import BadRequest, require

LONGEST_WORD = 24  # characters of a setting in a run's name
NAME_DIGITS = 10  # hexadecimal, of the hash in a run's name
# Where a run is kept and how it is watched is no part of what it is.
NOT_IDENTITY = frozenset(
    {"hydra", "results_dir", "study", "run", "progress", "dry_run", "retry_failed", "strict"}
)


class Settings(dict[str, Any]):
    """Read-only dictionary of settings whose entries can also be read as attributes.
    `settings.seed` is `settings["seed"]`, at any depth."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


def target_names(node: Any) -> frozenset[str]:
    """Names of all classes that nested settings name by `_target_`."""
    return frozenset(str(value) for _, key, value in walk_nodes(node) if key == "_target_")


def as_settings(value: Any) -> Any:
    """Copy of nested plain containers in which every dictionary is replaced by a `Settings`."""
    if isinstance(value, list):
        return [as_settings(item) for item in value]
    if isinstance(value, Settings) or not isinstance(value, dict):
        return value
    return Settings({str(key): as_settings(item) for key, item in value.items()})


def plain_settings(
    config: DictConfig | Settings, without: Set[str] = frozenset({"hydra"})
) -> Settings:
    """Convert a configuration to plain settings, with interpolations resolved and given sections
    left out."""
    if isinstance(config, Settings):
        if without.isdisjoint(config):
            return config
        return Settings({name: config[name] for name in config if name not in without})
    names = [str(key) for key in config if str(key) not in without]
    return Settings({name: as_settings(resolve_node(config[name])) for name in names})


def resolve_node(node: Any) -> Any:
    """Convert a node of a configuration to plain containers, with interpolations resolved; any
    other value is returned unchanged."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def walk_nodes(tree: Any, prefix: str = "") -> Iterator[tuple[str, str, Any]]:
    """Iterate over the dotted path, the last key and the value of every entry in nested containers,
    outer entries first."""
    children: Iterable[tuple[Any, Any]] = ()
    if isinstance(tree, dict):
        children = tree.items()
    elif isinstance(tree, list):
        children = enumerate(tree)
    for key, value in children:
        yield f"{prefix}{key}", str(key), value
        yield from walk_nodes(value, f"{prefix}{key}.")


def refuse_nonfinite_settings(tree: Any) -> None:
    """Raise `BadRequest` for NaN and infinity among the settings of a run."""
    for path, _, value in walk_nodes(tree):
        is_finite = not isinstance(value, float) or math.isfinite(value)
        remedy = "leave it out, or give a finite value"
        require(is_finite, path, value, "is not a finite number", remedy)


def canonical_json(value: Any) -> str:
    """Canonical JSON text of plain containers, which is equal for equal values. Keys are sorted,
    there are no spaces, `1.0` and `1` are alike.

    Raises `BadRequest` for NaN, infinity and anything that is no plain container.
    """
    try:
        return json.dumps(
            _canonical_settings(value), sort_keys=True, separators=(",", ":"), allow_nan=False
        )
    except (TypeError, ValueError) as error:
        remedy = "use finite numbers, text or lists"
        raise BadRequest("config", value, str(error), remedy) from error


def _canonical_settings(value: Any) -> Any:
    """Copy of nested settings with whole floats as integers and tuples as lists."""
    if isinstance(value, Mapping):
        return {str(key): _canonical_settings(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical_settings(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def digest_of_value(value: Any) -> str:
    """SHA-256 digest of the canonical JSON text of a value, as 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def run_name(config: DictConfig | Settings, *labelled_paths: str) -> str:
    """Name of a run: selected settings, followed by ten digits of a hash of all settings.

    `labelled_paths` are pairs `word:key`, e.g. `width:model.hidden_width`; a key that is not there
    is left out, and so is a part of the settings that is null: it adds nothing to what a run is.
    Ten hexadecimal digits: among 10,000 runs two share a name with probability 5e-5.
    """
    settings = plain_settings(config, NOT_IDENTITY)
    identity = {key: value for key, value in settings.items() if value is not None}
    words = []
    for pair in labelled_paths:
        word, _, path = pair.partition(":")
        value = value_at_path(identity, path)
        if isinstance(value, int | float | str):
            words.append(run_name_part(word, value))
    return "-".join([*words, digest_of_value(identity)[:NAME_DIGITS]])


def run_name_part(label: str, value: int | float | str) -> str:
    """Part of a run's name that states the value of a setting, such as `seed0`."""
    return re.sub(r"[^A-Za-z0-9.]+", "_", f"{label}{value}")[:LONGEST_WORD]


def value_at_path(settings: Any, path: str) -> Any:
    """Value at a dotted path of the settings; None if there is no such entry."""
    for word in path.split("."):
        settings = settings.get(word) if isinstance(settings, Mapping) else None
    return settings


class _QuotingDumper(yaml.CSafeDumper):
    """Fast YAML writer that quotes texts which OmegaConf, unlike YAML, would read as a number
    (`1e5`, `nan`)."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        """Tell PyYAML to write repeated objects in full, without aliases."""
        return True


def _represent_text(dumper: yaml.CSafeDumper, text: str) -> yaml.ScalarNode:
    """Represent a text in YAML, in quotes where OmegaConf would read it as a number."""
    try:
        float(text)
    except ValueError:
        return dumper.represent_scalar("tag:yaml.org,2002:str", text)
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="'")


_QuotingDumper.add_representer(str, _represent_text)
_QuotingDumper.add_representer(Settings, yaml.CSafeDumper.represent_dict)


def yaml_text(value: Any) -> str:
    """Text in YAML from which `OmegaConf.load` reads the same plain containers. It is written five
    times as fast as by OmegaConf."""
    return str(yaml.dump(value, Dumper=_QuotingDumper, sort_keys=False, allow_unicode=True))


# Makes `${run_name:word:key,...}` usable in configurations.
OmegaConf.register_new_resolver(
    "run_name", lambda *shown, _root_: run_name(_root_, *shown), replace=True, use_cache=False
)
