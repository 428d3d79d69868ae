"""One run, read top to bottom: data -> model -> bounds -> synthesis -> closed loop -> record.

Each stage is a pure function of its part of the configuration and of the stages before it. It is computed into a folder
of the store and read back from there, so that what is computed and what is reused are the same bits.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from safetensors.numpy import load_file, save_file

from ssm_study.bounds.scaffolds import certified_balls
from ssm_study.data.simulated import SimulatedData
from ssm_study.data.tensors import dataset_from_tensors, dataset_to_tensors
from ssm_study.loop.identified_plant import IdentifiedPlant
from ssm_study.loop.metrics import behaviour, certified
from ssm_study.loop.table import Identified, write_rows
from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.plants.plant import Plant
from ssm_study.results.durable import sha256_of_file
from ssm_study.results.facts import Facts, data_facts, design_facts, fit_facts, model_facts, opinion_facts
from ssm_study.results.gather import gather
from ssm_study.results.groups import Sharing, attempt
from ssm_study.results.keys import code_version
from ssm_study.results.naming import register_resolver, run_name
from ssm_study.results.plan import PlannedStages
from ssm_study.results.recordings import write_excitation, write_rollouts, write_simulation
from ssm_study.results.records import CORRUPT, FAILED, INFEASIBLE, LOST, OK, read_record, storable
from ssm_study.results.runs import Outcome, Run, execute
from ssm_study.results.show import show
from ssm_study.results.store import StageResult, Stages, Store
from ssm_study.signals import DataSet
from ssm_study.specification import Specification, plain
from ssm_study.synthesis.certificate import Design, Infeasible
from ssm_study.training.identification import Identification
from ssm_study.training.together import Member, may_train_together, records_gain, train_together

NOUNS = ("refusal", "signals", "systems", "study")
register_resolvers = register_resolver  # each fresh process asks the task's module for it

RUN_FIGURES = ("validation_trajectory", "closed_loop_responses")  # the paper's two

MAY_DIFFER = frozenset({"slope_lower", "slope_upper", "start", "real_modes", "ring_radius", "ring_frequency"})

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


def job(config: DictConfig) -> Outcome:
    """What Hydra calls for each configuration: do the run unless it is done, and leave its record."""
    specification = Specification.from_config(config)

    def work(run: Run) -> Facts:
        design = line(specification, Store(specification.store), done=lambda stage: settle(run, stage))
        return {"status": OK if design is None or feasible(design.value) else INFEASIBLE}

    return execute(
        specification.folder,
        parameters(specification),
        work,
        configuration=configuration_files(config),
        retry_failed=config.retry_failed,
    )


def conclude_run(config: DictConfig) -> bool:
    """Gather the study, draw the run's figures and print how it went; True if the run failed."""
    from ssm_study.report.figures import draw  # here: a sweep and its jobs draw nothing
    from ssm_study.report.outcome import print_outcome

    study = study_folder(config)
    gather(study)
    name = run_name(config)
    record = read_record(study / name) or {}
    drawn = RUN_FIGURES if "stable_count" in record else RUN_FIGURES[:1]  # a baseline closes no loop
    figures = draw(drawn, study) if record.get("status") == OK else []
    print_outcome(record, figures)
    return record.get("status") not in (OK, INFEASIBLE)


def conclude_sweep(config: DictConfig) -> bool:
    """Gather the study and print its table; True if any of its runs failed."""
    study = study_folder(config)
    show(study)
    return bool(gather(study)["status"].isin([FAILED, LOST, CORRUPT]).any())


def study_folder(config: DictConfig) -> Path:
    return Path(str(config.results_dir)) / str(config.study)


def check(config: DictConfig) -> None:
    """Raise `BadRequest` for whatever can be known to be wrong before any long work; recorded data are read for it."""
    specification = Specification.from_config(config)
    if specification.plant is None:
        specification.dataset()


def walk(config: DictConfig, stages: Stages) -> None:
    """The line with stages only: nothing is read outside their computation, so that a plan can be made of it."""
    line(Specification.from_config(config), stages, done=_nothing)


def line(specification: Specification, stages: Stages, done: Callable[[Kept[Any]], None]) -> Kept[Design] | None:
    """The study, stage by stage; `done` is told of each as it stands. A baseline is scored, and there it ends."""
    data = dataset_stage(specification, stages)
    done(data)
    model = model_stage(specification, stages, data)
    done(model)
    if not specification.model.gives_ssm:
        done(score_stage(stages, data, model))
        return None
    bounded = bounds_stage(specification, stages, data, model)
    done(bounded)
    design = synthesis_stage(specification, stages, data, bounded)
    done(design)
    done(loop_stage(specification, stages, data, bounded, design))
    return design


def sharing(config: DictConfig, stages: Stages) -> Sharing | None:
    """Runs that differ in seed, slope bounds or starting point alone may be trained in one program.

    None where the settings forbid it or the model is there.
    """
    specification = Specification.from_config(config)
    if not may_train_together(specification.training, specification.model) or not short(specification):
        return None
    model = model_stage(specification, stages, dataset_stage(specification, stages))
    if model.result.reused:
        return None
    alike = select(specification, "data", "training", *(("plant", "excitation") if specification.plant else ()))
    settings = {name: value for name, value in specification.configuration["model"].items() if name not in MAY_DIFFER}
    return Sharing(kind=json.dumps(alike | {"model": settings}, sort_keys=True, default=str), key=model.key)


def short(specification: Specification) -> bool:
    """Whether the records are of the kind that gains, see `records_gain`."""
    data = specification.data
    if isinstance(data, SimulatedData):
        return records_gain(max(data.samples, data.validation_samples), data.start_up_samples)
    found = specification.dataset()
    return records_gain(max(len(record) for record in (*found.training, *found.validation)), found.start_up_samples)


def train_members(configs: list[DictConfig]) -> None:
    """The models of these runs into the store, trained together as far as they can be."""
    members: dict[Member, tuple[Specification, Kept[DataSet]]] = {}

    def prepare(config: DictConfig) -> None:
        made = Specification.from_config(config)
        data = dataset_stage(made, Store(made.store))
        key = model_stage(made, PlannedStages(Store(made.store)), data).key
        if key not in known:
            known.add(key)
            member = Member(spec=made.model, data=data.value, seed=made.seed, training=made.training)
            members[member] = made, data

    def keep(member: Member, number: int) -> None:
        made, data = members[member]
        store = Store(made.store)
        attempt(lambda: model_stage(made, store, data, lambda folder: member.conclude(folder, number)), "keeping")

    known: set[str] = set()
    for config in configs:
        attempt(partial(prepare, config), "preparing")
    train_together(list(members), keep)


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
        write_json(folder / "training_curve.json", identified.curve)
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
    return Kept(result, _nothing, ("model.json", "validation.mcap", "test.mcap"))


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
    return Kept(result, _nothing, ("closed_loop.mcap", "closed_loop_model.mcap", "comparison.csv"))


def stand_in(model: SSM, data: DataSet) -> Plant:
    """Recorded data have no plant: the loop is closed on the identified model, and the record says so."""
    return IdentifiedPlant(model=model, input_channels=data.inputs, output_channels=data.outputs)


def _nothing(_: Any) -> None:
    return None


def feasible(design: Design) -> bool:
    return not isinstance(design.state_feedback, Infeasible) and not isinstance(design.observer, Infeasible)


def settle(run: Run, stage: Kept[Any]) -> None:
    """Note a stage in the record and copy its files: a run stays whole when the store is removed."""
    run.stage(stage.result)
    run.note(**read_json(stage.result.path / "facts.json"))
    if stage.result.name == "synthesis":
        run.note(synthesis_seconds=stage.result.seconds)
    for name in stage.files:
        if (stage.result.path / name).is_file():
            shutil.copyfile(stage.result.path / name, run.path / name)


def parameters(specification: Specification) -> Facts:
    """What was asked for: the columns a study is read by before anything is computed."""
    model, synthesis = specification.configuration["model"], specification.configuration["synthesis"]
    asked = {name: model.get(name) for name in ("order", "hidden_width", "slope_lower", "slope_upper")}
    rates = {side: synthesis.get(side) for side in ("rate_controller", "rate_observer")}
    return (
        asked
        | {side: rate for side, rate in rates.items() if isinstance(rate, float | int)}
        | {
            "seed": specification.seed,
            "scaffold_in": kind_of(model.get("scaffold_in")),
            "scaffold_out": kind_of(model.get("scaffold_out")),
            "plant": type(specification.plant).__name__ if specification.plant else None,
            "excitation": specification.excitation.kind if specification.plant else None,
            "synthesis_method": type(specification.synthesis).method,
        }
    )


def kind_of(scaffold: Any) -> str | None:
    """`ssm_study.models.scaffold_specs.Monotone` -> `monotone`."""
    target = str(scaffold.get("_target_", "")) if isinstance(scaffold, dict) else ""
    return target.rsplit(".", 1)[-1].lower() or None


def configuration_files(config: DictConfig) -> dict[str, str]:
    """`.hydra/`: the resolved configuration and the overrides that led to it."""
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    resolved = OmegaConf.create(plain(config))
    return {
        "config.yaml": OmegaConf.to_yaml(resolved),
        "overrides.yaml": OmegaConf.to_yaml(OmegaConf.create(list(overrides))),
    }


def select(specification: Specification, *names: str) -> Facts:
    """The parts of the configuration that a stage depends on."""
    return {name: specification.configuration[name] for name in names}


def read_model(folder: Path) -> Any:
    return model_from_json(read_json(folder / "model.json"))


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_facts(folder: Path, facts: Facts) -> None:
    """As a record keeps them: an infinite gain is the text `inf`, for JSON has no infinities."""
    write_json(folder / "facts.json", {name: storable(name, value) for name, value in facts.items()})


def write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
