"""Launcher that runs the jobs of a sweep on Slurm. A job that is cancelled or loses its node
becomes a failed run, and the others are waited for."""

import time
from dataclasses import dataclass
from pathlib import Path
from traceback import format_exception
from typing import Any

import submitit
from hydra.core.singleton import Singleton
from submitit.core.utils import UncompletedJobError

from ssm_study.engine.compose import Composer
from ssm_study.engine.jobs import Job, record_death
from ssm_study.engine.launcher import Launcher, SweepContext
from ssm_study.engine.runs import Outcome, failure_columns

# What submitit's executor knows for every scheduler; all else is Slurm's own.
AUTO = frozenset(
    {"timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes", "name"}
)
# Seconds between two questions whether Slurm still knows of a job.
FORGOTTEN = "FORGOTTEN"
FORGOTTEN_S = 30.0


@dataclass(frozen=True)
class Slurm(Launcher):
    """Launcher that submits the jobs of a sweep to the cluster scheduler Slurm."""

    launcher: Any

    @property
    def max_parallel_jobs(self) -> int:  # type: ignore[override]
        """Number of jobs of a sweep that Slurm may run at the same time."""
        return int(self.launcher.params["array_parallelism"])

    def run(self, sweep: SweepContext, jobs: list[Job], composer: Composer) -> None:  # noqa: ARG002
        """Submit every unfinished job of a sweep to Slurm and wait for all of them."""
        to_do = [job for job in jobs if job.outcome is None]
        Path(str(sweep.config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        state = Singleton.get_state()  # what Hydra on the node needs of this process
        arguments = []
        for job in to_do:
            number = job.number
            arguments.append((job.overrides, "hydra.sweep.dir", number, f"{number}", state))
        slurm = submitit_executor(self.launcher.params)
        submitted = slurm.map_array(self.launcher, *zip(*arguments, strict=True))
        for job, of_slurm in zip(to_do, submitted, strict=True):
            job.outcome = wait_for_outcome(job, of_slurm)


def submitit_executor(params: dict[str, Any]) -> submitit.AutoExecutor:
    """Executor that submits jobs to Slurm by the library submitit, with the settings of the
    launcher."""
    settings = dict(params)
    slurm = submitit.AutoExecutor(
        cluster="slurm",
        folder=settings.pop("submitit_folder"),
        slurm_max_num_timeout=settings.pop("max_num_timeout"),
    )
    named = {}
    for name, value in settings.items():
        is_for_all = name in AUTO or name == "stderr_to_stdout"
        named[name if is_for_all else f"slurm_{name}"] = value
    slurm.update_parameters(**named)
    return slurm


def wait_for_outcome(job: Job, submitted: submitit.Job, patience_s: float = FORGOTTEN_S) -> Outcome:
    """Wait until a job that was submitted to Slurm has ended, and return the outcome of its run. A
    job that Slurm ended becomes a failed run that the same command repeats."""
    state = wait_for_final_state(submitted, patience_s)
    try:
        if state != FORGOTTEN:
            outcome: Outcome = submitted.results()[0].return_value
            return outcome
        problem = "Slurm no longer knows of it: it was cancelled before it began"
    except UncompletedJobError as error:
        problem = str(error)
    except Exception as error:  # the job's own, from its node: the others are waited for
        death = failure_columns(error, job.folder)
        return record_death(job.folder, death, "".join(format_exception(error)))
    message = f"Slurm ended job {submitted.job_id}: {state.lower().replace('_', ' ')}"
    death = {
        "error_type": state.title().replace("_", ""),
        "error_message": message,
        "failure_transient": True,
    }
    return record_death(job.folder, death, problem)


def wait_for_final_state(submitted: submitit.Job, patience_s: float) -> str:
    """Wait until a job that was submitted to Slurm has ended, and return its state in Slurm's
    words. Without accounting, a job cancelled in the queue is `FORGOTTEN`."""
    asked_at = time.monotonic()
    unheard = 0
    while not submitted.done():
        time.sleep(0.5)  # of files that the job leaves; Slurm itself is asked far less often
        if time.monotonic() - asked_at > patience_s:
            submitted.watcher.clear()  # it remembers for ever what Slurm once said
            unknown = submitted.watcher.get_state(submitted.job_id, mode="force") == "UNKNOWN"
            asked_at = time.monotonic()
            unheard = unheard + 1 if unknown else 0
        if unheard == 2:  # once may be a hiccup
            return FORGOTTEN
    return submitted.state.split()[0]  # "CANCELLED by 0"
