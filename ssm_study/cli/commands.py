"""Functions behind all commands except `run`. Each takes the parsed options and returns an exit
status, None for success.

Each imports what it takes when it is given, so that `--help` and refusals load no library of
numerics.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ssm_study.cli.browser import open_page, page_link
from ssm_study.cli.exit_status import DONE, SOME_FAILED
from ssm_study.cli.new_study import write_study_template
from ssm_study.cli.paper_figures import PAPER_FIGURES
from ssm_study.refusal import require, require_at_least

Command = Callable[[argparse.Namespace], int | None]
EXPORTED = (".h", ".c", ".json", ".py", ".onnx")


def run_command_on_folder(
    action: Command, folder_kind: str, options: argparse.Namespace
) -> int | None:
    """Find the study or run folder that command-line options name, and call the command with this
    folder."""
    from ssm_study.table import folders

    find_folder = {
        "study": folders.check_study_folder,
        "run": folders.find_run_folder,
        "study_or_run": folders.find_study_or_run,
    }[folder_kind]
    path = getattr(options, folder_kind)
    if not (action in OF_A_DESIGN and (path / DESIGN_CHANNELS).is_file()):
        setattr(options, folder_kind, find_folder(path))
    return action(options)


def write_new_study(options: argparse.Namespace) -> None:
    """Write the folder of a new study and print the names of the written files."""
    print(*write_study_template(options.folder), sep="\n")


def describe_log(options: argparse.Namespace) -> None:
    """Describe a log of measurements, and draw the log if its records can be used."""
    from ssm_study.data.look import look
    from ssm_study.data.text_layout import TextSettings

    header = None if options.header is None else options.header == "true"
    log = look(
        options.file,
        input=options.input,
        output=options.output,
        time=options.time,
        step_s=options.step_s,
        disturbance=options.disturbance,
        settings=TextSettings(separator=options.separator, decimal=options.decimal, header=header),
    )
    print(log)
    if log.records:
        from ssm_study.report.figure_of_a_log import draw_log

        picture = options.picture or Path(f"{options.file.stem}_look.png")
        draw_log(log).savefig(picture, dpi=150)
        print(picture)


def write_excitation(options: argparse.Namespace) -> None:
    """Write an excitation signal for the user's own plant to a file, and print the file's name."""
    from ssm_study.data.excitations.user_excitation import IdentificationExperiment

    settings = {"sines": ()} | excitation_settings(options)
    names = list(IdentificationExperiment.__dataclass_fields__)
    for name in names:
        words = f"--{name.replace('_', '-')}"
        remedy = "give it, or --after RUN of a first log"
        require(
            name in settings,
            words,
            "not given",
            "it is needed when no earlier run is named",
            remedy,
        )
    record = IdentificationExperiment(**{name: settings[name] for name in names})
    print(record.write_csv(options.to))


def excitation_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Settings of an excitation signal, suggested by an earlier run and changed by command-line
    options."""
    settings: dict[str, Any] = {}
    if options.after is not None:
        from ssm_study.study.run_files import RunFiles
        from ssm_study.table.folders import find_run_folder

        run = RunFiles(path=find_run_folder(options.after), record={})
        settings |= run.next_excitation_settings
        settings["sines"] = run.sine_frequencies
    given_options = {name: value for name, value in vars(options).items() if value is not None}
    return settings | given_options


def gather_study_table(options: argparse.Namespace) -> None:
    """Build the table of a study again from the records of its runs."""
    from ssm_study.table.doubts import row_count_warnings
    from ssm_study.table.gather import gather

    table = gather(options.study, anew=True)
    print(f"{len(table)} runs in {options.study / 'runs.parquet'}")
    for line in row_count_warnings(options.study, table):
        print(line)


def show_study_or_run(options: argparse.Namespace) -> None:
    """Print the results table of a study, or every recorded value of a single run."""
    from ssm_study.engine.records import RECORD
    from ssm_study.table.show import show_table

    if (options.study_or_run / RECORD).is_file():
        show_run(options)
        return
    show_table(
        options.study_or_run,
        by=options.by,
        where=options.where,
        cost=options.cost,
        columns=options.columns,
    )


def show_run(options: argparse.Namespace) -> None:
    """Print the outcome of a single run, and every value in its record. Raises `BadRequest` for
    options that only apply to tables."""
    from rich.console import Console

    from ssm_study.report.run_record import print_run

    for name in ("by", "where", "columns", "cost"):
        value = getattr(options, name)
        remedy = "leave it out, or name the study"
        require(not value, f"--{name}", value, "is for a study, not for one run", remedy)
    print_run(options.study_or_run, Console(highlight=False))


def verify_study_or_run(options: argparse.Namespace) -> int:
    """Check all claims of a run again, or of every run of a study, and print the verdict."""
    from ssm_study.table.folders import find_run_folder, list_run_names

    path = options.study_or_run
    if (path / DESIGN_CHANNELS).is_file():
        return verify_run(path, options)
    names = list_run_names(path)
    is_study = len(names) > 1 and path.is_dir()
    return (
        verify_study(path, names, options)
        if is_study
        else verify_run(find_run_folder(path), options)
    )


def verify_study(study: Path, runs: Sequence[str], options: argparse.Namespace) -> int:
    """Check all claims of the named runs of a study again; print one line for each and a
    summary."""
    from ssm_study.study.verify_study import StudyVerdict, check_tables, verify_each_run

    verdicts = []
    for verdict in verify_each_run(study, runs):
        verdicts.append(verdict)
        if not options.json:
            print("\n".join(verdict.lines(every_claim=options.verbose)), flush=True)
    result = StudyVerdict(runs=tuple(verdicts), tables=check_tables(study))
    if options.json:
        print(result.to_json())
    else:
        print(*filter(None, (result.tables, result.summary())), sep="\n")
    result.require_claims(study)
    return DONE if result.holds else SOME_FAILED


def verify_run(run: Path, options: argparse.Namespace) -> int:
    """Check all claims of a finished run again, and print the verdict."""
    from ssm_study.study.verify import verify

    verified = verify(run)
    if options.json:
        print(verified.to_json())
    else:
        *failures, verdict = verified.lines(every_claim=options.verbose)
        hint = "" if options.verbose else " (-v lists every claim)"
        print("\n".join([*failures, f"{verdict}{hint}"]))
    return DONE if verified.holds else SOME_FAILED


def refine_run(options: argparse.Namespace) -> int:
    """Refine a run's controller by closed-loop trials, and print one line for each step."""
    from ssm_study.cli.summary import print_run_summary
    from ssm_study.study.refine import refine_controller

    require_at_least(1, "--times", options.times, "use 4 or so")
    last_config = None
    for step in refine_controller(options.run, options.record, options.times):
        print(step.said, flush=True)
        last_config = step.config or last_config
    failed = last_config is not None and print_run_summary(last_config)
    return SOME_FAILED if failed else DONE


def reproduce_run(options: argparse.Namespace) -> int:
    """Repeat a finished run with the same configuration, and print where the results differ."""
    from ssm_study.study import line as study
    from ssm_study.study.reproduce import reproduce

    lines, agrees = reproduce(options.run, study.STUDY.run_job)
    print("\n".join(lines))
    return DONE if agrees else SOME_FAILED


def export_controller(options: argparse.Namespace) -> None:
    """Verify a run, write its controller as code for use elsewhere, and print the names of the
    files."""
    from ssm_study.export.targets import write_controller
    from ssm_study.study.verify import verify

    # What is exported claims to be certified: recompute it first.
    verify(options.run).require_valid("run", options.run)
    if not options.yes and not confirm_overwriting(options.to):
        print("nothing written")
        return
    if (options.run / DESIGN_CHANNELS).is_file():
        paths = export_rest_design(options)
    else:
        paths = write_controller(options.run, options.to, real=options.real, prefix=options.prefix)
    for path in paths:
        print(path)
    for warning in export_warnings(options.run, options.to / f"{options.prefix}.h"):
        print(warning)


def export_rest_design(options: argparse.Namespace) -> list[Path]:
    """Write the controller of a saved design for a bilinear model as code for use elsewhere."""
    from ssm_study.api.rest_design import RestDesign

    design = RestDesign.load(options.run)
    options.to.mkdir(parents=True, exist_ok=True)
    header = design.to_c(options.to / f"{options.prefix}.h", real=options.real)
    return [header, header.with_name(f"{options.prefix}_replay.c")]


# Commands that take a saved design without a run, which this file in its folder tells.
OF_A_DESIGN = (verify_study_or_run, export_controller)
DESIGN_CHANNELS = "channels.json"


def export_warnings(run: Path, header_path: Path) -> list[str]:
    """Warnings about an exported controller: what it cannot do, and what was not tested."""
    warnings = []
    reason = re.search(r"No set points: (.*)\.", header_path.read_text(encoding="utf-8"))
    if reason is not None:
        warnings.append(f"No set points: {reason[1]}.")
    record_path = run / "record.json"
    if record_path.is_file():
        record = json.loads(record_path.read_text(encoding="utf-8"))
        if record.get("stable_count") is None:
            warnings.append("Not tried: this run closed no loop with the controller.")
    return warnings


def confirm_overwriting(folder: Path) -> bool:
    """Whether the files of an earlier export may be replaced; asks the user on a terminal."""
    earlier = sorted(path.name for path in folder.glob("*") if path.suffix in EXPORTED)
    if not earlier or not sys.stdin.isatty():
        return True
    names = ", ".join(earlier[:4])
    more = " ..." if len(earlier) > 4 else ""
    answer = input(f"{folder} holds {names}{more}: overwrite? [y/N] ")
    return answer.strip().lower() in ("y", "yes")


def export_recordings(options: argparse.Namespace) -> None:
    """Write the closed-loop recordings of all runs of a study into one file and print its name."""
    from ssm_study.table.one_recording import export_closed_loop_recordings

    print(export_closed_loop_recordings(options.study))


def export_to_mlflow(options: argparse.Namespace) -> None:
    """Write the runs of a study to an MLflow store."""
    from ssm_study.table.mlflow import export_mlflow

    count = export_mlflow(options.study, options.store)
    print(f"{count} runs written")


def write_study_report(options: argparse.Namespace) -> None:
    """Write the report page of a study and draw its figures."""
    from ssm_study.report.figures import draw_figures
    from ssm_study.report.page.writing import write_page

    try:  # first: after the figures of 20,000 runs it would take 80 MB more
        if not options.only:
            page = write_page(options.study, tuple(options.others))
            print(page_link(page), flush=True)
            if options.open:
                open_page(page)
    finally:
        if not options.others:
            announce_drawing()
            reasons: list[str] = []
            wanted_figures = options.only or (PAPER_FIGURES if options.width else None)
            paths = draw_figures(
                wanted_figures, options.study, reasons.append, width=options.width or "page"
            )
            says_more = bool(options.verbose or wanted_figures)
            lines = (
                [*reasons, *map(str, paths)]
                if says_more
                else [drawn_figures_text(paths, len(reasons))]
            )
            print("\n".join(lines))


def drawn_figures_text(paths: list[Path], left_out: int) -> str:
    """Text that says how many figures were drawn and where they are."""
    if not paths:
        return "no figure drawn; -v says why"
    count = len({path.stem for path in paths})
    why = "they need other runs or settings"
    more = f", {left_out} not drawn ({why})" if left_out else ""
    return f"{count} figures in {paths[0].parent}{more}; -v lists them"


def announce_drawing() -> None:
    """Print, on a terminal only, that drawing the figures of a study takes a while."""
    if sys.stderr.isatty():
        print("drawing the figures, which takes up to a minute", file=sys.stderr, flush=True)


def serve_study_page(options: argparse.Namespace) -> None:
    """Serve the report page of a study on a local port until the command is stopped."""
    from ssm_study.report.page.live import start_server

    def print_address(address: str) -> None:
        """Print the web address of the report page."""
        print(address, flush=True)

    with start_server(options.study, options.port, announce=print_address) as server:
        server.serve_forever()
