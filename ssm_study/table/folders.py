"""Which folder is meant: a study by its path, a run by its path or by a part of its name."""

from difflib import get_close_matches
from pathlib import Path

from ssm_study.engine.records import RECORD
from ssm_study.refusal import BadRequest

MANY = 8  # names in a sentence


def study_folder(path: Path) -> Path:
    """`path` if runs may be in it; raises `BadRequest` that names the study nearby that may have
    been meant."""
    if not path.is_dir():
        names = [folder.name for folder in path.parent.glob("*/")]
        near = [path.parent / name for name in get_close_matches(path.name, names, n=1)]
        near = [Path("results") / path] if (Path("results") / path).is_dir() else near
        remedy = (
            f"did you mean {near[0]}?" if near else "give the folder that holds the run folders"
        )
        raise BadRequest("study", path, "no such study folder", remedy)
    studies = sorted({table.parent.name for table in path.glob("*/runs.parquet")})
    if studies and not (path / "runs.parquet").exists() and not _runs_of(path):
        raise BadRequest(
            "study",
            path,
            "there is no run in it, but there are studies",
            f"name one: {_some(studies)}",
        )
    return path


def run_folder(path: Path) -> Path:
    """`path` if it holds a record, else the one run of the study whose name ends or begins so.

    `results/paper/1a2b3c4d5e`, or `results/paper/order8-width32-seed3`. The study itself stands for
    its only run. Raises `BadRequest` where no run or several are meant.
    """
    if (path / RECORD).is_file():
        return path
    study = path if path.is_dir() else path.parent
    part = "" if path.is_dir() else path.name
    names = _runs_of(study)
    meant = [name for name in names if name.endswith(part)]
    meant = meant or [name for name in names if name.startswith(part)]
    if len(meant) == 1:
        return study / meant[0]
    remedy = f"name one{'' if meant else ' of its study'}: {_some(meant or names)}"
    problem = f"{len(meant)} runs are there" if meant else f"there is no {RECORD}"
    raise BadRequest("run", path, problem, remedy if names else "give the folder of one run")


def _runs_of(study: Path) -> list[str]:
    return sorted(record.parent.name for record in study.glob(f"*/{RECORD}"))


def _some(names: list[str]) -> str:
    return ", ".join(names[:MANY]) + (f" and {len(names) - MANY} more" if len(names) > MANY else "")
