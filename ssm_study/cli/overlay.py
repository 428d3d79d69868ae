"""The command `overlay`, which compares the models of several runs by simulating one record."""

import argparse
from pathlib import Path
from typing import Any

PICTURE = "overlay.png"
WORDS = "compare the free runs of several runs on the test record that they share: table, picture"


def add_overlay_command(commands: Any) -> None:
    """Add the command `overlay RUN RUN ...`, which compares runs, to the parser."""
    parser = commands.add_parser("overlay", help=WORDS, description=WORDS[0].upper() + WORDS[1:])
    run_help = "a run folder, or a study with the first or last letters of a run's name"
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help=run_help)
    parser.add_argument(
        "--picture", type=Path, default=Path(PICTURE), metavar="PNG", help=f"where ({PICTURE})"
    )
    parser.set_defaults(command=overlay_runs)


def overlay_runs(options: argparse.Namespace) -> None:
    """Print a table that compares several runs, and draw their free-run simulations."""
    from ssm_study.report.overlay import baseline_line, compare_free_runs
    from ssm_study.table.folders import find_run_folder

    folders = [find_run_folder(run) for run in options.runs]
    comparison = compare_free_runs(folders)
    print(comparison)
    baseline = baseline_line(folders)
    if baseline:
        print(baseline)
    comparison.plot().savefig(options.picture, dpi=150)
    print(options.picture)
