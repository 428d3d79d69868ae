"""The mismatch between plant and model, as the records show it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.engine.stages import Stage
from ssm_study.robustness.mismatch import Mismatch, View, measure_mismatch
from ssm_study.signals import DataSet
from ssm_study.study.stages.free_run import ModelRun

FILE = "mismatch.json"


def compute_mismatch(folder: Path, data: DataSet, bounded: ModelRun) -> Mismatch:
    """How far the plant is from the model, as the records show it: once for all designs on this
    model."""
    shown = measure_mismatch(
        bounded.model, data.validation, data.start_up_samples, data.mismatch_records
    )
    write_mismatch(folder, shown)
    return shown


def write_mismatch(folder: Path, shown: Mismatch) -> None:
    """Every number as the text that reads back to the same float; a complex one as two."""
    told = json.dumps(
        asdict(shown), default=lambda array: np.ascontiguousarray(array).view(float).tolist()
    )
    (folder / FILE).write_text(told, encoding="utf-8")


def read_mismatch(folder: Path) -> Mismatch:
    """The views at each amplitude, as they were computed."""
    told = json.loads((folder / FILE).read_text(encoding="utf-8"))
    views = tuple(map(_view, told.pop("views")))
    loop = told.pop("loop")
    others: dict[str, Any] = {
        name: tuple(one) if isinstance(one, list) else one for name, one in told.items()
    }
    return Mismatch(views=views, loop=loop and _view(loop), **others)


def _view(told: dict[str, Any]) -> View:
    parts: dict[str, Any] = {
        name: np.array(one) if isinstance(one, list) else one for name, one in told.items()
    }
    return View(**parts | {"linear": parts["linear"].view(complex)})


MISMATCH = Stage("mismatch", compute_mismatch, read_mismatch)
