"""Functions for each step on the way from records to a certified controller. They use no folders
and no cache."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import Judgement, collect_findings
from ssm_study.models.structured import Model as StateSpaceModel
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.robustness.coverage import ModelErrorSpectra, measure_error_spectra
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.mismatch import measure_model_error as measure_error_of_records
from ssm_study.signals import DataSet, input_limits

if TYPE_CHECKING:
    from ssm_study.models.spec import ModelSpec
    from ssm_study.training.metrics import Identification
    from ssm_study.training.training import Training

Limit = float | list[float] | None


def identify_model(
    spec: "ModelSpec",
    training: "Training",
    data: DataSet,
    seed: int,
    *,
    progress: bool,
    workplace: Path,
    keep_on_interrupt: bool = False,
) -> tuple[Any, "Identification"]:
    """Train a model on the training records, and return it with its dead time and a description of
    how it was identified.

    A model of one layer with a dead time is trained on records shifted by it. Checkpoints lie in a
    folder of `workplace` while the training runs. With `keep_on_interrupt` Ctrl-C ends the training
    with the best model so far.
    """
    with TemporaryDirectory(prefix="training-", dir=workplace) as folder:
        identification = training.identify(
            spec, data, seed, Path(folder), progress, keep_on_interrupt
        )
    return identification.model, identification


def measure_model_error(model: Any, data: DataSet) -> Mismatch:
    """Measure the model error from the validation records, and from records made for this
    purpose."""
    return measure_error_of_records(
        model, data.validation, data.start_up_samples, data.mismatch_records
    )


def judge_evidence(model: Any, data: DataSet, plant_mismatch: Mismatch) -> Judgement:
    """Judge which statements about the plant the recorded data and the model support."""
    validation, test = simulate_validation_and_test(model, data)
    return collect_findings(data, model, validation, test, plant_mismatch)


def measure_error_to_cover(
    model: StateSpaceModel, data: DataSet, mismatch: Mismatch
) -> ModelErrorSpectra:
    """Measure the model error, in each frequency band, that a stability proof for the plant has to
    cover."""
    records = data.mismatch_records
    return measure_error_spectra(model, data.validation, mismatch, data.start_up_samples, records)


def design_controller(
    synthesis: Any,
    model: StateSpaceModel,
    data: DataSet,
    plant_mismatch: Mismatch,
    judgement: Judgement,
    limits: tuple[Limit, Limit],
) -> Certificates:
    """Design controller and observer for a model, and decide their certificates in exact
    arithmetic.

    `limits` of the input are physical; None is the range that the records visited. Where the
    evidence allows no judgement, `auto` takes the largest stability margin.
    """
    from ssm_study.synthesis.auto import Auto
    from ssm_study.synthesis.decay_response import simulate_decays
    from ssm_study.synthesis.deployed import add_gain_certificates
    from ssm_study.synthesis.measured_discs_run import add_coverage_certificate

    balls = certified_balls(model)
    spectra = measure_error_to_cover(model, data, plant_mismatch)
    lower, upper = input_limits(*limits, data.training_inputs)
    if isinstance(synthesis, Auto):
        if judgement.level == CANNOT_JUDGE:
            synthesis = synthesis.with_largest_margin()
        decays = simulate_decays(model, data.mismatch_records, data.validation)
        covering = synthesis.prefer_covered_designs(spectra)
        synthesis = covering.prefer_faster_than_decays(decays)
        lowest_input = scale_deviation(model, lower)
        highest_input = scale_deviation(model, upper)
        synthesis = synthesis.with_input_limits(lowest_input, highest_input)
    design = synthesis.design(model, balls, data.validation, plant_mismatch)
    design = add_gain_certificates(design, model, balls, (lower, upper))
    return add_coverage_certificate(design, model, balls, spectra)


def scale_deviation(model: StateSpaceModel, u: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Convert a physical input to its scaled deviation from the equilibrium."""
    return model.scale.scaled_input(u)
