"""Input amplitudes of a study's table in the unit of the plant's input."""

import json
import re
from contextlib import suppress

import pandas as pd

from ssm_study.api.pictures.coverage import AMPLITUDE, smallest_coverage_record_text
from ssm_study.api.pictures.margin import InputScale, amplitude_text
from ssm_study.report.study_folder import RunFolder, StudyFolder

COLUMN = "coverage_reference"
NUMBER = re.compile(r"[\d.e+-]+$")
MOST_READ = 200  # best runs whose models are read for their scale


def with_physical_amplitudes(study: StudyFolder, table: pd.DataFrame) -> pd.DataFrame:
    """Results table in which records are named by their input amplitudes in physical units. Without
    a readable model of the run they are named in input scales, with that word."""
    if COLUMN not in table:
        return table
    texts: list[str | None] = []
    for place, (name, text) in enumerate(zip(table["run"], table[COLUMN], strict=True)):
        if pd.isna(text):
            texts.append(None)
            continue
        is_read = place < MOST_READ and bool(name)
        run = study.run_folder(name) if is_read else None
        texts.append(coverage_reference_text(str(text), run, study.units.input))
    named = pd.Series(texts, index=table.index, dtype="string")
    return table.assign(**{COLUMN: named})


def coverage_reference_text(text: str, run: RunFolder | None, unit: str) -> str:
    """Text that names the record and frequency band where the tolerated model error is smallest
    relative to the measured one. The input amplitude is in physical units."""
    record, _, _ = text.partition(", ")
    number = NUMBER.search(record)
    if number is None or not AMPLITUDE.fullmatch(record):
        return text
    scale, step_s = (None, None) if run is None else read_input_scale_and_step(run)
    known_scale: InputScale | None = None if scale is None else (scale, unit)
    labels = {record: amplitude_text(float(number[0]), known_scale)}
    if step_s is None:
        return text.replace(record, labels[record], 1)
    return smallest_coverage_record_text(text, labels, step_s)


def read_input_scale_and_step(run: RunFolder) -> tuple[float | None, float | None]:
    """Read the input scale and the sampling time of a model with one input from its run. Each is
    None if the file lacks it."""
    with suppress(OSError, ValueError, KeyError):
        content = json.loads((run.path / "model.json").read_text(encoding="utf-8"))
        scales = content["input_scale"]
        return (float(scales[0]) if len(scales) == 1 else None), float(content["step_s"])
    return None, None
