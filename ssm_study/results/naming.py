"""A run is named by its configuration, so that every launcher, today and tomorrow, finds it in the same folder."""

import re
from collections.abc import Mapping, Set
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

from ssm_study.results.keys import digest

# Where a run is kept and how it is watched is no part of what it is.
NOT_IDENTITY = frozenset({"hydra", "results_dir", "study", "store_dir", "progress", "dry_run", "retry_failed"})
PREFIX = (("order", "model.order"), ("width", "model.hidden_width"), ("seed", "seed"))
RESOLVER = "run_name"


def identity(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration without what does not change the result: what the run's name is the hash of."""
    raw = OmegaConf.to_container(config, resolve=False)
    assert isinstance(raw, dict)
    named = {str(key) for key, value in raw.items() if f"${{{RESOLVER}:" in str(value)}
    return plain(config, NOT_IDENTITY | named)


def plain(config: DictConfig, without: Set[str] = frozenset({"hydra"})) -> dict[str, Any]:
    """The configuration as plain containers with its interpolations resolved, some keys left out."""
    return {str(key): _resolved(config[key]) for key in config if str(key) not in without}


def run_name(config: DictConfig | Mapping[str, Any]) -> str:
    """`order8-width32-seed0-1a2b3c4d5e`: what a reader looks for first, then ten digits of the hash of `identity`.

    Ten hexadecimal digits: among 10,000 runs two share a name with probability 5e-5.
    """
    parts = identity(config if isinstance(config, DictConfig) else OmegaConf.create(dict(config)))
    shown = [f"{word}{value}" for word, path in PREFIX if (value := _select(parts, path)) is not None]
    return "-".join([re.sub(r"[^A-Za-z0-9.]+", "_", part)[:24] for part in shown] + [digest(parts)[:10]])


class _Dumper(yaml.CSafeDumper):
    """PyYAML's fast one; quotes what OmegaConf, unlike YAML, would read as a number (`1e5`, `nan`)."""


def _represent_text(dumper: yaml.CSafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="'" if _reads_as_number(text) else None)


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


_Dumper.add_representer(str, _represent_text)


def yaml_text(value: Any) -> str:
    """Plain containers as YAML that `OmegaConf.load` reads back to the same; five times as fast as its own."""
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True))


def register_resolver() -> None:
    """Make `${run_name:}` usable in `hydra.run.dir` and `hydra.sweep.subdir`; harmless when repeated."""
    OmegaConf.register_new_resolver(RESOLVER, lambda *, _root_: run_name(_root_), replace=True, use_cache=False)


def _resolved(value: Any) -> Any:
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def _select(parts: Mapping[str, Any], path: str) -> Any:
    value: Any = parts
    for word in path.split("."):
        value = value.get(word) if isinstance(value, Mapping) else None
    return value if isinstance(value, (int, float, str)) else None


register_resolver()
