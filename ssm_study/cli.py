"""`ssm-study`: the command line. Exit status 0 done, 1 some runs failed (the rest is kept), 2 the request was wrong."""

import argparse
import gc
import os
import sys
import warnings
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from ssm_study import __version__
from ssm_study.refusal import BadRequest, require

PYTHONS_WARNING = warnings.formatwarning
DONE, SOME_FAILED, WRONG_REQUEST = 0, 1, 2
COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def main(arguments: list[str] | None = None) -> int:
    """Run one `ssm-study` command; returns its exit status."""
    limit_threads()
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments[:1] == ["run"]:
            return run(arguments[1:])
        options = _parser().parse_args(arguments or ["--help"])
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except BadRequest as refusal:
        print(f"ssm-study: {refusal}", file=sys.stderr)
        return WRONG_REQUEST
    except KeyboardInterrupt:
        print("ssm-study: interrupted; the same command again does what is missing", file=sys.stderr)
        sys.excepthook = lambda *_: None  # without a traceback, yet ended by the signal: a script's loop ends with it
        raise
    except BrokenPipeError:  # `ssm-study show STUDY | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE


def limit_threads() -> None:
    """Before torch is imported: one thread, unless the environment says otherwise (two processes with as many threads
    as cores each are 20 times slower). Single runs and Hydra's basic launcher work in this very process."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    for variable in COUNTS:
        os.environ.setdefault(variable, "1")


def refuse_more_threads_than_cores() -> None:
    """Refuse a count of threads in the environment that is no number or more than the cores this process may use."""
    cores = len(os.sched_getaffinity(0))
    for variable in COUNTS:
        asked = os.environ[variable]
        fits = asked.isdigit() and 1 <= int(asked) <= cores
        require(fits, variable, asked, f"this machine gives {cores} cores", f"set it to a number from 1 to {cores}")


def _warned(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Our own warnings are sentences for the user: without the line of code that gave them."""
    ours = category.__module__.startswith("ssm_study")
    return f"ssm-study: {message}\n" if ours else PYTHONS_WARNING(message, category, filename, lineno, line)


def configuration_folder() -> Path:
    """Where the configuration lies: inside the installed package, or beside it in a clone."""
    package = Path(str(files("ssm_study")))
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def run(overrides: list[str]) -> int:
    """One study run, or with `-m` a Hydra multirun; options and `--help` are Hydra's. Refuses a wrong request."""
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from ssm_study.advice import advised, refuse_dashes
    from ssm_study.sweeps.request import asks_only, check_request, translate

    warnings.formatwarning = _warned
    refuse_more_threads_than_cores()
    refuse_dashes(overrides, configuration_folder())
    overrides = translate(overrides)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of printing, so that a sentence can be made of it
    sys.argv = ["ssm-study run", *overrides]
    StudyCallback.conclude = StudyCallback.stop_watching = None
    hydra_main = hydra.main(version_base="1.3", config_path=str(configuration_folder()), config_name="study")
    try:
        check_request(overrides, configuration_folder(), "study")  # what is loaded next takes five times as long
        hydra_main(_nothing if asks_only(overrides) else _job())()
        return SOME_FAILED if StudyCallback.conclude and StudyCallback.conclude() else DONE
    except (HydraException, OmegaConfBaseException) as error:
        raise advised(error, overrides, configuration_folder()) from error
    except OSError as error:
        problem = error.strerror or type(error).__name__
        raise BadRequest("results_dir", error.filename, problem, "choose a folder that you may write to") from error


def _nothing(_: DictConfig) -> None:
    """For a request that Hydra answers by itself."""


def _job() -> Callable[[DictConfig], Any]:
    gc.disable()  # it would look at five thousand modules again and again, and once more when the program ends: 3 s
    from ssm_study import study

    gc.enable()
    gc.freeze()
    return study.job


class StudyCallback(Callback):
    """Before a run: refuse what is wrong. After it: note what remains to be done, for Hydra swallows what that raises.

    `conclude()` gathers the study, draws its figures and says how it went; True if runs failed.
    """

    conclude: Callable[[], bool] | None = None
    stop_watching: Callable[[], None] | None = None

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        from ssm_study import study

        _refusing(lambda: study.check(config))
        _refusing(lambda: study.check_retry(config, study.run_name(config)))

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        from ssm_study import study
        from ssm_study.sweeps.request import check_sweep

        _refusing(lambda: study.check_retry(config))
        if "ssm_study" not in str(config.hydra.launcher._target_):  # our launcher checks its jobs itself
            _refusing(lambda: self._watch([job.folder for job in check_sweep(config, study.job)]))

    def on_run_end(self, config: DictConfig, **_: Any) -> None:
        from ssm_study import study

        StudyCallback.conclude = partial(study.conclude_run, config)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        from ssm_study import study

        if StudyCallback.stop_watching:
            StudyCallback.stop_watching()  # its last line comes before the table
        if not config.dry_run:
            StudyCallback.conclude = partial(study.conclude_sweep, config)

    def _watch(self, folders: list[Path]) -> None:
        from ssm_study.sweeps.progress import Watch

        if folders:
            watch = Watch(folders)
            watch.start()
            StudyCallback.stop_watching = watch.finish


def _refusing(check: Callable[[], object]) -> None:
    """Hydra swallows the exceptions of callbacks, but not an exit."""
    try:
        check()
    except BadRequest as refusal:
        print(f"ssm-study: {refusal}", file=sys.stderr)
        raise SystemExit(WRONG_REQUEST) from refusal


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ssm-study",
        description="From input-output data to a certified output-feedback controller, swept and reported.",
    )
    parser.add_argument("--version", action="version", version=f"ssm-study {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.add_parser("run", help="one study run, or with -m a sweep; see `ssm-study run --help`", add_help=False)
    for name, (action, subject, told) in ACTIONS.items():
        command = commands.add_parser(name, help=told, description=told[0].upper() + told[1:] + ".")
        command.add_argument(subject, type=Path, metavar=subject.upper(), help=SUBJECTS[subject])
        command.set_defaults(command=partial(_on_its_folder, action, subject))
        for words, settings in OPTIONS.get(name, {}).items():
            command.add_argument(words, **settings)
    return parser


def _on_its_folder(action: Callable[[argparse.Namespace], int], subject: str, options: argparse.Namespace) -> int:
    from ssm_study.results import folders

    found = {"study": folders.study_folder, "run": folders.run_folder}[subject](getattr(options, subject))
    setattr(options, subject, found)
    return action(options)


def _gather(options: argparse.Namespace) -> int:
    from ssm_study.results.gather import gather

    print(f"{len(gather(options.study))} runs in {options.study / 'runs.parquet'}")
    return DONE


def _show(options: argparse.Namespace) -> int:
    from ssm_study.results.show import show

    show(options.study, by=options.by, where=options.where, cost=options.cost)
    return DONE


def _verify(options: argparse.Namespace) -> int:
    from ssm_study.results.verify import verify

    findings = verify(options.run)
    for finding in findings:
        print(finding)
    return DONE if all(finding.holds for finding in findings) else SOME_FAILED


def _reproduce(options: argparse.Namespace) -> int:
    from ssm_study import study
    from ssm_study.results.reproduce import reproduce

    again = reproduce(options.run, study.job)
    print("\n".join(again.lines()))
    return DONE if again.holds() else SOME_FAILED


def _export(options: argparse.Namespace) -> int:
    from ssm_study.report.export import export

    for path in export(options.run, options.to):
        print(path)
    return DONE


def _export_mlflow(options: argparse.Namespace) -> int:
    from ssm_study.results.mlflow_export import export_mlflow

    print(f"{export_mlflow(options.study, options.store)} runs written")
    return DONE


def _report(options: argparse.Namespace) -> int:
    from ssm_study.report.figures import draw

    for path in draw(options.only, options.study):
        print(path)
    if options.only is None:
        from ssm_study.report.page import write_page

        print(write_page(options.study))
    return DONE


# Command: what it does, on what, and what its help says.
ACTIONS: dict[str, tuple[Callable[[argparse.Namespace], int], str, str]] = {
    "gather": (_gather, "study", "(re)build runs.parquet and runs.csv of a study folder"),
    "show": (_show, "study", "print the study's table, best first; failures with reasons"),
    "verify": (_verify, "run", "re-derive every claim of a run from its files alone"),
    "reproduce": (_reproduce, "run", "do a run again from its configuration and compare every number"),
    "export": (_export, "run", "the controller for use elsewhere: C, ONNX, python-control"),
    "report": (_report, "study", "draw the figures of a study into its folder and write its page, report.html"),
    "export-mlflow": (_export_mlflow, "study", "write a finished study into an MLflow store (extra mlflow)"),
}
SUBJECTS = {
    "study": "the study folder, e.g. results/paper",
    "run": "the run folder, or the study with the digits that `show` prints: results/paper/1a2b3c4d5e",
}
FIGURES = sorted(path.stem for path in (Path(__file__).parent / "report" / "figures").glob("[!_]*.py"))
OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "show": {
        "--by": {"metavar": "COLUMN", "help": "sort by this column of runs.csv, in its better direction"},
        "--where": {
            "metavar": "EXPR",
            "help": "keep runs for which this holds, e.g. 'order == 8 and status == \"ok\"'",
        },
        "--cost": {"action": "store_true", "help": "how long each stage took, and what reuse saved"},
    },
    "export": {"--to": {"type": Path, "required": True, "metavar": "DIR", "help": "the folder to write into"}},
    "report": {
        "--only": {
            "action": "append",
            "metavar": "NAME",
            "help": f"draw only this figure (may be repeated): {', '.join(FIGURES)}",
        }
    },
    "export-mlflow": {
        "--store": {"metavar": "ADDRESS", "help": "tracking address (default: sqlite:///STUDY/mlflow.db)"}
    },
}


if __name__ == "__main__":  # by the name that Hydra knows `StudyCallback` by: it is there that the end is noted
    from ssm_study.cli import main as command

    sys.exit(command())
