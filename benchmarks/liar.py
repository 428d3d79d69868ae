"""Lies of chance in all files of a run: `verify` names each, and accepts the run as it is.

    python -P benchmarks/liar.py RUN [RUN ...] --minutes 10 --table
    results/reference/engine/liar.csv

A copy of a run is altered at one place, sealed anew, and verified: a number of a JSON file is
changed by one part in a thousand to a factor of ten (an integer by one), a truth value turned, a
text
lengthened; a signal of a recording is changed at one sample by a thousandth to one of its range. A
find is a lie that leaves `verify` content, unless it is about what `verify` lists as not checked.
Every
tenth copy is left as it is and must be accepted. The same seed tells the same lies.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.engine.records import RECORD, read_record, write_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.refusal import BadRequest
from ssm_study.study.verify import verify

CONTROL_EVERY = 10
JSON_FILES = (RECORD, "model.json", "certificate.json", "evidence.json")


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to all values of plain containers."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, (*path, key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from leaves(value, (*path, index))
    else:
        yield path


def lie(value: Any, rng: np.random.Generator) -> Any:
    """Another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        factor = 1.0 + 10.0 ** rng.uniform(-3, 1)
        return value * factor if value else 1e-3
    if isinstance(value, str):
        return f"{value}x"
    return 1.0


def alter_json(path: Path, rng: np.random.Generator) -> str:
    tree = read_record(path.parent) if path.name == RECORD else json.loads(path.read_text())
    places = [place for place in leaves(tree) if place[-1] not in ("sha256", "record_version")]
    place = places[rng.integers(len(places))]
    node = tree
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = lie(node[place[-1]], rng)
    if path.name == RECORD:
        write_run_manifest(path.parent)
        write_record(path.parent, tree)
    else:
        path.unlink()  # it may be a link to the store's
        path.write_text(json.dumps(tree))
    return f"{path.name} {'.'.join(map(str, place))}"


def alter_recording(path: Path, rng: np.random.Generator) -> str:
    groups, about = read_mcap(path)
    number = int(rng.integers(len(groups)))
    values = groups[number].values.copy()
    row, column = (int(rng.integers(size)) for size in values.shape)
    size = np.ptp(values[:, column]) or 1.0
    values[row, column] += size * 10.0 ** rng.uniform(-3, 0)
    altered = list(groups)
    altered[number] = replace(groups[number], values=values)
    path.unlink()
    write_mcap(path, tuple(altered), dict(about))
    return f"{path.name} {groups[number].topic} {row} {column}"


def tell(run: Path, rng: np.random.Generator) -> str:
    """Alter one place of the run and seal it anew; says where."""
    files = [run / name for name in JSON_FILES if (run / name).is_file()]
    files += sorted(run.glob("*.mcap"))
    path = files[rng.integers(len(files))]
    told = alter_recording(path, rng) if path.suffix == ".mcap" else alter_json(path, rng)
    if path.name != RECORD:
        record = read_record(run)
        assert record is not None
        write_run_manifest(run)
        write_record(run, record)
    return told


def is_unchecked(about: str, unchecked: Any) -> bool:
    """Whether `verify` says that it did not check the place of the lie."""
    file, _, place = about.partition(" ")
    last = place.rpartition(".")[2]
    if place in unchecked:
        return True
    for name in unchecked:
        row, _, numbers = name.partition(": ")
        if numbers and about in [f"{row}.{number}" for number in numbers.split(", ")]:
            return True
        if not numbers and file in name and last in name.replace(",", "").split():
            return True
    return False


def case(run: Path, number: int, seed: int) -> tuple[str, str]:
    """Where the lie is, and what became of it: named, unchecked, accepted (a control), FIND."""
    rng = np.random.default_rng([seed, number])
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / run.parent.name / run.name
        shutil.copytree(run, copy)
        is_control = number % CONTROL_EVERY == 0
        about = "" if is_control else tell(copy, rng)
        try:
            verified = verify(copy)
        except BadRequest as refusal:
            return about, f"FIND control {refusal}" if is_control else "named"
        if is_control:
            wrong = [str(finding) for finding in verified if not finding.holds]
            return about, "accepted" if verified.holds else f"FIND control {wrong[:3]}"
        if not verified.holds:
            return about, "named"
        return about, "unchecked" if is_unchecked(about, verified.unchecked) else "FIND"


def run_liar() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    begun = time.monotonic()
    answers: Counter[str] = Counter()
    number = 0
    while time.monotonic() - begun < 60 * options.minutes:
        run = options.runs[number // CONTROL_EVERY % len(options.runs)].absolute()
        about, answer = case(run, number, options.seed)
        answers[answer.split()[0]] += 1
        if answer.startswith("FIND") or answer == "unchecked":
            print(f"{number} {run.parent.name}: {about}: {answer}", flush=True)
        number += 1
    names = ("named", "unchecked", "accepted", "FIND")
    rows = ["seed,cases,named,unchecked,controls_accepted,finds,seconds"]
    counts = ",".join(str(answers[name]) for name in names)
    rows.append(f"{options.seed},{number},{counts},{time.monotonic() - begun:.0f}")
    print(rows[-1])
    if options.table:
        options.table.write_text("\n".join(rows) + "\n")
    return 1 if answers["FIND"] else 0


if __name__ == "__main__":
    raise SystemExit(run_liar())
