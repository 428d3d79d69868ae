"""Stages of one run in their order: data, model, bounds, synthesis, closed loop.

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
from ssm_study.engine.settings import Settings, value_at_path
from ssm_study.engine.stages import Facts, StageOutput, Stages
from ssm_study.engine.task import Task, run_folder, shared_store
from ssm_study.refusal import require
from ssm_study.renamed import rename_old_settings
from ssm_study.study.allow_list import KEYS, PARTS, refuse_foreign_targets

if TYPE_CHECKING:
    from ssm_study.certificates.certificate import Design
    from ssm_study.signals import DataSet
    from ssm_study.study.specification import Specification
    from ssm_study.study.stages.free_run import ModelRun
    from ssm_study.study.stages.model import TrainedModel

LOCAL = ("ProcessesLauncher", "BasicLauncher", "JoblibLauncher")  # these run jobs on this machine


class StudyTask(Task["Specification"]):
    """Task that computes one run of a study, from measured or simulated data to the closed loop."""

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

    def refuse_invalid_configuration(self, config: DictConfig) -> None:
        """Raise `BadRequest` for a configuration with forbidden classes or unknown parts."""
        rename_old_settings(config)
        refuse_foreign_targets(config)
        known_keys = {*KEYS, *PARTS}
        remedy = "remove it, or write its part before it, as in model.order"
        for key in map(str, config):
            require(key in known_keys, key, config[key], "is no part of a study", remedy)

    def input_files(self, settings: Settings) -> list[Path]:
        """Files, such as logs of measurements, on whose content the results of a run depend."""
        # By its name: building the data to ask them would import what a finished run does without.
        simulated = str(settings["data"].get("_target_", "")).endswith(".SimulatedData")
        if simulated and "'path'" not in str(settings):
            return []
        from ssm_study.study.specification import input_files  # only for what names files

        return input_files(settings)

    def build_request(self, settings: Settings) -> "Specification":
        """Build the objects of a run, such as plant, model and training, from its settings. Raises
        `BadRequest` for every mistake that can be seen before work begins.

        Recorded data are read for it.
        """
        from ssm_study.data.simulated import SimulatedData, TrainingAmplitudeWarning

        # Imported here: a run that finds itself finished needs no parts.
        from ssm_study.study.specification import Specification

        specification = Specification.from_config(settings)
        if not isinstance(specification.data, SimulatedData):
            from ssm_study.study.read_once import read_data_set

            # Wrong columns are known only by reading.
            records = read_data_set(specification.data, specification.seed)
            specification.require_valid_input_limits(records.scale.input_equilibrium)
            if isinstance(specification.refine, list):
                from ssm_study.study.trials import read_trial_logs

                read_trial_logs(specification.refine, specification.data, records.step_s)
        elif specification.plant and specification.excitation.amplitude is not None:
            other_records = "validation, test and trials are at the plant's own amplitude"
            message = f"excitation.amplitude moves the training records alone; {other_records}."
            warnings.warn(message, TrainingAmplitudeWarning, 2)
        if self.trains_on_accelerator(specification, settings):
            from ssm_study.training.saving import build_trainer

            build_trainer(specification.training, [], Path())
        return specification

    def trains_on_accelerator(self, request: "Specification", settings: Settings) -> bool:
        """Whether the model of a run will be trained on an accelerator (GPU) of this machine.

        False for a plan, for jobs that a cluster gets, and where the model is in the store.
        """
        launcher = LOCAL[0]
        if HydraConfig.initialized():
            launcher = str(HydraConfig.get().launcher._target_)
        is_on_processor = request.training.accelerator == "cpu"
        if is_on_processor or settings.get("dry_run") or not launcher.endswith(LOCAL):
            return False
        planned = PlannedStages(shared_store(settings))
        self.run_stages(request, planned)
        return any(stage.name == "model" and not stage.reused for stage in planned.noted.values())

    def run_stages(self, request: "Specification", stages: Stages) -> None:
        """Run, or only plan, all computing steps (stages) of a run in their order.

        A baseline is scored, and there it ends. With `refine` the design is tried before it is
        chosen again.
        """
        from ssm_study.study.trials import LOGS, TRIALS  # a refusal does without

        data, _, model_run = self.identify_model(request, stages)
        if not request.model.gives_ssm:
            return
        records = data
        tried: list[StageOutput[Any]] = []
        unrecorded_store = stages.unrecorded_store()
        iterations = request.refine if isinstance(request.refine, int) else 0
        for iteration in range(1, iterations + 1):
            tried += self.design_and_close_loop(request, unrecorded_store, records, model_run)
            is_last = iteration == iterations
            records = (stages if is_last else unrecorded_store).run_stage(
                TRIALS, {}, {}, data, *tried
            )
        if isinstance(request.refine, list):
            records = stages.run_stage(LOGS, *request.stage_settings("refine", "data"), data)
        with_fresh_data = request.simulates_fresh_data
        self.design_and_close_loop(
            request, stages, records, model_run, with_fresh_data=with_fresh_data
        )

    def design_and_close_loop(
        self,
        request: "Specification",
        stages: Stages,
        data: StageOutput["DataSet"],
        model_run: StageOutput["ModelRun"],
        *,
        with_fresh_data: bool = False,
    ) -> tuple[StageOutput["Design"], StageOutput[Any]]:
        """Run the computing steps that design controller and observer and that simulate the closed
        loop."""
        from ssm_study.study.stages.evidence import EVIDENCE
        from ssm_study.study.stages.fresh_data import FRESH_DATA
        from ssm_study.study.stages.loop import LOOP
        from ssm_study.study.stages.mismatch import MISMATCH
        from ssm_study.study.stages.sine_trials import SINE_TRIALS
        from ssm_study.study.stages.synthesis import SYNTHESIS
        from ssm_study.study.stages.textbook_pi import TEXTBOOK_PI

        loop = request.loop
        plant = ("plant",) if request.plant else ()
        loop_inputs = request.stage_settings("loop", "loop_seed", *plant)
        if request.plant is not None and not request.plant.is_physical:
            stages.run_stage(TEXTBOOK_PI, *loop_inputs, model_run)
        mismatch = stages.run_stage(MISMATCH, {}, {}, data, model_run)
        judgement = stages.run_stage(EVIDENCE, {}, {}, data, model_run, mismatch)
        has_limits = loop.input_lower is not None or loop.input_upper is not None
        limits = {
            "input_lower": loop.input_lower,
            "input_upper": loop.input_upper,
            "applied": request.plant is None or has_limits,
        }
        inputs = request.stage_settings("synthesis", computed={"limits": limits})
        design = stages.run_stage(SYNTHESIS, *inputs, data, model_run, mismatch, judgement)
        if request.has_sine_trials:
            inputs = request.sine_stage_settings()
            stages.run_stage(SINE_TRIALS, *inputs, data, model_run, mismatch, judgement, design)
        if with_fresh_data:
            inputs = request.stage_settings("data", "seed", *plant)
            stages.run_stage(FRESH_DATA, *inputs, data, model_run, mismatch, design)
        closed = stages.run_stage(LOOP, *loop_inputs, data, model_run, design)
        return design, closed

    def identify_model(
        self, request: "Specification", stages: Stages
    ) -> tuple[StageOutput["DataSet"], StageOutput["TrainedModel"], StageOutput["ModelRun"]]:
        """Run the computing steps that lead from the recorded data to the identified model and its
        free-run simulations."""
        from ssm_study.study.stages.bounds import BOUNDS
        from ssm_study.study.stages.dataset import DATASET
        from ssm_study.study.stages.free_run import SCORE
        from ssm_study.study.stages.model import MODEL

        data = stages.run_stage(DATASET, *request.dataset_stage_settings())
        # In no key: a bar on the screen changes no number.
        unkeyed = {"progress": request.progress}
        inputs = request.stage_settings("model", "training", "seed", unkeyed=unkeyed)
        model = stages.run_stage(MODEL, *inputs, data)
        if request.model.gives_ssm:
            model_run = stages.run_stage(BOUNDS, *request.stage_settings("reduction"), data, model)
        else:
            model_run = stages.run_stage(SCORE, {}, {}, data, model)
        return data, model, model_run

    def final_columns(self, request: "Specification", run: Run) -> Facts:
        """Final columns of a run's record, with the status `infeasible` if controller or observer
        is missing."""
        del request
        sides = ("controller_feasible", "observer_feasible")
        is_infeasible = any(run.facts.get(name) is False for name in sides)
        seconds = run.facts.get("stage_synthesis_seconds")
        facts: Facts = {} if seconds is None else {"synthesis_seconds": seconds}
        return facts | {"status": INFEASIBLE if is_infeasible else OK}

    def parameters(self, request: "Specification") -> Facts:
        """Parameters of a run as columns of its record: numeric settings, and the kind of model,
        plant and so on.

        A number stands where the configuration has it (`Column.setting`).
        """
        from ssm_study.study.trials import refinement_columns
        from ssm_study.table.columns import SETTINGS  # pandas: a refusal does without

        configuration = request.configuration
        model = configuration["model"]
        values = {column.name: value_at_path(configuration, column.setting) for column in SETTINGS}
        numbers = {name: value for name, value in values.items() if is_number_bool_or_none(value)}
        model_kind = model.get("cell")  # gru and lstm share a class
        return numbers | {
            "model": model_kind or (class_name_of_part(model) or "").removesuffix("spec"),
            "scaffold_in": class_name_of_part(model.get("scaffold_in")),
            "scaffold_out": class_name_of_part(model.get("scaffold_out")),
            "plant": type(request.plant).__name__ if request.plant else None,
            "excitation": request.excitation.kind if request.plant else None,
            "synthesis_method": type(request.synthesis).method,
            **refinement_columns(configuration),
            "rates_chosen": automatic_rates_text(values),
        }

    def command_line_columns(self, request: "Specification", overrides: Sequence[str]) -> Facts:
        """Columns of a run's record with numbers that the command line sets for settings without a
        declared column."""
        return undeclared_number_columns(
            request.configuration, {word.partition("=")[0] for word in overrides}
        )

    def preload_modules(self, stages_to_compute: Set[str]) -> None:
        """Import, before the jobs of a sweep are forked, the modules that all of them use."""
        from ssm_study.study.preload import preload_modules

        preload_modules(stages_to_compute)


STUDY = StudyTask()


def study_folder(config: DictConfig) -> Path:
    """Folder of a study, given by its configuration: `results_dir/study`.

    Raises `BadRequest` for a name that leaves the results folder.
    """
    names = {"results_dir": config.results_dir, "study": config.study, "run": "any"}
    return run_folder(names).parent


def refuse_retry_without_runs(config: DictConfig, run: str = "*") -> None:
    """Raise `BadRequest` if failed runs are to be executed again in a study that has no runs
    yet."""
    study = study_folder(config)
    has_runs = any(study.glob(f"{run}/{RECORD}"))
    problem = f"there is nothing in {study} to run again"
    remedy = "leave it out the first time"
    # What is neither true nor false is refused with the other flags.
    require(has_runs or config.retry_failed is not True, "retry_failed", True, problem, remedy)


def undeclared_number_columns(configuration: Mapping[str, Any], keys: Iterable[str]) -> Facts:
    """Columns of a run's record with the numeric settings for which no column is declared.

    A part, as `training/optimiser` or `peer@loop.peer`, is named by its kind.
    """
    from ssm_study.table.columns import SETTINGS

    paths = {key.lstrip("+~").rpartition("@")[-1].replace("/", ".") for key in keys}
    paths -= {column.setting for column in SETTINGS}
    facts: Facts = {}
    for path in sorted(path for path in paths if "." in path):
        value = value_at_path(configuration, path)
        if not is_number_bool_or_none(value):
            value = class_name_of_part(value) or str(value)
        facts[path.replace(".", "__")] = value
    return facts


def is_number_bool_or_none(value: Any) -> bool:
    """Whether a value of a configuration is a number, a truth value or null."""
    return isinstance(value, int | float | None)


def automatic_rates_text(values: Mapping[str, Any]) -> str:
    """Text that names the gains, of controller or observer, whose contraction rate is chosen
    automatically."""
    if values["rates_chosen"] != "auto":
        return "neither"
    sides = [side for side in ("controller", "observer") if values[f"rate_{side}"] == "auto"]
    return ", ".join(sides) or "neither"


def class_name_of_part(part: Any) -> str | None:
    """Short name of the class that a configuration names, such as `monotone` for
    `...scaffolds.monotone.Monotone`."""
    target = str(part.get("_target_", "")) if isinstance(part, dict) else ""
    return target.rsplit(".", 1)[-1].lower() or None
