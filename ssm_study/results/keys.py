"""What a stage or a run is called: the SHA-256 of everything its result depends on."""

import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from ssm_study.refusal import BadRequest

PACKAGE = "ssm_study"


def canonical_json(value: Any) -> str:
    """One text for one meaning: sorted keys, no spaces, `1.0` and `1` alike, arrays as lists, paths as text.

    Takes plain containers, OmegaConf nodes (resolved), dataclasses (with their class name), NumPy values and paths.
    Raises `BadRequest` for NaN, infinity and anything without a canonical text.
    """
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def digest(value: Any) -> str:
    """SHA-256 of `canonical_json(value)`, 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def stage_key(name: str, config: Any, upstream: tuple[str, ...] | list[str], code_version: str) -> str:
    """`sha256(name, config, upstream keys, code version)`: equal keys, equal results."""
    return digest({"stage": name, "config": config, "upstream": list(upstream), "code_version": code_version})


def code_version(*rooms: str | ModuleType) -> str:
    """SHA-256 over the sources of `rooms`, so that editing a room invalidates its own stages and no others.

    A room is a name inside the package (`"plants"`, `"signals"`, `"training.identify"`), a dotted module name, a
    module, or an installed distribution (`"torch"`), which counts with its version.
    """
    names = sorted({room.__name__ if isinstance(room, ModuleType) else room for room in rooms})
    return hashlib.sha256("\n".join(f"{name} {_room_digest(name)}" for name in names).encode()).hexdigest()


@cache
def _room_digest(name: str) -> str:
    folder_or_file = _source_of(name)
    if folder_or_file is None:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            raise BadRequest("room", name, "neither a room, a module nor a distribution", "correct the name") from None
    files = sorted(folder_or_file.rglob("*.py")) if folder_or_file.is_dir() else [folder_or_file]
    whole = hashlib.sha256()
    for file in files:
        whole.update(f"{file.relative_to(folder_or_file.parent).as_posix()}\n".encode())
        whole.update(hashlib.sha256(file.read_bytes()).digest())
    return whole.hexdigest()


def _source_of(name: str) -> Path | None:
    """The folder or file of a room, found without importing more than its parents; None if it is no source module."""
    for candidate in (f"{PACKAGE}.{name}", name):
        if candidate.split(".")[0] != PACKAGE and "." not in candidate and _is_distribution(candidate):
            return None
        try:
            spec = importlib.util.find_spec(candidate)
        except (ImportError, ValueError):
            continue
        if spec is not None and spec.origin and spec.origin.endswith(".py"):
            origin = Path(spec.origin)
            return origin.parent if origin.name == "__init__.py" else origin
    return None


def _is_distribution(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, (int, float)):
        return _plain_number(value)
    if OmegaConf.is_config(value):
        return _plain(OmegaConf.to_container(value, resolve=True))
    if is_dataclass(value) and not isinstance(value, type):
        return {"_target_": type(value).__qualname__} | {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return value.as_posix()
    raise BadRequest("config", value, f"a {type(value).__name__} has no canonical text", "use numbers, text or lists")


def _plain_number(value: int | float) -> int | float:
    if isinstance(value, float) and not math.isfinite(value):
        raise BadRequest("config", value, "not a finite number", "leave the field out or give a finite value")
    return int(value) if value == int(value) else value
