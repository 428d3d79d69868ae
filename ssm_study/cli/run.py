"""The command `ssm-study run`, which composes one run or a sweep by Hydra and explains every wrong
request in plain words."""

import gc
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ssm_study import THREADS, limit_threads
from ssm_study.cli.browser import open_page
from ssm_study.cli.exit_status import DONE, SOME_FAILED, storage_error
from ssm_study.cli.hydra_errors import explain_hydra_error, refuse_dashed_settings
from ssm_study.cli.request import (
    JUST_ASKING,
    OPEN,
    check_jobs_before_start,
    compose_request,
    translate_arguments,
)
from ssm_study.cli.summary import print_run_summary, print_sweep_summary
from ssm_study.engine.compose import HydraCommandLine, clear_hydra_state
from ssm_study.extensions import configuration_folder
from ssm_study.refusal import BadRequest, require

NOTHING_SET = "no setting given: this is the paper's motor (experiment=paper); --help lists others"
PYTHONS_WARNING = warnings.formatwarning


def refuse_more_threads_than_cores() -> None:
    """Raise `BadRequest` if an environment variable sets a thread count that is no number or
    exceeds the available cores."""
    limit_threads()  # a program that calls `run` has not
    cores = len(os.sched_getaffinity(0))
    for variable in THREADS:
        count = os.environ[variable]
        fits = count.isdigit() and 1 <= int(count) <= cores
        problem = f"this machine gives {cores} cores"
        require(fits, variable, count, problem, f"set it to a number from 1 to {cores}")


def _warning_text(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Text of a Python warning, without the line of code that raised it."""
    if category.__module__.startswith("ssm_study"):
        return f"ssm-study: {message}\n"
    return PYTHONS_WARNING(message, category, filename, lineno, line)


def run(overrides: list[str]) -> int:
    """Run one study, or with `-m` a sweep of several runs, for given command-line arguments. Raises
    `BadRequest` for a wrong request. Options and `--help` are Hydra's."""
    warnings.formatwarning = _warning_text
    refuse_more_threads_than_cores()
    refuse_dashed_settings(overrides, configuration_folder())
    opens = OPEN in overrides
    if not any("=" in word for word in overrides) and not set(overrides) & {"--help", "-h"}:
        print(f"ssm-study: {NOTHING_SET}", file=sys.stderr, flush=True)
    overrides = translate_arguments(overrides)
    # Hydra then raises instead of printing, so that a sentence can be made of it.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = ["ssm-study run", *overrides]
    try:
        return execute_request(overrides, opens)
    except (HydraException, OmegaConfBaseException) as error:
        raise explain_hydra_error(error, overrides, configuration_folder()) from error
    except ValueError as error:
        explanation = explain_invalid_choice(error, overrides)
        if explanation is None:
            raise
        raise explanation from error
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        raise storage_error("results_dir", error, results_folder(overrides)) from error
    finally:
        clear_hydra_state()


def results_folder(overrides: list[str]) -> str:
    """Results folder that the command line names, otherwise the default of the configuration."""
    words = (word.partition("=") for word in overrides)
    named = [value for name, _, value in words if name == "results_dir"]
    return named[-1] if named else "results"


def execute_request(overrides: list[str], opens_page: bool) -> int:
    """Do what a `run` command requests: print the help, print Hydra's information, or run the
    study. Returns the exit status."""
    folder = configuration_folder()
    if any(word in ("--help", "-h") for word in overrides):
        HydraCommandLine(overrides, folder, "study").print_help()
        return DONE
    if any(word.split("=")[0] in JUST_ASKING for word in overrides):
        hydra_main = hydra.main(version_base="1.3", config_path=str(folder), config_name="study")
        hydra_main(lambda _: None)()
        return DONE
    print_activity("reading the request")
    request = compose_request(overrides, folder, "study")
    with check_jobs_before_start(request):
        print_activity("loading the libraries")
        request.execute(_task_function())
    if request.config.dry_run:
        return DONE
    failed = print_study_summary(request)
    if opens_page:
        write_and_open_page(request)
    return SOME_FAILED if failed else DONE


def explain_invalid_choice(error: ValueError, overrides: list[str]) -> BadRequest | None:
    """Error message for a number or null in place of the name of a choice, which Hydra reports
    unclearly. None for any other error."""
    message = str(error)
    if "integer string conversion" in message:
        problem = "contains a number with thousands of digits"
        return BadRequest("request", " ".join(overrides), problem, "write it shorter")
    if "Config group override" in message:
        return explain_hydra_error(error, overrides, configuration_folder())
    return None


def print_activity(activity: str) -> None:
    """Print, on a terminal only, a line that says what the program is doing."""
    if sys.stderr.isatty():
        print(f"ssm-study: {activity} ...", file=sys.stderr, flush=True)


def write_and_open_page(request: HydraCommandLine) -> None:
    """Write the report page of a study and open the page in the browser."""
    from ssm_study.report.page.writing import write_page
    from ssm_study.study.line import study_folder

    page = write_page(study_folder(request.config))
    print(page)
    open_page(page)


def print_study_summary(request: HydraCommandLine) -> bool:
    """Gather and print the results table of a study; return whether a run failed. A single run is
    drawn."""
    return (
        print_sweep_summary(request.config)
        if request.is_sweep
        else print_run_summary(request.config)
    )


def _task_function() -> Callable[[DictConfig], Any]:
    """Function that Hydra calls for each run of a sweep."""
    # It would look at five thousand modules again and again, and once more at the end: 3 s.
    gc.disable()
    from ssm_study.study import line as study

    gc.enable()
    gc.freeze()  # the modules stay until the end: later collections pass over them
    return study.STUDY.run_job
