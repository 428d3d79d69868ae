"""Stage that tests a controller with single-sine inputs on the simulated plant, at the frequencies
where the closed loop is most sensitive to model errors."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.durable import read_json
from ssm_study.engine.stages import Facts, Stage
from ssm_study.evidence.metrics import Judgement, withhold_predictions
from ssm_study.robustness.coverage import measure_error_spectra
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.sine_trials import SineMismatch
from ssm_study.signals import DataSet
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.free_run import ModelRun
from ssm_study.synthesis.sine_judgement import (
    measure_error_with_simulated_sines,
    sine_columns,
    sine_coverage_columns,
)
from ssm_study.synthesis.withheld_coverage import reported_coverage

FILE = "sine_trials.json"


def compute_sine_trials(
    folder: Path,
    records: DataSet,
    model_run: ModelRun,
    mismatch: Mismatch,
    judgement: Judgement,
    design: Design,
    *,
    data: Any,
    seed: int,
    plant: Any,
) -> None:
    """Simulate experiments with single sines on the plant, and measure the model error in each."""
    del records, judgement
    model = model_run.model
    balls = certified_balls(model)
    sines = measure_error_with_simulated_sines(design, model, balls, mismatch, data, plant, seed)
    rows = [{name: repr(value) for name, value in asdict(sine).items()} for sine in sines]
    write_json(folder / FILE, {"sines": rows})


def read_sine_trials(folder: Path) -> list[SineMismatch]:
    """Read the stored model errors that were measured with single sines."""
    rows = read_json(folder / FILE)["sines"]
    return [SineMismatch(**{name: float(text) for name, text in row.items()}) for row in rows]


def sine_trial_result_columns(
    sines: list[SineMismatch],
    records: DataSet,
    model_run: ModelRun,
    mismatch: Mismatch,
    judgement: Judgement,
    design: Design,
) -> Facts:
    """Table columns on stability margin, predictions and covered model error, computed with the
    model error measured by single sines."""
    model = model_run.model
    start_up = records.start_up_samples
    trials = records.mismatch_records
    spectra = measure_error_spectra(model, records.validation, mismatch, start_up, trials)
    coverage = reported_coverage(design, model, spectra)
    facts = sine_columns(design, model, certified_balls(model), mismatch, sines)
    facts |= sine_coverage_columns(design, sines, coverage)
    return withhold_predictions(facts, judgement.level)


SINE_TRIALS = Stage("sine_trials", compute_sine_trials, read_sine_trials, sine_trial_result_columns)
