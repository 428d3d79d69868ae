"""Inside one job's process: its own group, its own log, no life after its sweep, and a record whatever happens."""

import contextlib
import ctypes
import faulthandler
import os
import signal
import sys
import threading
import traceback
from multiprocessing import parent_process
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from ssm_study.results.naming import register_resolver
from ssm_study.results.records import read_record
from ssm_study.results.runs import error_facts, write_failure

LOG = "run.log"
PR_SET_PDEATHSIG = 1
OUT_OF_MEMORY_SCORE = 500  # when memory runs out the system stops a job, not the sweep


def run_in_this_process(
    folder: Path,
    config: DictConfig,
    hydra_context: HydraContext,
    task_function: TaskFunction,
    singletons: dict[Any, Any],
) -> None:
    """The main function of a job's process: Hydra's job, with all output in `folder/run.log`."""
    _become_own_group()
    _die_with_the_sweep()
    _speak_into(folder)
    _adopt(task_function, singletons)
    done = run_job(
        hydra_context=hydra_context,
        task_function=task_function,
        config=config,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
    )
    if done.status is JobStatus.FAILED and isinstance(done._return_value, BaseException):
        _record_uncaught(folder, done._return_value)
        sys.exit(1)


def train_in_this_process(
    folder: Path, configs: list[DictConfig], task_function: TaskFunction, singletons: dict[Any, Any]
) -> None:
    """The main function of a process that trains models together: the task's `train_members`, logged as a job is."""
    _become_own_group()
    _die_with_the_sweep()
    _speak_into(folder)
    _adopt(task_function, singletons)
    sys.modules[task_function.__module__].train_members(configs)


def _adopt(task_function: TaskFunction, singletons: dict[Any, Any]) -> None:
    """Hydra's state as the sweep has it, and the resolvers that its task's module registers."""
    setup_globals()
    register_resolver()
    register_more = getattr(sys.modules[task_function.__module__], "register_resolvers", None)
    if register_more is not None:
        register_more()
    Singleton.set_state(Singleton.get_state() | {"instances": singletons})


def _become_own_group() -> None:
    os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OUT_OF_MEMORY_SCORE))


def _die_with_the_sweep() -> None:
    """When the sweep's process is gone, however it went, so are this job and whatever it has started."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # the server's death, should this process hang
    sweep = parent_process()
    assert sweep is not None

    def watch() -> None:
        wait([sweep.sentinel])
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


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
