"""The stages of a run: what each computes, keeps and measures.

To add a stage: write its three functions as `engine.stages.Stage` says, name them in a `Stage`
below, and take it in
`line.py` with the parts of the configuration that it depends on. Its columns are declared in the
`metrics` module of
their room. What only computing takes is imported inside the functions: a run that reuses a stage
then never loads it.
"""

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.bounds.metrics import bound_facts
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.data.metrics import benchmark_rmse, data_facts
from ssm_study.durable import contents
from ssm_study.engine.stages import Facts, Stage
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import Judgement, evidence_facts, judge, withheld
from ssm_study.loop.metrics import behaviour, certified
from ssm_study.loop.peers.peer import Identified
from ssm_study.loop.regulation import IdentifiedPlant, Loop, LoopRuns, answers_at_once
from ssm_study.models.metrics import Simulation, fit_facts, size_facts
from ssm_study.models.structured import model_from_json
from ssm_study.plants.plant import Plant
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.signals import DataSet, input_limits
from ssm_study.study import recordings
from ssm_study.synthesis.input_inversion import shown_to
from ssm_study.synthesis.metrics import design_facts, opinion_facts
from ssm_study.training.metrics import mean_fit, training_facts

if TYPE_CHECKING:
    from ssm_study.bounds.reduction import Reduction
    from ssm_study.models.spec import ModelSpec
    from ssm_study.robustness.coverage import Premise
    from ssm_study.synthesis.design import Synthesis
    from ssm_study.training.training import Training


def compute_dataset(
    folder: Path, *, data: Any, seed: int, plant: Plant | None = None, excitation: Any = None
) -> None:
    """Simulate or read the records; kept as tensors."""
    records = data.build(seed) if plant is None else data.build(plant, excitation, seed)
    write_dataset(folder, records)
    recordings.write_records(folder / "excitation.mcap", records, records.training, outputs=False)
    if records.mismatch_records:
        recordings.write_records(folder / recordings.TRIALS, records, records.mismatch_records)


def write_dataset(folder: Path, records: DataSet) -> None:
    """What `read_dataset` reads."""
    from safetensors.numpy import save_file

    from ssm_study.data.assembly import dataset_to_tensors

    arrays, about = dataset_to_tensors(records)
    save_file(arrays, folder / "records.safetensors")
    write_json(folder / "records.json", about)


def read_dataset(folder: Path) -> DataSet:
    """The records in physical units, with their splits."""
    from safetensors.numpy import load_file

    from ssm_study.data.assembly import dataset_from_tensors

    return dataset_from_tensors(
        load_file(folder / "records.safetensors"), read_json(folder / "records.json")
    )


@dataclass(frozen=True)
class Trained:
    """An identified model, how long its training took in seconds, and why it ended."""

    model: Any
    seconds: float
    ended: str
    baseline: dict[str, Any] | None = None


def compute_model(
    folder: Path,
    data: DataSet,
    *,
    model: "ModelSpec",
    training: "Training",
    seed: int,
    progress: bool,
) -> None:
    """Train; kept as explicit numbers. A fit that left the finite is a gap in the curve: JSON has
    no infinity."""
    late = getattr(model, "dead_time", 0)  # of one layer; fitted without it
    identified = training.identify(
        model, data.shift_out_dead_time(late) if late else data, seed, folder, progress
    )
    made: Any = identified.model
    write_json(folder / "model.json", (made.delayed(late) if late else made).to_json())
    facts = {"seconds": identified.seconds, "ended": identified.ended}
    if data.metadata.get("source") == "recorded":
        from ssm_study.models.baselines.regression import baseline_facts

        facts["baseline"] = baseline_facts(data)
    write_json(folder / "training.json", facts)
    write_json(folder / "training_curve.json", with_gaps(identified.curve))
    if identified.choice:
        write_json(folder / "choice.json", list(identified.choice))


def read_trained(folder: Path) -> Trained:
    """The model with the seconds its training took and why it ended."""
    return Trained(read_model(folder), **read_json(folder / "training.json"))


def measure_model(trained: Trained, _: DataSet) -> Facts:
    """The columns of the training: its time, its end, the model's size, and a baseline's fit."""
    facts = training_facts(trained.seconds, trained.ended) | size_facts(trained.model)
    return facts | (trained.baseline or {})


def read_model(folder: Path) -> Any:
    """The model as explicit numbers, without torch."""
    return model_from_json(read_json(folder / "model.json"))


class ModelRun:
    """A model and its free runs beside the validation and test records; each is read when first
    asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def model(self) -> Any:
        return read_model(self.folder)

    @cached_property
    def validation(self) -> Simulation:
        return recordings.read_simulation(self.folder / "validation.mcap")

    @cached_property
    def test(self) -> Simulation:
        return recordings.read_simulation(self.folder / "test.mcap")


def compute_simulated(
    folder: Path, data: DataSet, trained: Trained, *, reduction: "Reduction | None" = None
) -> None:
    """The model and its free runs beside the validation and test records.

    In balanced coordinates it is what is certified; a baseline has no `reduction`, and nothing is
    claimed of it.
    """
    model = trained.model if reduction is None else reduction.reduce(trained.model)
    write_json(folder / "model.json", model.to_json())
    for name, records in (("validation", data.validation), ("test", data.test)):
        free, start_up = (
            Simulation.of(model, records, data.start_up_samples).simulated,
            str(data.start_up_samples),
        )
        recordings.write_records(
            folder / f"{name}.mcap", data, records, simulated=free, start_up_samples=start_up
        )


def measure_score(simulated: ModelRun, data: DataSet, _: Trained) -> Facts:
    """The columns of the free run: fits in percent, errors in the output's unit, a benchmark's
    score."""
    scores = benchmark_rmse(data, simulated.test.simulated) if "benchmark" in data.metadata else ()
    train = {"fit_train_percent": mean_fit(simulated.model, data.training, data)}
    return train | fit_facts(simulated.validation, simulated.test, scores)


def measure_bounds(simulated: ModelRun, data: DataSet, trained: Trained) -> Facts:
    """The columns of the certified model: fits, linear part, slopes."""
    before = {"fit_test_before_reduction_percent": mean_fit(trained.model, data.test, data)}
    return measure_score(simulated, data, trained) | before | bound_facts(simulated.model)


def compute_mismatch(folder: Path, data: DataSet, bounded: ModelRun) -> Mismatch:
    """How far the plant is from the model, as the records show it: once for all designs on this
    model."""
    shown = measure_mismatch(
        bounded.model, data.validation, data.start_up_samples, data.mismatch_records
    )
    recordings.write_mismatch(folder, shown)
    return shown


def compute_evidence(folder: Path, data: DataSet, bounded: ModelRun, shown: Mismatch) -> None:
    """What data and model allow to be said of the plant, before anything is."""
    judged = judge(data, bounded.model, bounded.validation, bounded.test, shown)
    write_json(folder / "evidence.json", judged.to_json())


def read_judgement(folder: Path) -> Judgement:
    """What the records allow to be said of the plant."""
    return Judgement.from_json(read_json(folder / "evidence.json"))


def compute_synthesis(
    folder: Path,
    data: DataSet,
    bounded: ModelRun,
    shown: Mismatch,
    judged: Judgement,
    *,
    synthesis: "Synthesis",
    limits: dict[str, Any],
) -> None:
    """Controller and observer, decided in exact arithmetic; chosen from the model and the records
    alone.

    Without evidence `auto` takes the largest margin; within `limits` that are `applied` (given, or
    a log's) it scores.
    """
    from ssm_study.synthesis.auto import Auto
    from ssm_study.synthesis.deployed import with_gain_certificates
    from ssm_study.synthesis.measured_discs_run import with_coverage

    premise = measured_premise(bounded.model, data, shown)
    chosen_by: Any = synthesis
    model, balls, shown = (
        bounded.model,
        certified_balls(bounded.model),
        shown_to(synthesis, bounded.model, data, shown),
    )
    ends = input_limits(limits["input_lower"], limits["input_upper"], data.applied)
    if isinstance(synthesis, Auto):
        judgeable = synthesis.cautious() if judged.level == CANNOT_JUDGE else synthesis
        judgeable = judgeable.covering(premise)
        chosen_by = (
            judgeable.within(*map(model.scale.scaled_input, ends))
            if limits["applied"]
            else judgeable
        )
    design = with_gain_certificates(
        chosen_by.design(model, balls, data.validation, shown), model, balls, ends
    )
    with_coverage(design, model, balls, premise).save(folder / "certificate.json")


def measured_premise(model: Any, data: DataSet, mismatch: Mismatch) -> "Premise":
    """What the records for the mismatch show of it by frequency."""
    from ssm_study.robustness.coverage import measure_premise

    records = data.mismatch_records
    return measure_premise(model, data.validation, mismatch, data.start_up_samples, records)


def fresh_premise(model: Any, data: DataSet, mismatch: Mismatch) -> "Premise | None":
    """What the test record of a log shows, which neither fit nor design has seen; None for a
    simulated plant."""
    from ssm_study.robustness.coverage import measure_premise

    if data.metadata.get("source") == "simulated":
        return None
    return measure_premise(model, data.test, mismatch, data.start_up_samples)


def read_design(folder: Path) -> Design:
    """Controller and observer, or why there is none."""
    return Design.load(folder / "certificate.json")


def measure_synthesis(
    design: Design, data: DataSet, bounded: ModelRun, shown: Mismatch, judged: Judgement
) -> Facts:
    """The columns of the design and of its prediction."""
    from ssm_study.synthesis.measured_discs_run import coverage_facts

    model, balls = bounded.model, certified_balls(bounded.model)
    facts = design_facts(design, model, balls, shown_to(design, model, data, shown))
    premise = measured_premise(model, data, shown)
    facts |= coverage_facts(design, model, premise, fresh_premise(model, data, shown))
    return withheld(facts, judged.level) | opinion_facts(design, model, balls)


Experiment = tuple[LoopRuns, str]  # and what it was done on


def compute_loop(
    folder: Path,
    data: DataSet,
    bounded: ModelRun,
    design: Design,
    *,
    loop: Loop,
    loop_seed: int,
    plant: Any = None,
) -> Experiment | None:
    """The certified pair on the true plant, or on the identified model where there is no plant;
    none without a pair.

    None either where the model, in the place of a plant, answers its input at once: it is scored
    and certified.
    """
    import pandas as pd

    model = bounded.model
    if not design.feasible or (plant is None and answers_at_once(model)):
        return None
    twin = IdentifiedPlant.of(model, data.inputs, data.outputs)
    on, loop_on = plant or twin, recordings.closed_on(plant)
    fitted = (loop.within(data.applied) if plant is None or design.inverts else loop).fitted(model)
    closed = fitted.run(on, model, design, loop_seed)
    recordings.write_experiment(
        folder, closed, on, twin, {"loop_on": loop_on, "loop_seed": str(loop_seed)}
    )
    if fitted.comparison is not None:
        rows = fitted.comparison.rows(
            on, Identified.of(model, certified_balls(model), data), fitted, loop_seed
        )
        table = pd.DataFrame(
            rows, dtype=object
        )  # else whole numbers beside an empty field become fractions
        table.to_csv(folder / "comparison.csv", index=False, lineterminator="\n")
    return closed, loop_on  # as `read_loop` reads it back, to the last bit


def read_loop(folder: Path) -> Experiment | None:
    """None where there was no pair to close the loop with."""
    return recordings.read_experiment(folder) if (folder / "closed_loop.mcap").is_file() else None


def measure_loop(
    experiment: Experiment | None, _data: DataSet, _bounded: ModelRun, design: Design
) -> Facts:
    """The columns of the closed loop; none without a loop."""
    if experiment is None:
        return {}
    closed, loop_on = experiment
    return {"loop_on": loop_on} | behaviour(closed) | certified(closed, design)


def read_json(path: Path) -> Any:
    """The content of a file of the stage."""
    return json.loads(contents(path))


def write_json(path: Path, content: Any) -> None:
    """Readable JSON; refuses numbers that JSON does not have (`ValueError`)."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def with_gaps(curve: list[dict[str, float]]) -> list[dict[str, float | None]]:
    """The curve with null for what is not finite."""
    return [
        {name: value if math.isfinite(value) else None for name, value in row.items()}
        for row in curve
    ]


CURVES = ("training_curve.json", "choice.json")
SIMULATED = ("model.json", "validation.mcap", "test.mcap")
LOOPS = ("closed_loop.mcap", "closed_loop_model.mcap", recordings.NOISE_FREE, "comparison.csv")
DATASET = Stage(
    "dataset", compute_dataset, read_dataset, data_facts, ("excitation.mcap", recordings.TRIALS)
)
MODEL = Stage("model", compute_model, read_trained, measure_model, CURVES)
SCORE = Stage("score", compute_simulated, ModelRun, measure_score, SIMULATED)
BOUNDS = Stage("bounds", compute_simulated, ModelRun, measure_bounds, SIMULATED)
MISMATCH = Stage("mismatch", compute_mismatch, recordings.read_mismatch)
EVIDENCE = Stage("evidence", compute_evidence, read_judgement, evidence_facts, ("evidence.json",))
SYNTHESIS = Stage(
    "synthesis", compute_synthesis, read_design, measure_synthesis, ("certificate.json",)
)
LOOP = Stage("loop", compute_loop, read_loop, measure_loop, LOOPS)
STAGES = (DATASET, MODEL, SCORE, BOUNDS, MISMATCH, EVIDENCE, SYNTHESIS, LOOP)
