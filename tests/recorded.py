"""Results as an earlier commit computed them, in `tests/recorded`: every change of one is seen.

After a change that is meant, `RECORD=1 pytest` of the test writes them anew; the difference of the
files says what has changed.
"""

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

FOLDER = Path(__file__).with_name("recorded")
OF_ONE_RUN = ("seconds", "digest")
LONGEST = 8  # rows of numbers that are recorded one by one
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
RELATIVE = 1e-5  # solvers and libraries of linear algebra differ by less


def assert_as_recorded(name: str, result: object, relative: float = RELATIVE) -> None:
    """The result is the recorded one: words exactly, numbers within `relative` of their size."""
    measured = json.loads(json.dumps(plain_value(result), sort_keys=True))
    path = FOLDER / f"{name}.json"
    if "RECORD" in os.environ:
        FOLDER.mkdir(exist_ok=True)
        text = json.dumps(measured, indent=0, sort_keys=True, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")
    recorded = json.loads(path.read_text(encoding="utf-8"))
    changes = list(differences(recorded, measured, relative))
    assert not changes, f"RECORD=1 if this is meant: {changes[:5]}"


def is_recorded(name: str) -> bool:
    """Whether a result of that name is recorded; a part that somebody adds may have none."""
    return (FOLDER / f"{name}.json").exists() or "RECORD" in os.environ


def plain_value(value: Any) -> Any:
    """Values of JSON; long rows of numbers are reduced to a few sums."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
        return plain_value(named)
    if isinstance(value, Mapping):
        named = {str(key): entry for key, entry in value.items()}
        same = [key for key in named if not key.endswith(OF_ONE_RUN)]
        return {key: plain_value(named[key]) for key in same}
    if isinstance(value, pd.DataFrame):
        return plain_value(value.to_dict("list"))
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, (list, tuple)):
        return reduced_numbers(value) or [plain_value(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return reduced_array(value)
    if isinstance(value, np.generic):
        return plain_value(value.item())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    is_plain = value is None or isinstance(value, (bool, int, float, str))
    return value if is_plain else type(value).__name__


def reduced_numbers(values: Any) -> Any:
    """Sums of a long row of numbers; None for any other row."""
    is_long = len(values) > LONGEST
    if is_long and all(isinstance(value, (int, float)) for value in values):
        return reduced_array(np.array(values, dtype=float))
    return None


def reduced_array(values: np.ndarray) -> Any:
    """Shape, size, sum and weighted sum of an array: each entry changes one of them."""
    if values.size <= LONGEST or values.dtype.kind not in "biufc":
        return plain_value(values.tolist())
    flat = values.astype(complex).ravel()
    finite = np.where(np.isfinite(flat), flat, 0)
    weights = np.cos(np.arange(flat.size) ** 1.1)
    sums = {"sum": finite.sum(), "weighted": finite @ weights, "size": np.linalg.norm(finite)}
    reduced = {name: complex(number).real for name, number in sums.items()}
    reduced["imaginary"] = float((finite @ weights).imag)
    missing = int(flat.size - np.isfinite(flat).sum())
    return {"shape": list(values.shape), "missing": missing, **reduced}


def differences(before: Any, now: Any, relative: float, where: str = "") -> Iterator[str]:
    """Places at which two values differ."""
    if isinstance(before, dict) and isinstance(now, dict) and before.keys() == now.keys():
        scale = before.get("size", 0.0) if "weighted" in before else 0.0
        for key in before:
            if scale and isinstance(before[key], float):
                slack = relative * scale * before["shape"][0] ** 0.5
                if abs(before[key] - now[key]) > slack:
                    yield f"{where}/{key}: {before[key]} is {now[key]}"
            else:
                yield from differences(before[key], now[key], relative, f"{where}/{key}")
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for i, (old, new) in enumerate(zip(before, now, strict=True)):
            yield from differences(old, new, relative, f"{where}/{i}")
    elif not is_same(before, now, relative):
        yield f"{where}: {before} is {now}"


def is_same(before: Any, now: Any, relative: float) -> bool:
    """Whether two values are equal, their numbers nearly."""
    if isinstance(before, str) and isinstance(now, str):
        old = list(map(float, NUMBER.findall(before)))
        new = list(map(float, NUMBER.findall(now)))
        words = NUMBER.split(before) == NUMBER.split(now)
        return words and np.allclose(old, new, rtol=relative, atol=1e-12)
    if type(before) in (int, float) and type(now) in (int, float):
        return math.isclose(before, now, rel_tol=relative, abs_tol=1e-12)
    return bool(before == now)
