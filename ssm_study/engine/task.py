"""Interface of tasks that are run many times. The engine knows nothing else of it."""

import inspect
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ssm_study.durable import sha256_of_file
from ssm_study.engine.plan import plan_lines
from ssm_study.engine.provenance import provenance_columns
from ssm_study.engine.runs import (
    Outcome,
    Run,
    execute_run,
    existing_outcome,
    needs_execution,
    record_with_status,
)
from ssm_study.engine.settings import Settings, digest_of_value, plain_settings, yaml_text
from ssm_study.engine.stages import Compute, Facts, StageOutput, StageResult, Stages
from ssm_study.engine.store import Store
from ssm_study.refusal import require

R = TypeVar("R")

INPUTS = "inputs_sha256"
# Settings that say how a run is done, not what it is.
FLAGS = frozenset({"progress", "dry_run", "retry_failed", "strict"})
# Requests by their folder; jobs that are forked off a sweep find theirs here.
_CHECKED: dict[Path, Any] = {}


class Task(ABC, Generic[R]):
    """Base class of a program's task: checks a configuration, runs the computing steps of a run,
    and completes the record.

    Hydra calls `run_job`. The settings have the keys `study`, `results_dir`, `run`
    (`${run_name:...}`), `retry_failed` and `dry_run`; all others are the task's own. `libraries`
    are the distributions whose versions a record notes.
    """

    libraries: tuple[str, ...] = ()

    @abstractmethod
    def build_request(self, settings: Settings) -> R:
        """Build the objects that the settings of a run describe. Raises `BadRequest` for every
        mistake that can be seen before long work."""

    @abstractmethod
    def run_stages(self, request: R, stages: Stages) -> None:
        """Run, or only plan, every computing step (stage) of a run, depending on the given store of
        results."""

    def final_columns(self, request: R, run: Run) -> Facts:  # noqa: ARG002
        """Columns of a run's record that can only be computed after all computing steps.
        `run.facts` holds the stages' columns, `status` may be `infeasible`."""
        return {}

    def parameters(self, request: R) -> Facts:  # noqa: ARG002
        """Parameters of a run, which are columns of its record from the beginning."""
        return {}

    def command_line_columns(self, request: R, overrides: Sequence[str]) -> Facts:  # noqa: ARG002
        """Columns of a run's record that depend only on the command line."""
        return {}

    def refuse_invalid_configuration(self, config: DictConfig) -> None:
        """Raise `BadRequest` for a configuration with forbidden content, before anything in the
        configuration is resolved or instantiated."""

    def input_files(self, settings: Settings) -> list[Path]:  # noqa: ARG002
        """Files on whose content the results of a run depend. A finished run is out of date once
        their content changes."""
        return []

    def preload_modules(self, stages_to_compute: Set[str]) -> None:
        """Import everything that the jobs of a sweep would import, once before the first job is
        forked.

        `stages_to_compute` names the stages that several jobs will compute; modules that only other
        stages need are left to the job.
        """

    def provenance(self) -> Facts:
        """Columns that say how results were made: commit, versions and machine."""
        return provenance_columns(self.libraries, Path(inspect.getfile(type(self))))

    def settings(self, config: DictConfig | Settings) -> Settings:
        """Convert a configuration to plain settings, after a check for forbidden content. Raises
        `BadRequest` for such content."""
        if not isinstance(config, Settings):
            self.refuse_invalid_configuration(config)
        settings = plain_settings(config)
        for name in FLAGS & settings.keys():
            value = settings[name]
            problem = "is neither true nor false"
            require(isinstance(value, bool), name, value, problem, "write true or false")
        return settings

    def request(self, config: DictConfig | Settings) -> R:
        """Checked objects that the configuration of a run describes, built only once in each run
        and process."""
        settings = self.settings(config)
        folder = run_folder(settings).absolute()
        if folder not in _CHECKED:
            _CHECKED[folder] = self.build_request(settings)
        checked_request: R = _CHECKED[folder]
        return checked_request

    def run_job(self, config: DictConfig | Settings) -> Outcome:
        """Execute the run that a configuration describes and write its record, unless the run is
        finished."""
        settings = self.settings(config)
        # Before anything is built: a finished run costs next to nothing.
        outcome = self.outcome_without_running(settings)
        if settings.get("dry_run"):
            runners = [lambda stages: self.run_stages(self.request(settings), stages)]
            if outcome is not None:
                runners = []
            store = shared_store(settings)
            lines = plan_lines(store, runners, run_count=1, finished_count=1 - len(runners))
            print("\n".join(lines))
            return outcome or Outcome(folder=run_folder(settings), status="absent", did="planned")
        if outcome is not None:
            return outcome
        request = self.request(settings)

        def run_all_stages(run: Run) -> Facts:
            """Run every computing step of a run, and return the columns that complete its
            record."""
            announces = settings.get("progress") is True and sys.stderr.isatty()
            self.run_stages(request, RunStages(shared_store(settings).root, run, announces))
            return self.final_columns(request, run)

        overrides = list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
        parameters = self.parameters(request) | self.command_line_columns(request, overrides)
        inputs = self.input_files(settings)
        if inputs:
            parameters |= {INPUTS: files_checksum(inputs)}
        return execute_run(
            run_folder(settings),
            parameters,
            run_all_stages,
            configuration={
                "config.yaml": yaml_text(settings),
                "overrides.yaml": yaml_text(overrides),
            },
            provenance=self.provenance(),
            retry_failed=bool(settings.retry_failed),
        )

    def outcome_without_running(self, config: DictConfig | Settings) -> Outcome | None:
        """Outcome of a run that need not be executed; None for a run that must be executed.

        Raises `BadRequest` for a finished run whose input files have changed since.
        """
        settings = self.settings(config)
        folder = run_folder(settings)
        before = record_with_status(folder)
        if needs_execution(before, bool(settings.get("retry_failed"))):
            return None
        outcome = existing_outcome(folder, before)
        files = self.input_files(settings) if outcome.did == "found" else []
        if before is not None and files:
            digest_then = before.get(INPUTS)  # none where the run read no files
            names = ", ".join(str(path) for path in files)
            problem = f"{names} changed since this run was done"
            remedy = "give study a new name, or remove the folder"
            require(digest_then in (None, files_checksum(files)), "run", folder, problem, remedy)
        return outcome


@dataclass(frozen=True)
class RunStages(Store):
    """Store of results that notes each computing step in the record of a run and copies its files
    into the run folder. So the run stays complete when the store is removed."""

    run: Run
    announces: bool = False

    def stage_result(
        self, name: str, key: str, note: dict[str, Any], compute: Compute
    ) -> StageResult:
        """Result of a computing step of a run, read from the store, or else announced and
        computed."""

        def compute_announced_stage(folder: Path) -> None:
            """Print the name of a computing step, then compute the step."""
            if self.announces:
                print(f"ssm-study: {name} ...", file=sys.stderr, flush=True)
            compute(folder)

        result = super().stage_result(name, key, note, compute_announced_stage)
        self.run.stage_folders.append(result.path)
        return result

    def stage_columns(self, output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:
        """Table columns that describe a computing step of a run, noted in the run's record."""
        facts = super().stage_columns(output, before)
        self.run.record_stage(
            output.result, output.stage.files, facts
        )  # at once: a later one may fail
        return facts

    def unrecorded_store(self) -> Store:
        """Copy of a store of results that does not log computing steps in the run's record."""
        return Store(self.root)


PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=,+-]{0,199}")
CHARACTERS_OF_A_NAME = "use letters, digits, '.', '_' and '-', at most 200 of them"


def run_folder(settings: Mapping[str, Any]) -> Path:
    """Folder of a run, given by its settings: `results_dir/study/run`. Raises `BadRequest` for
    names that lead out of the results folder."""
    names = {key: settings[key] for key in ("results_dir", "study", "run")}
    for key, name in names.items():
        require(isinstance(name, str) and name != "", key, name, "is no name", "give a text")
        if key != "results_dir":
            is_plain = PLAIN_NAME.fullmatch(name) is not None
            require(is_plain, key, name, "not a plain folder name", CHARACTERS_OF_A_NAME)
    return Path(*names.values())


def files_checksum(files: list[Path]) -> str:
    """Joint checksum of the content of several files in a given order."""
    return digest_of_value([sha256_of_file(path) if path.is_file() else None for path in files])


def shared_store(config: DictConfig | Settings) -> Store:
    """Store of computed results that all studies in a results folder share."""
    return Store(Path(str(config["results_dir"])) / ".store")


def find_task(task_function: Any) -> Task[Any]:
    """Find the task object behind the function that was given to Hydra."""
    task = getattr(task_function, "__self__", None)
    assert isinstance(task, Task), "Hydra calls the method `job` of a Task"
    return task
