"""One run, read top to bottom: data -> model -> bounds -> synthesis -> closed loop -> record.

Each stage is a pure function of its part of the configuration and of the stages before it. It is
computed into a folder of the store, so that what is computed and what is reused are the same bits.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ssm_study.engine.plan import PlannedStages
from ssm_study.engine.records import INFEASIBLE, OK, RECORD
from ssm_study.engine.runs import Run
from ssm_study.engine.settings import Settings, entry
from ssm_study.engine.stages import Facts, StageOutput, Stages
from ssm_study.engine.task import Task, folder_of, store_of
from ssm_study.refusal import require
from ssm_study.renamed import bring_up_to_date
from ssm_study.study.allow_list import KEYS, PARTS, refuse_foreign_targets

if TYPE_CHECKING:
    from ssm_study.certificates.certificate import Design
    from ssm_study.signals import DataSet
    from ssm_study.study.specification import Specification
    from ssm_study.study.stages.free_run import ModelRun
    from ssm_study.study.stages.model import Trained

LOCAL = ("ProcessesLauncher", "BasicLauncher", "JoblibLauncher")  # these run jobs on this machine


class Study(Task["Specification"]):
    """The line of stages from data to closed loop, for one configuration."""

    libraries = (
        "torch",
        "lightning",
        "numpy",
        "scipy",
        "cvxpy",
        "clarabel",
        "python-flint",
        "hydra-core",
        "ssm-study",
    )

    def refuse(self, config: DictConfig) -> None:
        bring_up_to_date(config)
        refuse_foreign_targets(config)
        for key in map(str, config):
            require(
                key in {*KEYS, *PARTS},
                key,
                config[key],
                "is no part of a study",
                "leave it out, or name its part",
            )

    def inputs(self, settings: Settings) -> list[Path]:
        # By its name: building the data to ask them would import what a finished run does without.
        simulated = str(settings["data"].get("_target_", "")).endswith(".SimulatedData")
        if simulated and "'path'" not in str(settings):
            return []
        from ssm_study.study.specification import files_of  # only for what names files

        return files_of(settings)

    def check(self, settings: Settings) -> "Specification":
        """Raises `BadRequest` for whatever can be known beforehand; recorded data are read for
        it."""
        from ssm_study.data.simulated import SimulatedData, TrainingAlone
        from ssm_study.study.specification import (
            Specification,
        )  # what finds itself finished needs no parts

        specification = Specification.from_config(settings)
        if not isinstance(specification.data, SimulatedData):
            found = specification.data.build(
                specification.seed
            )  # wrong columns are known only by reading
            specification.refuse_limits(found.scale.input_equilibrium)
            if isinstance(specification.refine, list):
                from ssm_study.study.trials import read_logs

                read_logs(specification.refine, specification.data, found.step_s)
        elif specification.plant and specification.excitation.amplitude is not None:
            others = "validation, test and trials are at the plant's own amplitude"
            warnings.warn(
                f"excitation.amplitude moves the training records alone; {others}.",
                TrainingAlone,
                2,
            )
        if self.trains_here(specification, settings):
            from ssm_study.training.saving import trainer_of

            trainer_of(specification.training, [], Path())
        return specification

    def trains_here(self, request: "Specification", settings: Settings) -> bool:
        """False for a plan, for jobs that a cluster gets, and where the model is in the store."""
        launcher = (
            str(HydraConfig.get().launcher._target_) if HydraConfig.initialized() else LOCAL[0]
        )
        if (
            request.training.accelerator == "cpu"
            or settings.get("dry_run")
            or not launcher.endswith(LOCAL)
        ):
            return False
        self.stages(request, planned := PlannedStages(store_of(settings)))
        return any(stage.name == "model" and not stage.reused for stage in planned.noted.values())

    def stages(self, request: "Specification", stages: Stages) -> None:
        """A baseline is scored, and there it ends. With `refine` the design is tried before it is
        chosen again."""
        from ssm_study.study.trials import LOGS, TRIALS  # a refusal does without

        data, _, bounded = self.identified(request, stages)
        if not request.model.gives_ssm:
            return
        known = data
        tried = list[StageOutput[Any]]()
        unrecorded = stages.unrecorded()
        for left in reversed(range(request.refine if isinstance(request.refine, int) else 0)):
            tried += self.designed(request, unrecorded, known, bounded)
            known = (unrecorded if left else stages).run_stage(TRIALS, {}, {}, data, *tried)
        if isinstance(request.refine, list):
            known = stages.run_stage(LOGS, *request.select("refine", "data"), data)
        self.designed(request, stages, known, bounded, with_fresh_data=request.has_fresh_sets)

    def designed(
        self,
        request: "Specification",
        stages: Stages,
        data: StageOutput["DataSet"],
        bounded: StageOutput["ModelRun"],
        *,
        with_fresh_data: bool = False,
    ) -> tuple[StageOutput["Design"], StageOutput[Any]]:
        """Controller and observer by what these records show, and the loop that they close."""
        from ssm_study.study.stages.evidence import EVIDENCE
        from ssm_study.study.stages.fresh_data import FRESH_DATA
        from ssm_study.study.stages.loop import LOOP
        from ssm_study.study.stages.mismatch import MISMATCH
        from ssm_study.study.stages.synthesis import SYNTHESIS

        plant = ("plant",) if request.plant else ()
        shown = stages.run_stage(MISMATCH, {}, {}, data, bounded)
        judged = stages.run_stage(EVIDENCE, {}, {}, data, bounded, shown)
        limits = {name: getattr(request.loop, name) for name in ("input_lower", "input_upper")}
        bounded_law = (
            request.plant is None or request.synthesis.invert_input
        )  # to what the records visited
        limits["applied"] = bounded_law or any(end is not None for end in limits.values())
        inputs = request.select("synthesis", computed={"limits": limits})
        design = stages.run_stage(SYNTHESIS, *inputs, data, bounded, shown, judged)
        if with_fresh_data:
            inputs = request.select("data", "seed", *plant)
            stages.run_stage(FRESH_DATA, *inputs, data, bounded, shown, design)
        inputs = request.select("loop", "loop_seed", *plant)
        return design, stages.run_stage(LOOP, *inputs, data, bounded, design)

    def identified(
        self, request: "Specification", stages: Stages
    ) -> tuple[StageOutput["DataSet"], StageOutput["Trained"], StageOutput["ModelRun"]]:
        """The data, the model as trained, and as it goes on: what is proved of it, or how well a
        baseline simulates."""
        from ssm_study.study.stages.bounds import BOUNDS
        from ssm_study.study.stages.dataset import DATASET
        from ssm_study.study.stages.free_run import SCORE
        from ssm_study.study.stages.model import MODEL

        data = stages.run_stage(DATASET, *request.dataset_inputs())
        # In no key: a bar on the screen changes no number.
        unkeyed = {"progress": request.progress}
        inputs = request.select("model", "training", "seed", unkeyed=unkeyed)
        model = stages.run_stage(MODEL, *inputs, data)
        if not request.model.gives_ssm:
            return data, model, stages.run_stage(SCORE, {}, {}, data, model)
        return data, model, stages.run_stage(BOUNDS, *request.select("reduction"), data, model)

    def run(self, request: "Specification", run: Run) -> Facts:
        """Infeasible where controller or observer is missing."""
        del request
        missing = (
            run.facts.get("controller_feasible") is False
            or run.facts.get("observer_feasible") is False
        )
        seconds = run.facts.get("stage_synthesis_seconds")
        facts = {} if seconds is None else {"synthesis_seconds": seconds}
        return facts | {"status": INFEASIBLE if missing else OK}

    def parameters(self, request: "Specification") -> Facts:
        """The settings that a study is read by: a number where the configuration has it
        (`Column.setting`), a part by its kind."""
        from ssm_study.study.trials import lineage
        from ssm_study.table.columns import SETTINGS  # pandas: a refusal does without

        model = request.configuration["model"]
        asked = {column.name: entry(request.configuration, column.setting) for column in SETTINGS}
        auto = asked["rates_chosen"] == "auto"
        chosen = [
            side for side in ("controller", "observer") if auto and asked[f"rate_{side}"] == "auto"
        ]
        return {
            name: value for name, value in asked.items() if isinstance(value, int | float | None)
        } | {
            "model": model.get("cell")
            or (kind_of(model) or "").removesuffix("spec"),  # gru and lstm share a class
            "scaffold_in": kind_of(model.get("scaffold_in")),
            "scaffold_out": kind_of(model.get("scaffold_out")),
            "plant": type(request.plant).__name__ if request.plant else None,
            "excitation": request.excitation.kind if request.plant else None,
            "synthesis_method": type(request.synthesis).method,
            **lineage(request.configuration),
            "rates_chosen": ", ".join(chosen) or "neither",
        }

    def asked(self, request: "Specification", overrides: Sequence[str]) -> Facts:
        return further(request.configuration, {word.partition("=")[0] for word in overrides})

    def preload(self, again: Set[str]) -> None:
        from ssm_study.study.preload import preload

        preload(again)


STUDY = Study()


def study_folder(config: DictConfig) -> Path:
    """`results_dir/study`; raises `BadRequest` for a name that leaves the results folder."""
    return folder_of(
        {"results_dir": config.results_dir, "study": config.study, "run": "any"}
    ).parent


def check_retry(config: DictConfig, run: str = "*") -> None:
    """Raise `BadRequest` where failed runs are to be run again and there is no run yet."""
    study = study_folder(config)
    there = any(study.glob(f"{run}/{RECORD}"))
    problem = f"there is nothing in {study} to run again"
    remedy = "leave it out the first time"
    require(there or not config.retry_failed, "retry_failed", True, problem, remedy)


def further(configuration: Mapping[str, Any], keys: Iterable[str]) -> Facts:
    """Columns for the keys that have none declared: the value at `plant.step_s` becomes
    `plant__step_s`.

    Of a part, `training/optimiser` or `peer@loop.peer`, its kind.
    """
    from ssm_study.table.columns import SETTINGS

    paths = {key.lstrip("+~").rpartition("@")[-1].replace("/", ".") for key in keys}
    facts: Facts = {}
    for path in sorted(
        path for path in paths - {column.setting for column in SETTINGS} if "." in path
    ):
        value = entry(configuration, path)
        facts[path.replace(".", "__")] = (
            value if isinstance(value, int | float | None) else kind_of(value) or str(value)
        )
    return facts


def kind_of(scaffold: Any) -> str | None:
    """`ssm_study.models.scaffolds.monotone.Monotone` -> `monotone`."""
    target = str(scaffold.get("_target_", "")) if isinstance(scaffold, dict) else ""
    return target.rsplit(".", 1)[-1].lower() or None
