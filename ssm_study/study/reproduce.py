"""Reproduction of a run with the same configuration and an empty store, to compare all recorded
numbers."""

import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from ssm_study.engine.records import read_record
from ssm_study.engine.runs import FINISHED
from ssm_study.refusal import require
from ssm_study.study.run_files import RunFiles
from ssm_study.table.columns import OF_THE_LINE, find_declaration

TIMES = "_seconds"  # columns in which a second run may well differ
# relative; the same machine and versions give equal bits, another BLAS rounds differently
TOLERANCE = 1e-6
AROUND = ("version_", "git_", "machine", "threads")  # columns that could explain a difference


def reproduce(run: Path, job: Callable[[DictConfig], object]) -> tuple[list[str], bool]:
    """Run the configuration of a finished run again with an empty store, and compare the two
    records.

    Returns what `compare_records` returns. Raises `BadRequest` for a folder that holds no finished
    run or no configuration.
    """
    then = read_record(run) or {}
    remedy = "give the folder of a run that is ok or infeasible"
    require(then.get("status") in FINISHED, "run", run, "holds no finished run", remedy)
    config = RunFiles(path=run, record=then).config
    # An empty results folder has an empty store: nothing is reused.
    with tempfile.TemporaryDirectory() as scratch:
        config.update(results_dir=scratch, retry_failed=False, dry_run=False)
        job(config)
        new_records = [read_record(path.parent) for path in Path(scratch).glob("*/*/record.json")]
        problem = f"made {len(new_records)} records when run again"
        require(len(new_records) == 1, "run", run, problem, "report this configuration")
        return compare_records(then, new_records[0] or {})


def compare_records(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[list[str], bool]:
    """Sentences on the differences between two records of the same configuration, and whether the
    records agree.

    Returns lines with every column of the line that differs and what was different around them,
    and whether all columns agree.
    """
    all_names = dict.fromkeys((*then, *now))
    of_the_line = [name for name in all_names if find_declaration(name) in OF_THE_LINE]
    names = ["status", *(name for name in of_the_line if not name.endswith(TIMES))]
    pairs = {}
    for name in names:
        pair = (then.get(name), now.get(name))
        if pair != (None, None):
            pairs[name] = pair
    differing = [name for name, pair in pairs.items() if not _equals_up_to_rounding(*pair)]
    equal = sum(before == after for before, after in pairs.values())
    counts = f"{equal} equal to the last bit, {len(differing)} differ"
    lines = [f"{len(pairs)} columns compared: {counts}"]
    for name in differing:
        before, after = pairs[name]
        lines.append(f"  {name}: {before} then, {after} now")
    for name in sorted(name for name in all_names if name.startswith(AROUND)):
        if then.get(name) != now.get(name):
            lines.append(f"  changed since: {name} {then.get(name)} -> {now.get(name)}")
    return lines, not differing


def _equals_up_to_rounding(then: Any, now: Any) -> bool:
    """Whether a recorded value is the same in both records, except for rounding errors of numbers,
    which differ between machines."""
    if then == now:
        return True
    are_numbers = {type(then), type(now)} <= {int, float}
    return are_numbers and math.isclose(then, now, rel_tol=TOLERANCE)
