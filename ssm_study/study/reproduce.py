"""Run it again and compare: the same configuration, an empty store, every number of the record beside the new one."""

import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ssm_study.engine.durable import contents
from ssm_study.engine.records import read_record
from ssm_study.engine.runs import FINISHED
from ssm_study.refusal import require
from ssm_study.table.columns import OF_THE_LINE, declared

TIMES = "_seconds"  # what a second run may well do differently
TOLERANCE = 1e-6  # relative; the same machine and versions give equal bits, another BLAS rounds differently
AROUND = ("version_", "git_", "machine", "threads")  # what could explain a difference


def reproduce(run: Path, job: Callable[[DictConfig], object]) -> tuple[list[str], bool]:
    """Do the run's configuration again with `job`, nothing reused; what `compared` says.

    Raises `BadRequest` for a folder that holds no finished run or no configuration.
    """
    then = read_record(run) or {}
    remedy = "give the folder of a run that is ok or infeasible"
    require(then.get("status") in FINISHED, "run", run, "holds no finished run", remedy)
    with tempfile.TemporaryDirectory() as scratch:
        return compared(then, _again(run, job, Path(scratch)))


def _again(run: Path, job: Callable[[DictConfig], object], results: Path) -> dict[str, Any]:
    file = run / ".hydra" / "config.yaml"
    require(file.is_file(), "run", run, "has no .hydra/config.yaml", "give a run folder that the study made")
    config = OmegaConf.create(contents(file).decode())
    assert isinstance(config, DictConfig)
    # An empty results folder has an empty store: nothing can be reused.
    for key, value in {"results_dir": str(results), "retry_failed": False, "dry_run": False}.items():
        OmegaConf.update(config, key, value)
    job(config)
    records = [read_record(path.parent) for path in results.glob("*/*/record.json")]
    require(len(records) == 1, "run", run, f"made {len(records)} records when run again", "report this configuration")
    return records[0] or {}


def compared(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[list[str], bool]:
    """Two records of one configuration: every column of the line that differs, what was different around them, and
    whether all columns agree."""
    told = {name: declared(name) for name in (*then, *now)}
    names = ["status", *(name for name, column in told.items() if column in OF_THE_LINE and not name.endswith(TIMES))]
    pairs = {name: (then.get(name), now.get(name)) for name in names}
    by_how_much = {name: difference(*pair) for name, pair in pairs.items() if pair != (None, None)}
    differing = [name for name, much in by_how_much.items() if much > TOLERANCE]
    equal = sum(much == 0 for much in by_how_much.values())
    around = sorted(name for name in told if name.startswith(AROUND) and then.get(name) != now.get(name))
    lines = [
        f"{len(by_how_much)} columns compared: {equal} equal to the last bit, {len(differing)} differ",
        *(f"  {name}: {pairs[name][0]} then, {pairs[name][1]} now" for name in differing),
        *(f"  changed since: {name} {then.get(name)} -> {now.get(name)}" for name in around),
    ]
    return lines, not differing


def difference(then: Any, now: Any) -> float:
    """Relative difference of two numbers; 0 for equal values, infinite for unequal words or a missing side."""
    if then == now:
        return 0.0
    if not all(isinstance(side, (int, float)) and not isinstance(side, bool) for side in (then, now)):
        return math.inf
    return float(abs(now - then) / max(abs(then), abs(now)))
