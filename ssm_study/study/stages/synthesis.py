"""Stage that designs controller and observer with their certificates."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.engine.stages import Facts, Stage
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import Judgement, withhold_predictions
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet, input_limits
from ssm_study.study.stages.free_run import ModelRun
from ssm_study.synthesis.metrics import design_columns, paper_feasibility_columns

if TYPE_CHECKING:
    from ssm_study.robustness.coverage import ModelErrorSpectra
    from ssm_study.synthesis.design import Synthesis


def compute_synthesis(
    folder: Path,
    data: DataSet,
    model_run: ModelRun,
    recorded_mismatch: Mismatch,
    judgement: Judgement,
    *,
    synthesis: "Synthesis",
    limits: dict[str, Any],
) -> None:
    """Design controller and observer from the identified model and the recorded data alone.

    Certificates are decided in exact arithmetic. If the evidence allows no judgement, `auto` takes
    the design with the largest margin. It simulates responses within the input limits, which are
    given or the range of the training inputs.
    """
    from ssm_study.synthesis.auto import Auto
    from ssm_study.synthesis.decay_response import simulate_decays
    from ssm_study.synthesis.deployed import add_gain_certificates
    from ssm_study.synthesis.measured_discs_run import add_coverage_certificate

    model = model_run.model
    balls = certified_balls(model)
    spectra = recorded_error_spectra(model, data, recorded_mismatch)
    ends = input_limits(limits["input_lower"], limits["input_upper"], data.training_inputs)
    method: Any = synthesis
    if isinstance(synthesis, Auto):
        judgeable = (
            synthesis.with_largest_margin() if judgement.level == CANNOT_JUDGE else synthesis
        )
        decays = simulate_decays(model, data.mismatch_records, data.validation)
        method = judgeable.prefer_covered_designs(spectra).prefer_faster_than_decays(decays)
        if limits["applied"]:
            lower, upper = (model.scale.scaled_input(end) for end in ends)
            method = method.with_input_limits(lower, upper)
    design = method.design(model, balls, data.validation, recorded_mismatch)
    design = add_gain_certificates(design, model, balls, ends)
    design = add_coverage_certificate(design, model, balls, spectra)
    design.save(folder / "certificate.json")


def recorded_error_spectra(model: Any, data: DataSet, mismatch: Mismatch) -> "ModelErrorSpectra":
    """Spectra of the model error in the recorded data, which a stability proof for the plant has to
    cover."""
    from ssm_study.robustness.coverage import measure_error_spectra

    records = data.mismatch_records
    return measure_error_spectra(model, data.validation, mismatch, data.start_up_samples, records)


def unused_record_error_spectra(
    model: Any, data: DataSet, mismatch: Mismatch
) -> "ModelErrorSpectra | None":
    """Spectra of the model error in the unused test record of a log; None for a simulated plant."""
    from ssm_study.robustness.coverage import measure_error_spectra

    if data.metadata.get("source") == "simulated":
        return None
    return measure_error_spectra(model, data.test, mismatch, data.start_up_samples)


def read_design(folder: Path) -> Design:
    """Read the stored controller and observer, or the reason why one is missing."""
    return Design.load(folder / "certificate.json")


def synthesis_result_columns(
    design: Design,
    data: DataSet,
    model_run: ModelRun,
    recorded_mismatch: Mismatch,
    judgement: Judgement,
) -> Facts:
    """Table columns that describe the design of controller and observer, and its predictions."""
    from ssm_study.synthesis.expected_response import faster_response_column
    from ssm_study.synthesis.measured_discs_run import coverage_columns
    from ssm_study.synthesis.withheld_coverage import withhold_coverage

    model = model_run.model
    balls = certified_balls(model)
    spectra = recorded_error_spectra(model, data, recorded_mismatch)
    fresh = unused_record_error_spectra(model, data, recorded_mismatch)
    facts = design_columns(design, model, balls, recorded_mismatch)
    facts |= coverage_columns(design, model, spectra, fresh)
    facts |= faster_response_column(
        design, model, recorded_mismatch, data.validation, data.mismatch_records
    )
    if design.feasible:
        facts = withhold_coverage(facts, model, design.gain_pair)
    return withhold_predictions(facts, judgement.level) | paper_feasibility_columns(
        design, model, balls
    )


SYNTHESIS = Stage(
    "synthesis", compute_synthesis, read_design, synthesis_result_columns, ("certificate.json",)
)
