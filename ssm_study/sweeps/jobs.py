"""Inside one job's process: its own group, its own log, no life after its sweep, and a record whatever happens."""

import contextlib
import faulthandler
import os
import sys
import traceback
from pathlib import Path

from hydra.core.utils import JobReturn, JobStatus, configure_log
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from ssm_study.results.records import read_record
from ssm_study.results.runs import error_facts, write_failure
from ssm_study.sweeps.sweep import adopt

LOG = "run.log"
OUT_OF_MEMORY_SCORE = 500  # when memory runs out the system stops a job, not the sweep


def run_in_this_process(
    folder: Path, config: DictConfig, hydra_context: HydraContext, task_function: TaskFunction
) -> None:
    """The main function of a job's process, with all output in `folder/run.log`.

    What Hydra's `run_job` does in a process that goes on to other jobs, without the copies it needs to undo it.
    """
    _become_own_group()
    _speak_into(folder)
    with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
        config.hydra.runtime.output_dir = str(folder)
    adopt(config)
    task_config = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    if config.hydra.job.chdir:
        os.chdir(folder)
    configure_log(config.hydra.job_logging, config.hydra.verbose)
    os.environ.update(config.hydra.job.env_set)
    hydra_context.callbacks.on_job_start(config=config, task_function=task_function)
    ended = JobReturn(overrides=config.hydra.overrides.task, cfg=task_config)
    try:
        ended.return_value, ended.status = task_function(task_config), JobStatus.COMPLETED
    except Exception as error:  # whatever the task raises
        ended.return_value, ended.status = error, JobStatus.FAILED
        _record_uncaught(folder, error)
    hydra_context.callbacks.on_job_end(config=config, job_return=ended)
    if ended.status is JobStatus.FAILED:
        sys.exit(1)


def train_in_this_process(folder: Path, configs: list[DictConfig], task_function: TaskFunction) -> None:
    """The main function of a process that trains models together: the task's `train_members`, logged as a job is."""
    _become_own_group()
    _speak_into(folder)
    sys.modules[task_function.__module__].train_members(configs)


def _become_own_group() -> None:
    os.setsid()
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OUT_OF_MEMORY_SCORE))


def _speak_into(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    log = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(source, target)
    faulthandler.enable()  # a crash in native code leaves its Python traceback in the log


def _record_uncaught(folder: Path, error: BaseException) -> None:
    text = "".join(traceback.format_exception(error))
    print(text, file=sys.stderr)
    facts = {"study": folder.parent.name, "run": folder.name} | (read_record(folder) or {})
    write_failure(folder, facts, error_facts(error), text)
