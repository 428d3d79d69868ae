"""Stage that measures the error between plant and model from the records."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.engine.stages import Stage
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.signals import DataSet
from ssm_study.study.stages.free_run import ModelRun

FILE = "mismatch.json"


def compute_mismatch(folder: Path, data: DataSet, model_run: ModelRun) -> Mismatch:
    """Measure the error between plant and model from the records, and store the measured error."""
    records = data.mismatch_records
    mismatch = measure_model_error(model_run.model, data.validation, data.start_up_samples, records)
    write_mismatch(folder, mismatch)
    return mismatch


def write_mismatch(folder: Path, mismatch: Mismatch) -> None:
    """Write a measured model error as JSON, with all digits."""
    text = json.dumps(asdict(mismatch), default=_as_floats)
    (folder / FILE).write_text(text, encoding="utf-8")


def _as_floats(array: Any) -> list[float]:
    """Entries of a real or complex array as a list of floats."""
    return list(np.ascontiguousarray(array).view(float).tolist())


def read_mismatch(folder: Path) -> Mismatch:
    """Read the stored error between plant and model at every amplitude of the input."""
    content = json.loads((folder / FILE).read_text(encoding="utf-8"))
    views = tuple(_read_error_at_amplitude(view) for view in content.pop("views"))
    loop = content.pop("loop")
    other_fields: dict[str, Any] = {}
    for name, value in content.items():
        other_fields[name] = tuple(value) if isinstance(value, list) else value
    return Mismatch(views=views, loop=loop and _read_error_at_amplitude(loop), **other_fields)


def _read_error_at_amplitude(content: dict[str, Any]) -> ModelErrorAtAmplitude:
    """Read the model error at one input amplitude from the lists in a file."""
    parts: dict[str, Any] = {}
    for name, value in content.items():
        parts[name] = np.array(value) if isinstance(value, list) else value
    parts["linear"] = parts["linear"].view(complex)
    return ModelErrorAtAmplitude(**parts)


MISMATCH = Stage("mismatch", compute_mismatch, read_mismatch)
