"""Search for the folder of a study, by its path, or of a run, by its path or a part of its name."""

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ssm_study.engine.records import RECORD
from ssm_study.refusal import BadRequest

MANY = 8  # names in a sentence


def check_study_folder(path: Path) -> Path:
    """Check that a folder may contain the runs of a study, and return the folder.

    Raises `BadRequest` that names the study nearby that may have been meant.
    """
    if not path.is_dir():
        remedy = _suggest_existing_study(path)
        raise BadRequest("study", path, "no such study folder", remedy)
    tables = path.glob("*/runs.parquet")
    names = {table.parent.name for table in tables}
    studies = sorted(names)
    is_gathered = (path / "runs.parquet").exists()
    is_study = is_gathered or bool(list_run_names(path))
    if studies and not is_study:
        problem = "there is no run in it, but there are studies"
        raise BadRequest("study", path, problem, f"name one: {abbreviate_names(studies)}")
    return path


def _suggest_existing_study(path: Path) -> str:
    """Suggest an existing study for a wrong path: a study below `results`, or one with a similar
    name."""
    in_results = Path("results") / path
    if in_results.is_dir():
        return f"did you mean {in_results}?"
    folders = path.parent.glob("*/")
    names = [folder.name for folder in folders]
    similar = get_close_matches(path.name, names, n=1)
    if similar:
        return f"did you mean {path.parent / similar[0]}?"
    return "give the folder that holds the run folders"


def find_study_or_run(path: Path) -> Path:
    """Find the folder of the study or run that a path stands for.

    Raises `BadRequest` where neither is there.
    """
    is_run = (path / RECORD).is_file()
    may_be_part = not path.is_dir() and bool(list_run_names(path.parent))
    return find_run_folder(path) if is_run or may_be_part else check_study_folder(path)


def find_run_folder(path: Path) -> Path:
    """Find the folder of the single run that a path or a part of its name stands for. The part may
    be the beginning or end of the name, or of the digits at its end.

    `results/paper/1a2b3c4d5e`, `results/paper/1a2b`, or `results/paper/order8-width32-seed3`. The
    study itself stands for its only run. Raises `BadRequest` where no run or several are meant.
    """
    if (path / RECORD).is_file():
        return path
    is_folder = path.is_dir()
    study = path if is_folder else path.parent
    part = "" if path.is_dir() else path.name
    names = list_run_names(study)
    matches = _matching_names(names, part)
    if len(matches) == 1:
        return study / matches[0]
    problem = f"{len(matches)} runs are there" if matches else f"there is no {RECORD}"
    remedy = "give the folder of one run"
    if names:
        which = "name one" if matches else "name one of its study"
        remedy = f"{which}: {abbreviate_names(matches or names)}"
    raise BadRequest("run", path, problem, remedy)


def _matching_names(names: list[str], part: str) -> list[str]:
    """Names of runs that match a given text by their end, else by their beginning, else by their
    final digits."""
    ending = [name for name in names if name.endswith(part)]
    beginning = [name for name in names if name.startswith(part)]
    digits = [name for name in names if name.rpartition("-")[2].startswith(part)]
    return ending or beginning or digits


def list_run_names(study: Path) -> list[str]:
    """Names of the runs of a study that have left a record."""
    records = study.glob(f"*/{RECORD}")
    return sorted(record.parent.name for record in records)


def abbreviate_names(names: Iterable[Any], limit: int = MANY) -> str:
    """Text with the first few of several names, and the number of the remaining names."""
    texts = [str(name) for name in names]
    words = ", ".join(texts[:limit])
    more = len(texts) - limit
    return f"{words} and {more} more" if more > 0 else words
