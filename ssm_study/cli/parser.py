"""Parser of the command line: commands, their options and their help."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ssm_study import __version__
from ssm_study.cli import commands
from ssm_study.cli.commands import Command
from ssm_study.cli.overlay import add_overlay_command
from ssm_study.cli.paper_figures import PAPER_FIGURES

Subparsers = Any  # argparse's own class of them is private
AddOptions = Callable[[argparse.ArgumentParser], None]
FIGURE_FILES = (Path(__file__).parents[1] / "report" / "figures").glob("[!_]*.py")
FIGURES = sorted(path.stem for path in FIGURE_FILES)
DESCRIPTION = (
    "Identify a model from data, design a certified output-feedback controller, compare many runs."
)
EPILOG = (
    "Every command takes --with FOLDER: it adds the parts of your own study folder to the choices."
)
SUBJECTS = {
    "study": "the study folder, e.g. results/paper",
    "run": "the run folder, or the study with the first or last letters of the run's name: "
    "results/paper/1a2b3c4d5e",
    "study_or_run": "the study folder, e.g. results/paper, or one run of it: results/paper/1a2b",
}


def build_parser() -> argparse.ArgumentParser:
    """Parser of all commands except `run`, whose arguments Hydra parses."""
    parser = argparse.ArgumentParser(prog="ssm-study", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"ssm-study {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    run_help = "do one run, or with -m a sweep; see `ssm-study run --help`"
    subparsers.add_parser("run", help=run_help, add_help=False)
    add_new_command(subparsers)
    add_excite_command(subparsers)
    add_look_command(subparsers)
    add_overlay_command(subparsers)
    for name, action in ACTIONS.items():
        add_folder_command(subparsers, name, action)
    return parser


def add_command(subparsers: Subparsers, name: str, summary: str) -> argparse.ArgumentParser:
    """Add a command to the parser, whose help and description are the same sentence."""
    description = summary[0].upper() + summary[1:] + "."
    command: argparse.ArgumentParser = subparsers.add_parser(
        name, help=summary, description=description
    )
    return command


def add_new_command(subparsers: Subparsers) -> None:
    """Add the command `new FOLDER`, which writes the folder of a new study, to the parser."""
    summary = "write a study folder of your own: plant, theorem, figure, test, README"
    command = subparsers.add_parser("new", help=summary)
    folder_help = "a folder that does not exist yet"
    command.add_argument("folder", type=Path, metavar="FOLDER", help=folder_help)
    command.set_defaults(command=commands.write_new_study)


def add_excite_command(subparsers: Subparsers) -> None:
    """Add the command `excite`, which writes an excitation signal, to the parser."""
    summary = "write an input for your own plant: several amplitudes, each period twice, then rest"
    command = add_command(subparsers, "excite", summary)
    file_help = "the CSV file to write: time_s, input"
    command.add_argument("--to", type=Path, metavar="FILE", required=True, help=file_help)
    after_help = "a run of an earlier log, which gives the values left out below"
    command.add_argument("--after", type=Path, metavar="RUN", help=after_help)
    command.add_argument("--lower", type=float, metavar="U", help="smallest input, in its unit")
    command.add_argument("--upper", type=float, metavar="U", help="largest input")
    rest_help = "the input at which the plant rests"
    command.add_argument("--rest", type=float, metavar="U", help=rest_help)
    command.add_argument("--step-s", type=float, metavar="S", help="sampling time, seconds")
    settle_help = "how long the plant takes to come to rest, seconds"
    command.add_argument("--settle-s", type=float, metavar="S", help=settle_help)
    seed_help = "seed of the random levels"
    command.add_argument("--seed", type=int, default=0, metavar="N", help=seed_help)
    command.set_defaults(command=commands.write_excitation)


def add_look_command(subparsers: Subparsers) -> None:
    """Add the command `look FILE`, which describes and draws a log and prints a command for fitting
    a model."""
    summary = "show what is in a log: columns, clock, holes, dynamics; and the command that fits it"
    command = add_command(subparsers, "look", summary)
    command.add_argument("file", type=Path, metavar="FILE", help="the log")
    for name in ("input", "output", "time"):
        command.add_argument(f"--{name}", metavar="COLUMN", help=f"the column of the {name}")
    disturbance_help = (
        "a column that moves the output and is not commanded, such as a load or the weather"
    )
    command.add_argument("--disturbance", metavar="COLUMN", help=disturbance_help)
    command.add_argument("--step-s", type=float, metavar="S", help="sampling time, seconds")
    separator_help = "separator of a text file: tabs, semicolons, commas, bars, spaces"
    command.add_argument("--separator", metavar="NAME", help=separator_help)
    command.add_argument(
        "--decimal", metavar="MARK", help='decimal mark of a text file: "." or ","'
    )
    header_help = "whether the first line of a text file holds names"
    command.add_argument("--header", choices=("true", "false"), help=header_help)
    picture_help = "file for the picture (default: FILE_look.png in this folder)"
    command.add_argument("--picture", type=Path, metavar="PNG", help=picture_help)
    command.set_defaults(command=commands.describe_log)


class FolderCommand(NamedTuple):
    """Description of a command that acts on a study or on a run: its function, its help, and the
    kind of folder it needs."""

    function: Command
    subject: str
    summary: str
    add_options: AddOptions | None = None


def add_folder_command(subparsers: Subparsers, name: str, action: FolderCommand) -> None:
    """Add a command that acts on the folder of a study or of a run to the parser."""
    command = add_command(subparsers, name, action.summary)
    subject = action.subject
    metavar = subject.upper().replace("_OR_", "|")
    command.add_argument(subject, type=Path, metavar=metavar, help=SUBJECTS[subject])
    function = partial(commands.run_command_on_folder, action.function, subject)
    command.set_defaults(command=function)
    if action.add_options is not None:
        action.add_options(command)


def add_show_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `show`, which prints a results table, to its parser."""
    by_help = "sort by this column, best value first"
    command.add_argument("--by", metavar="COLUMN", help=by_help)
    where_help = "show only runs for which this holds, e.g. 'order == 8 and seed < 5'"
    command.add_argument("--where", metavar="EXPR", help=where_help)
    columns_help = "list the columns that hold values, with unit and meaning"
    command.add_argument("--columns", action="store_true", help=columns_help)
    cost_help = "how long each stage took, and what reuse saved"
    command.add_argument("--cost", action="store_true", help=cost_help)


def add_verify_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `verify`, which checks one run or all of a study, to its
    parser."""
    json_help = "print JSON: every claim, and what was not checked"
    command.add_argument("--json", action="store_true", help=json_help)
    verbose_help = "list every claim with what was found, not those alone that fail"
    command.add_argument("-v", "--verbose", action="store_true", help=verbose_help)


def add_refine_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `refine`, which improves a run's controller, to its parser."""
    record_help = "log of a trial, with the columns of the run's data"
    command.add_argument("--record", type=Path, metavar="LOG", help=record_help)
    times_help = "stop after N iterations, each a run (default: 4)"
    command.add_argument("--times", type=int, default=4, metavar="N", help=times_help)


def add_export_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `export`, which writes a controller as code, to its parser."""
    folder_help = "the folder to write into"
    command.add_argument("--to", type=Path, required=True, metavar="DIR", help=folder_help)
    real_help = "floats of the C code: double (default) or float"
    command.add_argument("--real", default="double", metavar="TYPE", help=real_help)
    yes_help = "replace an earlier export without asking"
    command.add_argument("--yes", action="store_true", help=yes_help)
    prefix_help = "what the names of the C code begin with"
    command.add_argument("--prefix", default="controller", metavar="NAME", help=prefix_help)


def add_report_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `report`, which writes a page and figures, to its parser."""
    others_help = "further studies to show on the same page"
    command.add_argument("others", nargs="*", type=Path, metavar="STUDY", help=others_help)
    only_help = f"draw only this figure (may be repeated): {', '.join(FIGURES)}"
    command.add_argument("--only", action="append", metavar="NAME", help=only_help)
    command.add_argument("--open", action="store_true", help="show the page in the browser")
    width_help = f"draw {' and '.join(PAPER_FIGURES)} as wide as a paper's page or column"
    command.add_argument("--width", choices=("page", "column"), help=width_help)
    verbose_help = "list every figure, and why one was not drawn"
    command.add_argument("-v", action="store_true", dest="verbose", help=verbose_help)


def add_watch_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the command `watch`, which serves a live report page, to its parser."""
    port_help = "local port (0: any free one)"
    command.add_argument("--port", type=int, default=8420, metavar="PORT", help=port_help)


def add_mlflow_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the export to MLflow to the parser of its command."""
    store_help = "address (default: sqlite:///STUDY/mlflow.db)"
    command.add_argument("--store", metavar="ADDRESS", help=store_help)


ACTIONS = {
    "gather": FolderCommand(
        commands.gather_study_table,
        "study",
        "(re)build runs.parquet and runs.csv of a study folder",
    ),
    "show": FolderCommand(
        commands.show_study_or_run,
        "study_or_run",
        "print the study's table, best first, failures with reasons; or the whole record of a run",
        add_show_options,
    ),
    "verify": FolderCommand(
        commands.verify_study_or_run,
        "study_or_run",
        "recompute every claim of a run, or of each run of a study, from its files (and its log)",
        add_verify_options,
    ),
    "refine": FolderCommand(
        commands.refine_run,
        "run",
        "measure the mismatch in closed loop, choose the controller again, run it",
        add_refine_options,
    ),
    "reproduce": FolderCommand(
        commands.reproduce_run,
        "run",
        "do a run again from its configuration and compare every number",
    ),
    "export": FolderCommand(
        commands.export_controller,
        "run",
        "write the controller in C, as ONNX and for python-control",
        add_export_options,
    ),
    "report": FolderCommand(
        commands.write_study_report,
        "study",
        "draw the figures of a study into its folder and write its page, report.html",
        add_report_options,
    ),
    "watch": FolderCommand(
        commands.serve_study_page,
        "study",
        "serve the report page on a local port while a sweep runs; it reloads itself",
        add_watch_options,
    ),
    "export-mcap": FolderCommand(
        commands.export_recordings,
        "study",
        "write the closed loops of all runs into one recording, for Foxglove",
    ),
    "export-mlflow": FolderCommand(
        commands.export_to_mlflow,
        "study",
        "write a finished study into an MLflow store (extra mlflow)",
        add_mlflow_options,
    ),
}
