"""The stages of a run: what each computes, keeps and depends on; each is a pure function of its key."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

from safetensors.numpy import load_file, save_file

from ssm_study.bounds.scaffolds import certified_balls
from ssm_study.data.tensors import dataset_from_tensors, dataset_to_tensors
from ssm_study.loop.identified_plant import IdentifiedPlant
from ssm_study.loop.metrics import behaviour, certified
from ssm_study.loop.table import Identified, write_rows
from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.plants.plant import Plant
from ssm_study.results.durable import sha256_of_file
from ssm_study.results.facts import Facts, data_facts, design_facts, fit_facts, model_facts, opinion_facts
from ssm_study.results.keys import code_version
from ssm_study.results.recordings import write_excitation, write_rollouts, write_simulation
from ssm_study.results.records import storable
from ssm_study.results.store import StageResult, Stages
from ssm_study.signals import DataSet
from ssm_study.specification import Specification
from ssm_study.synthesis.certificate import Design, Infeasible
from ssm_study.training.identification import Identification

NOUNS = ("refusal", "signals", "systems", "stages")

T = TypeVar("T")

Train = Callable[[Path], Identification]


@dataclass(frozen=True)
class Kept(Generic[T]):
    """A finished stage: `value` is read from its folder when first asked for; `files` belong into the run folder."""

    result: StageResult
    read: Callable[[Path], T]
    files: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        return self.result.key

    @cached_property
    def value(self) -> T:
        return self.read(self.result.path)


def dataset_stage(specification: Specification, stages: Stages) -> Kept[DataSet]:
    """Simulate or read the records; kept as tensors."""

    def compute(folder: Path) -> None:
        data = specification.dataset()
        arrays, about = dataset_to_tensors(data)
        save_file(arrays, folder / "records.safetensors")
        write_json(folder / "records.json", about)
        write_excitation(folder / "excitation.mcap", data)
        write_facts(folder, data_facts(data))

    def read(folder: Path) -> DataSet:
        return dataset_from_tensors(load_file(folder / "records.safetensors"), read_json(folder / "records.json"))

    settings = select(specification, "data", "seed", *(("plant", "excitation") if specification.plant else ()))
    files = [sha256_of_file(path) for path in specification.files()]
    version = code_version(*NOUNS, "plants", "data", "results.recordings")
    result = stages.stage("dataset", settings | {"files": files}, (), version, compute)
    return Kept(result, read, ("excitation.mcap",))


def model_stage(
    specification: Specification, stages: Stages, data: Kept[DataSet], member: Train | None = None
) -> Kept[Any]:
    """Train; kept as explicit numbers. `member` has trained already, together with others."""

    def alone(folder: Path) -> Identification:
        training, spec = specification.training, specification.model
        return training.identify(spec, data.value, specification.seed, folder, specification.progress)

    def compute(folder: Path) -> float:
        identified = (member or alone)(folder)
        write_json(folder / "model.json", identified.model.to_json())
        write_json(folder / "training_curve.json", with_gaps(identified.curve))
        facts = {"training_seconds": identified.seconds, "training_ended": identified.ended}
        write_facts(folder, facts | {"trained_together": identified.trained_together})
        return identified.seconds

    settings = select(specification, "model", "training", "seed")
    version = code_version(*NOUNS, "models", "training", "torch")
    result = stages.stage("model", settings, (data.key,), version, compute)
    return Kept(result, read_model, ("training_curve.json",))


def score_stage(stages: Stages, data: Kept[DataSet], model: Kept[Any]) -> Kept[None]:
    """How well a baseline simulates; nothing is claimed of it."""

    def compute(folder: Path) -> None:
        records = data.value
        write_facts(folder, fit_facts(model.value, records))
        write_json(folder / "model.json", model.value.to_json())
        write_simulation(folder / "validation.mcap", model.value, records.validation, records)
        write_simulation(folder / "test.mcap", model.value, records.test, records)

    version = code_version(*NOUNS, "data", "models", "results.recordings", "results.facts")
    result = stages.stage("score", {}, (data.key, model.key), version, compute)
    return Kept(result, nothing, ("model.json", "validation.mcap", "test.mcap"))


def bounds_stage(specification: Specification, stages: Stages, data: Kept[DataSet], model: Kept[SSM]) -> Kept[SSM]:
    """The model in balanced coordinates, what is proved of it, and how well it simulates: this is what is certified."""

    def compute(folder: Path) -> None:
        records, reduced = data.value, specification.reduction.reduce(model.value)
        write_json(folder / "model.json", reduced.to_json())
        write_facts(folder, model_facts(reduced, model.value, records))
        write_simulation(folder / "validation.mcap", reduced, records.validation, records)
        write_simulation(folder / "test.mcap", reduced, records.test, records)

    version = code_version(*NOUNS, "data", "models", "bounds", "results.recordings", "results.facts")
    result = stages.stage("bounds", select(specification, "reduction"), (data.key, model.key), version, compute)
    return Kept(result, read_model, ("model.json", "validation.mcap", "test.mcap"))


def synthesis_stage(
    specification: Specification, stages: Stages, data: Kept[DataSet], bounded: Kept[SSM]
) -> Kept[Design]:
    """Controller and observer, decided in exact arithmetic; chosen from the model and the validation record alone."""

    def compute(folder: Path) -> None:
        model, record = bounded.value, (data.value.validation, data.value.start_up_samples)
        balls = certified_balls(model)
        design = specification.synthesis.design(model, *balls, *record)
        design.save(folder / "certificate.json")
        facts = design_facts(design, model, balls, *record) | opinion_facts(design, model, balls)
        write_facts(folder, facts)

    version = code_version(*NOUNS, "models", "bounds", "synthesis", "results.facts", "cvxpy", "clarabel")
    result = stages.stage("synthesis", select(specification, "synthesis"), (data.key, bounded.key), version, compute)
    return Kept(result, lambda folder: Design.load(folder / "certificate.json"), ("certificate.json",))


def loop_stage(
    specification: Specification, stages: Stages, data: Kept[DataSet], bounded: Kept[SSM], design: Kept[Design]
) -> Kept[None]:
    """The certified pair on the true plant, or on the identified model where there is no plant; none without a pair."""

    def compute(folder: Path) -> None:
        on = {"loop_on": "plant" if specification.plant else "identified model"}
        if not feasible(design.value):
            write_facts(folder, {})
            return
        plant = specification.plant or stand_in(bounded.value, data.value)
        closed = specification.loop.run(plant, bounded.value, design.value, specification.loop_seed)
        metadata = on | {"plant": type(plant).__name__, "loop_seed": str(specification.loop_seed)}
        write_rollouts(folder / "closed_loop.mcap", closed.controlled, closed.uncontrolled, plant, metadata)
        if closed.on_model is not None:
            twin = stand_in(bounded.value, data.value)
            write_rollouts(folder / "closed_loop_model.mcap", closed.on_model, None, twin, metadata)
        if specification.loop.comparison is not None:
            known = Identified(
                model=bounded.value, balls=certified_balls(bounded.value), validation=data.value.validation
            )
            rows = specification.loop.comparison.rows(plant, known, specification.loop, specification.loop_seed)
            write_rows(folder / "comparison.csv", rows)
        write_facts(folder, on | behaviour(closed) | certified(closed, design.value))

    settings = select(specification, "loop", "loop_seed", *(("plant",) if specification.plant else ()))
    version = code_version(*NOUNS, "plants", "models", "synthesis", "loop", "results.recordings")
    result = stages.stage("loop", settings, (data.key, bounded.key, design.key), version, compute)
    return Kept(result, nothing, ("closed_loop.mcap", "closed_loop_model.mcap", "comparison.csv"))


def stand_in(model: SSM, data: DataSet) -> Plant:
    """Recorded data have no plant: the loop is closed on the identified model, and the record says so."""
    return IdentifiedPlant(model=model, input_channels=data.inputs, output_channels=data.outputs)


def feasible(design: Design) -> bool:
    """Both a controller and an observer were found, certified or not."""
    return not isinstance(design.state_feedback, Infeasible) and not isinstance(design.observer, Infeasible)


def nothing(_: Any) -> None:
    """Of a stage that leaves files only there is nothing to read."""


def select(specification: Specification, *names: str) -> Facts:
    """The parts of the configuration that a stage depends on."""
    return {name: specification.configuration[name] for name in names}


def read_model(folder: Path) -> Any:
    """The identified model, without torch."""
    return model_from_json(read_json(folder / "model.json"))


def read_json(path: Path) -> Any:
    """One JSON document in UTF-8."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_facts(folder: Path, facts: Facts) -> None:
    """As a record keeps them: an infinite gain is the text `inf`, for JSON has no infinities."""
    write_json(folder / "facts.json", {name: storable(name, value) for name, value in facts.items()})


def with_gaps(curve: list[dict[str, float]]) -> list[dict[str, float | None]]:
    """A fit that left the finite is a gap in the curve: JSON has no infinity."""
    return [{name: value if math.isfinite(value) else None for name, value in row.items()} for row in curve]


def write_json(path: Path, content: Any) -> None:
    """Readable JSON; refuses numbers that JSON does not have (`ValueError`)."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
