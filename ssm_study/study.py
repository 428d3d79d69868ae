"""One run, read top to bottom: data -> model -> bounds -> synthesis -> closed loop -> record.

Each stage is a pure function of its part of the configuration and of the stages before it. It is computed into a folder
of the store and read back from there, so that what is computed and what is reused are the same bits.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ssm_study import members
from ssm_study.refusal import require
from ssm_study.results.facts import Facts
from ssm_study.results.gather import gather
from ssm_study.results.naming import plain, register_resolver, run_name, yaml_text
from ssm_study.results.records import CORRUPT, FAILED, INFEASIBLE, LOST, OK, RECORD, read_record
from ssm_study.results.runs import Outcome, Run, execute
from ssm_study.results.show import show
from ssm_study.results.store import Stages, Store
from ssm_study.specification import Specification
from ssm_study.stages import (
    Kept,
    bounds_stage,
    dataset_stage,
    feasible,
    loop_stage,
    model_stage,
    nothing,
    read_json,
    score_stage,
    synthesis_stage,
)
from ssm_study.synthesis.certificate import Design

# What the launcher asks the task's module for.
register_resolvers = register_resolver
sharing, train_members = members.sharing, members.train_members

RUN_FIGURES = ("validation_trajectory", "closed_loop_responses")  # the paper's two


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
    from ssm_study.report.study_folder import Study

    study = study_folder(config)
    gather(study)
    name = run_name(config)
    record = read_record(study / name) or {}
    drawn = RUN_FIGURES if "stable_count" in record else RUN_FIGURES[:1]  # a baseline closes no loop
    figures = draw(drawn, study) if record.get("status") == OK else []
    best = Study(folder=study).best if figures else None
    print_outcome(record, figures, drawn=best.path.name if best else None)
    return record.get("status") not in (OK, INFEASIBLE)


def conclude_sweep(config: DictConfig) -> bool:
    """Gather the study and print its table; True if any of its runs failed."""
    study = study_folder(config)
    show(study)
    return bool(gather(study)["status"].isin([FAILED, LOST, CORRUPT]).any())


def study_folder(config: DictConfig) -> Path:
    """`results_dir/study`."""
    return Path(str(config.results_dir)) / str(config.study)


def check(config: DictConfig) -> Specification:
    """Raise `BadRequest` for whatever can be known to be wrong before any long work; recorded data are read for it."""
    specification = Specification.from_config(config)
    if specification.plant is None:
        specification.dataset()
    return specification


def check_retry(config: DictConfig, run: str = "*") -> None:
    """Raise `BadRequest` where failed runs are to be run again and there is no run yet."""
    study = study_folder(config)
    there = any(study.glob(f"{run}/{RECORD}"))
    problem, remedy = f"there is nothing in {study} to run again", "leave it out the first time"
    require(there or not config.retry_failed, "retry_failed", True, problem, remedy)


def walk(specification: Specification, stages: Stages) -> None:
    """The line with stages only: nothing is read outside their computation, so that a plan can be made of it."""
    line(specification, stages, done=nothing)


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
    return {"config.yaml": yaml_text(plain(config)), "overrides.yaml": yaml_text(list(overrides))}
