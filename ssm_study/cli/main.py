"""`ssm-study`: the command line. Exit status 0 done, 1 some runs failed (the rest is kept), 2 the
request was wrong."""

import argparse
import errno
import os
import re
import select
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ssm_study import __version__, limit_threads
from ssm_study.cli.overlay import add_overlay
from ssm_study.extensions import taken_from
from ssm_study.refusal import BadRequest, at_least, require

DONE = 0
SOME_FAILED = 1
WRONG_REQUEST = 2
Command = Callable[[argparse.Namespace], int | None]
EXPORTED = (".h", ".c", ".json", ".py", ".onnx")
TEMPLATE = Path(__file__).with_name("study_folder")  # what `new` writes


INTERRUPTED = (
    "interrupted; the same command again does what is missing, a training from its last checkpoint "
    "(in Python st.fit(..., keep_on_interrupt=True) returns the model so far)"
)


def main(arguments: list[str] | None = None) -> int:
    """Run one `ssm-study` command; returns its exit status."""
    limit_threads()  # first: the libraries read it once, when they are imported
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        arguments = taken_from(arguments)
        if arguments[:1] == ["run"]:
            from ssm_study.cli.run import run

            return run(arguments[1:])
        options = _parser().parse_args(arguments or ["--help"])
        command: Command = options.command
        return command(options) or DONE
    except KeyboardInterrupt:
        print(f"ssm-study: {INTERRUPTED}", file=sys.stderr)
        # Without a traceback, yet ended by the signal: a script's loop ends with it.
        sys.excepthook = lambda *_: None
        raise
    except Exception as error:
        # The one guard: whatever a file holds, no command ends in a traceback.
        # `ssm-study show STUDY | head`.
        if isinstance(error, BrokenPipeError) and _reader_is_gone():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return DONE
        if "SSM_STUDY_TRACEBACK" in os.environ and not isinstance(error, (BadRequest, OSError)):
            raise
        print(f"ssm-study: {_told(error, arguments)}", file=sys.stderr)
        return WRONG_REQUEST


def _told(error: Exception, arguments: list[str]) -> BadRequest:
    """Describe in one sentence the error that ended the command."""
    if isinstance(error, BadRequest):
        return error
    if isinstance(error, OSError):
        named = error.filename is not None  # the error of a write does not know its file
        return full_or_forbidden(
            *(("file", error) if named else ("command", error, " ".join(arguments)))
        )
    cause = f"{type(error).__name__}: {str(error)[:300]}"
    problem = f"Unexpected error (a bug in ssm-study, please report it): {cause}"
    remedy = (
        "if files of the study were changed, run it again; SSM_STUDY_TRACEBACK=1 shows the "
        "traceback"
    )
    return BadRequest("command", " ".join(arguments), problem, remedy)


REMEDIES = {
    errno.EACCES: "ask its owner for access, or choose a folder of your own",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENAMETOOLONG: "choose shorter names",
}


def full_or_forbidden(field: str, error: OSError, otherwise: str = "not named") -> BadRequest:
    """The sentence for a disk that is full or a folder that is not ours; `field` names what was
    asked."""
    problem = error.strerror or type(error).__name__
    remedy = REMEDIES.get(error.errno or 0, "make room, or choose a folder that you may write to")
    return BadRequest(field, error.filename or otherwise, problem, remedy)


def _reader_is_gone() -> bool:
    """Whether nobody reads our output any more; another broken pipe is no good end."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return bool(poll.poll(0))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ssm-study",
        description="Identify a model from data, design a certified output-feedback controller, "
        "compare "
        "many runs.",
        epilog="Every command takes --with FOLDER: it adds the parts of your own study folder to "
        "the choices.",
    )
    parser.add_argument("--version", action="version", version=f"ssm-study {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.add_parser(
        "run", help="do one run, or with -m a sweep; see `ssm-study run --help`", add_help=False
    )
    made = commands.add_parser(
        "new", help="write a study folder of your own: plant, theorem, figure, test, README"
    )
    made.add_argument(
        "folder", type=Path, metavar="FOLDER", help="a folder that does not exist yet"
    )
    made.set_defaults(command=lambda options: print(*new(options.folder), sep="\n"))
    told = "write an input for your own plant: several amplitudes, each period twice, then rest"
    excited = commands.add_parser("excite", help=told, description=told[0].upper() + told[1:] + ".")
    for words, settings in EXCITE.items():
        excited.add_argument(words, **settings)
    excited.set_defaults(command=_excite)
    add_look(commands)
    add_overlay(commands)
    for name, (action, subject, told) in ACTIONS.items():
        command = commands.add_parser(name, help=told, description=told[0].upper() + told[1:] + ".")
        command.add_argument(subject, type=Path, metavar=subject.upper(), help=SUBJECTS[subject])
        command.set_defaults(command=partial(_on_its_folder, action, subject))
        for words, settings in OPTIONS.get(name, {}).items():
            command.add_argument(words, **settings)
    return parser


def add_look(commands: Any) -> None:
    """Add `look FILE`: what is in a log, a picture of it, and the command that fits it."""
    words = "show what is in a log: columns, clock, holes, dynamics; and the command that fits it"
    looked = commands.add_parser("look", help=words, description=words[0].upper() + words[1:] + ".")
    looked.add_argument("file", type=Path, metavar="FILE", help="the log")
    for name in ("input", "output", "time"):
        looked.add_argument(f"--{name}", metavar="COLUMN", help=f"the column of the {name}")
    looked.add_argument("--step-s", type=float, metavar="S", help="sampling time, seconds")
    looked.add_argument("--picture", type=Path, metavar="PNG", help="where to draw it (FILE.png)")
    looked.set_defaults(command=_look)


def _look(options: argparse.Namespace) -> None:
    from ssm_study.data.look import look

    seen = look(
        options.file,
        input=options.input,
        output=options.output,
        time=options.time,
        step_s=options.step_s,
    )
    print(seen)
    if seen.records:
        from ssm_study.report.figure_of_a_log import draw_log

        picture = options.picture or Path(f"{options.file.stem}_look.png")
        draw_log(seen).savefig(picture, dpi=150)
        print(picture)


def _on_its_folder(action: Command, subject: str, options: argparse.Namespace) -> int | None:
    from ssm_study.table import folders

    found = {"study": folders.study_folder, "run": folders.run_folder}[subject](
        getattr(options, subject)
    )
    setattr(options, subject, found)
    return action(options)


def new(folder: Path) -> list[Path]:
    """Write configuration, plant, theorem, figure, test and README into a new folder; returns the
    files.

    The folder's name becomes the name of a Python package. Raises `BadRequest` for one that cannot,
    or is taken.
    """
    name = folder.name
    require(
        bool(re.fullmatch(r"[a-z]\w*", name)),
        "new",
        name,
        "cannot name a package",
        "use letters, digits and _",
    )
    require(not folder.exists(), "new", folder, "exists", "name a folder that does not")
    require(
        find_spec(name) is None,
        "new",
        name,
        "is the name of an installed package",
        "choose another",
    )
    written = []
    for source in sorted(path for path in TEMPLATE.rglob("*.txt") if path.is_file()):
        to = folder / str(source.relative_to(TEMPLATE)).removesuffix(".txt").replace("@NAME@", name)
        to.parent.mkdir(parents=True, exist_ok=True)
        to.write_text(source.read_text(encoding="utf-8").replace("@NAME@", name), encoding="utf-8")
        written.append(to)
    return written


def _excite(options: argparse.Namespace) -> None:
    from ssm_study.data.excitations.user_excitation import OwnPlantRecord

    known: dict[str, float] = {}
    if options.after is not None:
        from ssm_study.study.run_files import RunFiles
        from ssm_study.table.folders import run_folder

        known = RunFiles(path=run_folder(options.after), record={}).excitation
    settings = known | {name: value for name, value in vars(options).items() if value is not None}
    for name in OwnPlantRecord.__dataclass_fields__:
        words = f"--{name.replace('_', '-')}"
        require(
            name in settings,
            words,
            "not given",
            "no record is known",
            "give it, or --after RUN of a first log",
        )
    print(
        OwnPlantRecord(
            **{name: settings[name] for name in OwnPlantRecord.__dataclass_fields__}
        ).write(options.to)
    )


# Each command imports what it takes when it is given, so that `--help` and refusals load no library
# of numerics.
def _gather(options: argparse.Namespace) -> None:
    from ssm_study.table.gather import gather

    print(f"{len(gather(options.study, anew=True))} runs in {options.study / 'runs.parquet'}")


def _show(options: argparse.Namespace) -> None:
    from ssm_study.table.show import show

    show(
        options.study,
        by=options.by,
        where=options.where,
        cost=options.cost,
        columns=options.columns,
    )


def _verify(options: argparse.Namespace) -> int:
    from ssm_study.study.verify import verify

    verified = verify(options.run)
    print(verified.to_json() if options.json else "\n".join(verified.lines()))
    return DONE if verified.holds else SOME_FAILED


def _refine(options: argparse.Namespace) -> int:
    from ssm_study.cli.summary import conclude_run
    from ssm_study.study.refine import refine

    at_least(1, "--times", options.times, "use 4 or so")
    last = None
    for step in refine(options.run, options.record, options.times):
        print(step.said, flush=True)
        last = step.config or last
    return SOME_FAILED if last is not None and conclude_run(last) else DONE


def _reproduce(options: argparse.Namespace) -> int:
    from ssm_study.study import line as study
    from ssm_study.study.reproduce import reproduce

    lines, agrees = reproduce(options.run, study.STUDY.job)
    print("\n".join(lines))
    return DONE if agrees else SOME_FAILED


def _export(options: argparse.Namespace) -> None:
    from ssm_study.export.targets import export
    from ssm_study.study.verify import verify

    # What is exported claims to be certified: recompute it first.
    verify(options.run).demand("run", options.run)
    if not options.yes and not may_overwrite(options.to):
        print("nothing written")
        return
    for path in export(options.run, options.to, real=options.real, prefix=options.prefix):
        print(path)


def may_overwrite(folder: Path) -> bool:
    """Ask on the terminal whether an earlier export may be replaced; without one it may."""
    earlier = sorted(path.name for path in folder.glob("*") if path.suffix in EXPORTED)
    if not earlier or not sys.stdin.isatty():
        return True
    question = f"{folder} holds {', '.join(earlier[:4])}{' ...' if len(earlier) > 4 else ''}"
    answer = input(f"{question}: overwrite? [y/N] ")
    return answer.strip().lower() in ("y", "yes")


def open_page(path: Path) -> None:
    """Show a page in the browser."""
    import webbrowser

    webbrowser.open(path.absolute().as_uri())


def _export_mcap(options: argparse.Namespace) -> None:
    from ssm_study.table.one_recording import export_mcap

    print(export_mcap(options.study))


def _export_mlflow(options: argparse.Namespace) -> None:
    from ssm_study.table.mlflow import export_mlflow

    print(f"{export_mlflow(options.study, options.store)} runs written")


def _report(options: argparse.Namespace) -> None:
    from ssm_study.report.figures import draw
    from ssm_study.report.page.writing import write_page

    try:  # first: after the figures of 20,000 runs it would take 80 MB more
        if not options.only:
            page = write_page(options.study, tuple(options.others))
            print(page, flush=True)
            if options.open:
                open_page(page)
    finally:
        if not options.others:
            for path in draw(options.only, options.study, tell=print):
                print(path)


def _watch(options: argparse.Namespace) -> None:
    from ssm_study.report.page.live import serve

    with serve(
        options.study, options.port, announce=lambda address: print(address, flush=True)
    ) as server:
        server.serve_forever()


# Command: what it does, on what, and what its help says.
ACTIONS: dict[str, tuple[Command, str, str]] = {
    "gather": (_gather, "study", "(re)build runs.parquet and runs.csv of a study folder"),
    "show": (_show, "study", "print the study's table, best first; failures with reasons"),
    "verify": (_verify, "run", "recompute every claim of a run from its files alone"),
    "refine": (
        _refine,
        "run",
        "measure the mismatch in closed loop, choose the controller again, run it",
    ),
    "reproduce": (
        _reproduce,
        "run",
        "do a run again from its configuration and compare every number",
    ),
    "export": (_export, "run", "write the controller in C, as ONNX and for python-control"),
    "report": (
        _report,
        "study",
        "draw the figures of a study into its folder and write its page, report.html",
    ),
    "watch": (
        _watch,
        "study",
        "serve the report page on a local port while a sweep runs; it reloads itself",
    ),
    "export-mcap": (
        _export_mcap,
        "study",
        "write the closed loops of all runs into one recording, for Foxglove",
    ),
    "export-mlflow": (
        _export_mlflow,
        "study",
        "write a finished study into an MLflow store (extra mlflow)",
    ),
}
EXCITE: dict[str, dict[str, Any]] = {
    "--to": {
        "type": Path,
        "metavar": "FILE",
        "required": True,
        "help": "the CSV file to write: time_s, input",
    },
    "--after": {
        "type": Path,
        "metavar": "RUN",
        "help": "the run of a first log: what is not given below is its own",
    },
    "--lower": {"type": float, "metavar": "U", "help": "smallest input, in its unit"},
    "--upper": {"type": float, "metavar": "U", "help": "largest input"},
    "--rest": {"type": float, "metavar": "U", "help": "the input at which the plant rests"},
    "--step-s": {"type": float, "metavar": "S", "help": "sampling time, seconds"},
    "--settle-s": {
        "type": float,
        "metavar": "S",
        "help": "how long the plant takes to come to rest, seconds",
    },
    "--seed": {"type": int, "default": 0, "metavar": "N", "help": "seed of the random levels"},
}
SUBJECTS = {
    "study": "the study folder, e.g. results/paper",
    "run": "the run folder, or the study with the begin or the end of one name: "
    "results/paper/1a2b3c4d5e",
}
FIGURES = sorted(
    path.stem for path in (Path(__file__).parents[1] / "report" / "figures").glob("[!_]*.py")
)
ONLY = f"draw only this figure (may be repeated): {', '.join(FIGURES)}"
OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "show": {
        "--by": {
            "metavar": "COLUMN",
            "help": "sort by this column of runs.csv, in its better direction",
        },
        "--where": {
            "metavar": "EXPR",
            "help": "keep runs for which this holds, e.g. 'order == 8 and seed < 5'",
        },
        "--columns": {
            "action": "store_true",
            "help": "list the columns that hold values, with unit and meaning",
        },
        "--cost": {
            "action": "store_true",
            "help": "how long each stage took, and what reuse saved",
        },
    },
    "verify": {
        "--json": {
            "action": "store_true",
            "help": "for machines: every claim, and what was not checked",
        }
    },
    "refine": {
        "--record": {
            "type": Path,
            "metavar": "LOG",
            "help": "log of a trial, with the columns of the run's data",
        },
        "--times": {
            "type": int,
            "default": 4,
            "metavar": "N",
            "help": "stop after N iterations, each a run (4)",
        },
    },
    "export": {
        "--to": {
            "type": Path,
            "required": True,
            "metavar": "DIR",
            "help": "the folder to write into",
        },
        "--real": {
            "default": "double",
            "metavar": "TYPE",
            "help": "floats of the C code: double (default) or float",
        },
        "--yes": {"action": "store_true", "help": "replace an earlier export without asking"},
        "--prefix": {
            "default": "controller",
            "metavar": "NAME",
            "help": "what the names of the C code begin with",
        },
    },
    "report": {
        "others": {
            "nargs": "*",
            "type": Path,
            "metavar": "STUDY",
            "help": "further studies to show on the same page",
        },
        "--only": {"action": "append", "metavar": "NAME", "help": ONLY},
        "--open": {"action": "store_true", "help": "show the page in the browser"},
    },
    "watch": {
        "--port": {
            "type": int,
            "default": 8420,
            "metavar": "PORT",
            "help": "local port (0: any free one)",
        }
    },
    "export-mlflow": {
        "--store": {"metavar": "ADDRESS", "help": "address (default: sqlite:///STUDY/mlflow.db)"}
    },
}
