"""Where the benchmark records lie: a folder of one's own, one beside the clone, or the official downloader's cache."""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ssm_study.refusal import BadRequest

RECORDS_VARIABLE = "SSM_STUDY_DATA"  # a folder with one folder per benchmark
RECORDS_BESIDE = Path("../shared/data")  # where a clone may have them, relative to the folder one works in
DOWNLOADERS = {"emps": "EMPS", "ced": "CED", "cascaded_tanks": "Cascaded_Tanks"}  # names in nonlinear_benchmarks


def benchmark_folder(benchmark: str) -> Path:
    """The folder of `emps`, `ced` or `cascaded_tanks`: in $SSM_STUDY_DATA, in ../shared/data, or downloaded.

    The download needs the extra `benchmarks` and a network. Raises `BadRequest` when there is no way to the records.
    """
    around = [Path(os.environ[RECORDS_VARIABLE])] if RECORDS_VARIABLE in os.environ else []
    for place in (*around, RECORDS_BESIDE):
        if (place / benchmark).is_dir():
            return place / benchmark
    return downloaded(benchmark)


def downloaded(benchmark: str) -> Path:
    """The folder into which the official package has put, or now puts, a benchmark's files; refuses without."""
    problem = f"the {benchmark} records are neither in ${RECORDS_VARIABLE} nor in {RECORDS_BESIDE}"
    remedy = "give data.folder=PATH, or pip install 'ssm-study[benchmarks]' to download them"
    try:
        package: Any = importlib.import_module("nonlinear_benchmarks")
        fetch: Callable[..., Any] = getattr(package, DOWNLOADERS[benchmark])
    except (ImportError, KeyError) as error:
        raise BadRequest("data.folder", None, problem, remedy) from error
    try:
        located = fetch(data_file_locations=True)
    except Exception as error:  # whatever the network and the archive readers raise (2026-11)
        raise BadRequest("data.folder", None, f"{problem}, and downloading failed ({error})", remedy) from error
    return Path(located if isinstance(located, str | os.PathLike) else located[0]).parent


def file_in(folder: Path, name: str) -> Path:
    """The file of that name, or of its stem as CSV or MAT: records are distributed as both. Refuses without."""
    exact = folder / name
    if exact.is_file():
        return exact
    twins = sorted(p for p in folder.iterdir() if p.stem == exact.stem and p.suffix.lower() in (".mat", ".csv"))
    if not twins:
        raise BadRequest("data.folder", folder, f"has no {name}", "point it at the benchmark's own folder")
    return twins[0]
