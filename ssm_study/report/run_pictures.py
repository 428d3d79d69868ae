"""Pictures of one run, made only from the files in its folder."""

from collections.abc import Callable
from typing import Any

from ssm_study.api.pictures.bode import bode_picture
from ssm_study.api.pictures.coverage import coverage_picture
from ssm_study.api.pictures.free_run import free_run_picture
from ssm_study.api.pictures.input_map import input_map_picture
from ssm_study.api.pictures.loop_response import set_point_picture
from ssm_study.api.pictures.margin import InputScale, margin_picture, physical_input_scale
from ssm_study.api.pictures.nyquist import nyquist_picture
from ssm_study.api.pictures.picture import EmptyPictureError, Picture
from ssm_study.api.pictures.poles import poles_picture
from ssm_study.api.pictures.residual_correlation import residual_correlation_picture
from ssm_study.bounds.slopes import certified_balls
from ssm_study.export.set_points import missing_set_points_reason
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment, has_direct_feedthrough
from ssm_study.report.study_folder import NothingToDraw, RunFolder, StudyFolder
from ssm_study.robustness.coverage import measure_error_spectra
from ssm_study.robustness.margin_by_frequency import margin_curves
from ssm_study.study.recordings import RecordedCases
from ssm_study.synthesis.loop_poles import eigenvalue_groups


def picture_of_best_run(name: str, study: StudyFolder) -> Picture:
    """Picture of the best run of a study, chosen by the picture's name. Raises `NothingToDraw` with
    the reason where the picture would be empty."""
    if study.best_run is None:
        raise NothingToDraw("No run left a model.")
    return picture_of_run(name, study.best_run)


def picture_of_run(name: str, run: RunFolder) -> Picture:
    """Picture of a single run, chosen by the picture's name. Raises `NothingToDraw` with the
    reason where the picture would be empty."""
    try:
        return PICTURES[name](run)
    except EmptyPictureError as reason:
        raise NothingToDraw(str(reason)) from reason


def read_run_files(run: RunFolder, *parts: str) -> list[Any]:
    """Read files of a run, such as model and design, by name. Raises `NothingToDraw` that names a
    missing part."""
    values = [getattr(run, part) for part in parts]
    missing = [part for part, value in zip(parts, values, strict=True) if value is None]
    if missing:
        raise NothingToDraw(f"The run left no {missing[0].replace('_', ' ').removeprefix('any ')}.")
    return values


def run_input_scale(run: RunFolder, model: Any) -> InputScale | None:
    """Physical size and unit of one scaled input of a run's model; None for several inputs, or if
    the run has no validation record."""
    if run.validation is None:
        return None
    return physical_input_scale(model, run.validation.unit("input"))


def picture_of_margin(run: RunFolder) -> Picture:
    """Picture of a run's stability margin over frequency."""
    model, gains, mismatch = read_run_files(run, "any_model", "gains", "mismatch")
    curves = margin_curves(model, gains, certified_balls(model), mismatch)
    margin = run.record.get("resolved_margin")
    return margin_picture(curves, model.step_s, margin, run_input_scale(run, model))


def picture_of_nyquist_curve(run: RunFolder) -> Picture:
    """Picture of a run's Nyquist curve, with discs for the measured model error."""
    model, gains = read_run_files(run, "any_model", "gains")
    return nyquist_picture(model, gains, run.mismatch)


def picture_of_coverage(run: RunFolder) -> Picture:
    """Picture of how much model error a run's proof covers in each frequency band."""
    model, design, mismatch = read_run_files(run, "any_model", "design", "mismatch")
    spectra = measure_error_spectra(
        model, run.validation_records, mismatch, run.start_up_samples, run.mismatch_records
    )
    return coverage_picture(design, spectra, model.step_s, run_input_scale(run, model))


def picture_of_frequency_response(run: RunFolder) -> Picture:
    """Picture that compares the frequency response of a run's model with an estimate from the
    validation record."""
    model, record = read_run_files(run, "any_model", "validation")
    units = (record.unit("measured"), record.unit("input"))
    return bode_picture(model, record.records[0], certified_balls(model).input, units)


def picture_of_poles(run: RunFolder) -> Picture:
    """Picture of the poles of a run's model, closed loop and observer."""
    model, gains, design = read_run_files(run, "any_model", "gains", "design")
    return poles_picture(eigenvalue_groups(model, gains), design.certified_rate("state_feedback"))


def picture_of_residuals(run: RunFolder) -> Picture:
    """Picture of the correlations of a run's simulation error on the test record."""
    (test,) = read_run_files(run, "test")
    start = run.start_up_samples
    errors = [test["measured"][0, start:] - test["simulated"][0, start:]]
    inputs = [test["input"][0, start:]]
    input_names = [channel.name for channel in test.signals("input")[0].channels]
    output_name = test.signals("measured")[0].channels[0].name
    return residual_correlation_picture(errors, inputs, output_name, input_names)


def picture_of_free_run(run: RunFolder) -> Picture:
    """Picture of the free-run simulation of a run's model on the test record."""
    (test,) = read_run_files(run, "test")
    simulated = {"model": test["simulated"][0]}
    labels = test.labels("measured")
    return free_run_picture(
        test.time_s("measured"), test["measured"][0], simulated, labels, run.start_up_samples
    )


def picture_of_input_map(run: RunFolder) -> Picture:
    """Picture of the learned input map of a run's model."""
    model, excitation = read_run_files(run, "any_model", "excitation")
    return input_map_picture(model, certified_balls(model).input, excitation.label("input"))


def picture_of_set_point_step(run: RunFolder) -> Picture:
    """Picture of a run's closed loop after a step of the set point, on the identified model."""
    model, design, test, excitation = read_run_files(
        run, "any_model", "design", "test", "excitation"
    )
    if not design.feasible or has_direct_feedthrough(model):
        raise NothingToDraw("There is no loop to move to a set point.")
    reason = missing_set_points_reason(run.path)
    if reason:
        raise NothingToDraw(f"The exported code follows no set points: {reason}.")
    plant = _identified_plant(model, test)
    recorded = [signal.values for signal in excitation.signals("input")]
    loop = (
        LoopExperiment()
        .with_default_limits(model.scale.append_equilibrium_input(recorded))
        .with_default_horizon(model)
    )
    place = "the identified model"
    return set_point_picture(plant, design, model, loop, recorded, place)


def _identified_plant(model: Any, record: RecordedCases) -> IdentifiedPlant:
    """Make a simulated plant from the identified model, with the channel names of a record."""
    inputs = record.signals("input")[0].channels
    outputs = record.signals("measured")[0].channels
    return IdentifiedPlant.from_model(model, inputs, outputs)


PICTURES: dict[str, Callable[[RunFolder], Picture]] = {
    "free_run": picture_of_free_run,
    "margin_by_frequency": picture_of_margin,
    "coverage_by_band": picture_of_coverage,
    "nyquist": picture_of_nyquist_curve,
    "set_point_step": picture_of_set_point_step,
    "frequency_response": picture_of_frequency_response,
    "loop_poles": picture_of_poles,
    "residual_correlation": picture_of_residuals,
    "input_map": picture_of_input_map,
}
