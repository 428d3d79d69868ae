"""What several benchmarks need: where the tables lie, how one is written, the parts of a study,
processor time.

It imports none of them. A script takes it from beside itself (`from common import ROOT`), so that a
copy of the folder writes beside the copy; what runs as `python -m benchmarks.NAME` takes
`benchmarks.common`.
"""

import argparse
import csv
import multiprocessing
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "results" / "reference"
Row = Mapping[str, object]


def write(path: Path, rows: Iterable[Row], columns: Sequence[str] | None = None) -> None:
    """The table as CSV; without `columns` those of all its rows, as they come."""
    told = list(rows)
    names = columns or list(dict.fromkeys(name for row in told for name in row))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(told)


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a table, without its lines of comment; none where there is no table."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def keep(
    path: Path,
    rows: Sequence[Row],
    key: Sequence[str],
    order: Callable[[Row], Any],
    columns: Sequence[str] | None = None,
) -> None:
    """Write these rows in place of those that share their `key`, with all others of the table,
    sorted by `order`."""
    fresh = {tuple(str(row[name]) for name in key) for row in rows}
    others = [row for row in rows_of(path) if tuple(row[name] for name in key) not in fresh]
    write(path, sorted([*rows, *others], key=order), columns)


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a script that makes a table with several jobs at a time."""
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--to", type=Path)
    parser.add_argument("--table", type=Path)


def study_of(*settings: str) -> Any:
    """The parts of the default study with these settings (`Specification`), without a run
    folder."""
    from hydra import compose, initialize_config_dir

    from ssm_study.study.specification import Specification

    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return Specification.from_config(compose("study", ["study=s", *settings]))


def finished_results(
    work: Callable[[Any], Any], tasks: Sequence[Any], jobs: int = 1
) -> Iterator[Any]:
    """The result of each task as soon as it is there, with so many processes at once; the first
    tasks begin first. A task that fails is printed with its error and left out."""
    if jobs == 1:
        for task in tasks:
            yield work(task)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        running = {pool.submit(work, task): task for task in tasks}
        for future in as_completed(running):
            try:
                yield future.result()
            except Exception:  # the other tasks go on
                print(f"{running[future]} failed:", traceback.format_exc(), sep="\n", flush=True)


def cpu_seconds(work: Callable[[], object], calls: int = 1) -> float:
    """Processor seconds, of all threads, of so many calls: other programs on the same cores do not
    count."""
    started = time.process_time()
    for _ in range(calls):
        work()
    return time.process_time() - started
