"""Stage that simulates data sets anew, and compares their model error with that of the run's
records."""

from pathlib import Path
from typing import Any

from ssm_study.certificates.certificate import Design
from ssm_study.durable import read_json
from ssm_study.engine.stages import Facts, Stage
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.free_run import ModelRun
from ssm_study.study.stages.synthesis import recorded_error_spectra
from ssm_study.synthesis.measured_discs_run import (
    coverage_needed_column,
    relative_radii_for_further_data,
)

FILE = "fresh_data.json"


def compute_fresh_data(
    folder: Path,
    records: DataSet,
    model_run: ModelRun,
    mismatch: Mismatch,
    design: Design,
    *,
    data: Any,
    seed: int,
    plant: Any,
) -> None:
    """Simulate data sets anew, and measure how much larger their model error is than in the run's
    records. Nothing is simulated without a coverage certificate."""
    model = model_run.model
    spectra = recorded_error_spectra(model, records, mismatch)
    fresh = data.simulate_held_out_records(plant, seed)
    needs = relative_radii_for_further_data(
        design, model, spectra, mismatch, fresh, records.start_up_samples
    )
    write_json(folder / FILE, {"needs": [repr(need) for need in needs]})


def read_fresh_data_error_ratios(folder: Path) -> list[float]:
    """Read, for each data set simulated anew, its largest model error divided by that of the run's
    own records."""
    return [float(need) for need in read_json(folder / FILE)["needs"]]


def fresh_data_result_columns(needs: list[float], *_: Any) -> Facts:
    """Table column with the largest ratio of the model error in data sets simulated anew to the
    recorded one."""
    return coverage_needed_column(needs)


FRESH_DATA = Stage(
    "fresh_data", compute_fresh_data, read_fresh_data_error_ratios, fresh_data_result_columns
)
