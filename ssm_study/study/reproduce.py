"""Run it again and compare: the same configuration, an empty store, every number of the record
beside the new one."""

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
from ssm_study.table.columns import OF_THE_LINE, declared

TIMES = "_seconds"  # what a second run may well do differently
TOLERANCE = (
    1e-6  # relative; the same machine and versions give equal bits, another BLAS rounds differently
)
AROUND = ("version_", "git_", "machine", "threads")  # what could explain a difference


def reproduce(run: Path, job: Callable[[DictConfig], object]) -> tuple[list[str], bool]:
    """Do the run's configuration again with `job`, nothing reused; what `compared` says.

    Raises `BadRequest` for a folder that holds no finished run or no configuration.
    """
    then = read_record(run) or {}
    remedy = "give the folder of a run that is ok or infeasible"
    require(then.get("status") in FINISHED, "run", run, "holds no finished run", remedy)
    config = RunFiles(path=run, record=then).config
    with (
        tempfile.TemporaryDirectory() as scratch
    ):  # an empty results folder has an empty store: nothing is reused
        config.update(results_dir=scratch, retry_failed=False, dry_run=False)
        job(config)
        made = [read_record(path.parent) for path in Path(scratch).glob("*/*/record.json")]
        require(
            len(made) == 1,
            "run",
            run,
            f"made {len(made)} records when run again",
            "report this configuration",
        )
        return compared(then, made[0] or {})


def compared(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[list[str], bool]:
    """Two records of one configuration: every column of the line that differs, what was different
    around them, and whether all columns agree."""
    told = {name: declared(name) for name in (*then, *now)}
    names = [
        "status",
        *(
            name
            for name, column in told.items()
            if column in OF_THE_LINE and not name.endswith(TIMES)
        ),
    ]
    sides = {name: (then.get(name), now.get(name)) for name in names}
    pairs = {name: pair for name, pair in sides.items() if pair != (None, None)}
    differing = [name for name, pair in pairs.items() if not _agree(*pair)]
    equal = sum(one == other for one, other in pairs.values())
    around = sorted(
        name for name in told if name.startswith(AROUND) and then.get(name) != now.get(name)
    )
    lines = [
        f"{len(pairs)} columns compared: {equal} equal to the last bit, {len(differing)} differ",
        *(f"  {name}: {pairs[name][0]} then, {pairs[name][1]} now" for name in differing),
        *(f"  changed since: {name} {then.get(name)} -> {now.get(name)}" for name in around),
    ]
    return lines, not differing


def _agree(then: Any, now: Any) -> bool:
    numbers = {type(then), type(now)} <= {int, float}
    return bool(then == now or (numbers and math.isclose(then, now, rel_tol=TOLERANCE)))
