"""A sweep by Slurm: a job that is cancelled or loses its node is a row of the table, and the others are waited for."""

import time
from pathlib import Path
from typing import Any

import submitit
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn
from submitit.core.utils import UncompletedJobError

from ssm_study.sweeps.deaths import note_death
from ssm_study.sweeps.sweep import Job, jobs_of

AUTO = frozenset({"timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes", "name"})
"""What submitit's executor knows for every scheduler; all else is Slurm's own."""
FORGOTTEN, FORGOTTEN_S = "FORGOTTEN", 30.0


def launch(launcher: Any, overrides: list[list[str]], first_number: int) -> list[JobReturn]:
    """Submit every job through `launcher`, which Slurm's nodes call; one `JobReturn` each, in the same order."""
    config = launcher.config
    jobs = jobs_of(launcher.hydra_context.config_loader, config, overrides, first_number)
    Path(str(config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
    state = Singleton.get_state()
    arguments = [(words, "hydra.sweep.dir", first_number + i, f"{i}", state) for i, words in enumerate(overrides)]
    submitted = executor(launcher.params).map_array(launcher, *zip(*arguments, strict=True))
    return [settled(job, one) for job, one in zip(jobs, submitted, strict=True)]


def executor(params: dict[str, Any]) -> submitit.AutoExecutor:
    """submitit's executor with the settings of `hydra.launcher`."""
    slurm = submitit.AutoExecutor(
        cluster="slurm", folder=params["submitit_folder"], slurm_max_num_timeout=params["max_num_timeout"]
    )
    settings = {name: value for name, value in params.items() if name not in ("submitit_folder", "max_num_timeout")}
    named = {name if name in AUTO | {"stderr_to_stdout"} else f"slurm_{name}": v for name, v in settings.items()}
    slurm.update_parameters(**named)
    return slurm


def settled(job: Job, submitted: submitit.Job, patience_s: float = FORGOTTEN_S) -> JobReturn:
    """What the job returned; or, if Slurm ended it, a failed run that the same command does again."""
    state = ended(submitted, patience_s)
    try:
        if state != FORGOTTEN:
            return submitted.results()[0]
        problem = "Slurm no longer knows of it: it was cancelled before it began"
    except UncompletedJobError as error:
        problem = str(error)
    message = f"Slurm ended job {submitted.job_id}: {state.lower().replace('_', ' ')}"
    death = {"error_type": state.title().replace("_", ""), "error_message": message, "failure_transient": True}
    return job.returned(note_death(job.folder, death, problem))


def ended(submitted: submitit.Job, patience_s: float) -> str:
    """Wait for the end; Slurm's word for it. Without accounting it forgets a job that is cancelled while it waits."""
    asked, unheard = time.monotonic(), 0
    while not submitted.done():
        time.sleep(0.5)
        if time.monotonic() - asked > patience_s:
            submitted.watcher.clear()  # it remembers for ever what Slurm once said
            unknown = submitted.watcher.get_state(submitted.job_id, mode="force") == "UNKNOWN"
            asked, unheard = time.monotonic(), unheard + 1 if unknown else 0
        if unheard == 2:  # once may be a hiccup
            return FORGOTTEN
    return submitted.state.split()[0]  # "CANCELLED by 0"
