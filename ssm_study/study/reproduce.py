"""Run it again and compare: the same configuration, an empty store, every number of the record beside the new one."""

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ssm_study.engine.records import read_record
from ssm_study.engine.runs import FINISHED
from ssm_study.refusal import require
from ssm_study.table.columns import OF_THE_LINE, declared

TIMES = "_seconds"  # what a second run may well do differently

TOLERANCE = 1e-6  # relative; the same machine and versions give equal bits, another BLAS rounds differently


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One column of the record, then and now."""

    column: str
    then: Any
    now: Any

    @property
    def difference(self) -> float:
        """Relative difference of two numbers; 0 for equal values, infinite for unequal words or a missing side."""
        if self.then == self.now:
            return 0.0
        if not all(isinstance(side, (int, float)) and not isinstance(side, bool) for side in (self.then, self.now)):
            return math.inf
        return abs(self.now - self.then) / max(abs(self.then), abs(self.now))


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """Every column of the line compared, and what differs between then and now that could explain it."""

    comparisons: tuple[Comparison, ...]
    circumstances: tuple[Comparison, ...]

    def differing(self, tolerance: float = TOLERANCE) -> list[Comparison]:
        return [comparison for comparison in self.comparisons if comparison.difference > tolerance]

    def holds(self, tolerance: float = TOLERANCE) -> bool:
        return not self.differing(tolerance)

    def lines(self, tolerance: float = TOLERANCE) -> list[str]:
        differing = self.differing(tolerance)
        equal = sum(comparison.difference == 0 for comparison in self.comparisons)
        return [
            f"{len(self.comparisons)} columns compared: {equal} equal to the last bit, {len(differing)} differ",
            *(f"  {c.column}: {c.then} then, {c.now} now" for c in differing),
            *(f"  changed since: {c.column} {c.then} -> {c.now}" for c in self.circumstances),
        ]


def reproduce(run: Path, job: Callable[[DictConfig], object], keep: Path | None = None) -> Reproduction:
    """Do the run's configuration again with `job`, nothing reused, and compare; `keep` is where the new run stays.

    Raises `BadRequest` for a folder that holds no finished run or no configuration.
    """
    then = read_record(run) or {}
    remedy = "give the folder of a run that is ok or infeasible"
    require(then.get("status") in FINISHED, "run", run, "holds no finished run", remedy)
    with tempfile.TemporaryDirectory() as scratch:
        return compare(then, _again(run, job, keep or Path(scratch)))


def _again(run: Path, job: Callable[[DictConfig], object], results: Path) -> dict[str, Any]:
    file = run / ".hydra" / "config.yaml"
    require(file.is_file(), "run", run, "has no .hydra/config.yaml", "give a run folder that the study made")
    config = OmegaConf.load(file)
    assert isinstance(config, DictConfig)
    # An empty results folder has an empty store: nothing can be reused.
    for key, value in {"results_dir": str(results), "retry_failed": False, "dry_run": False}.items():
        OmegaConf.update(config, key, value)
    job(config)
    records = [read_record(path.parent) for path in results.glob("*/*/record.json")]
    require(len(records) == 1, "run", run, f"made {len(records)} records when run again", "report this configuration")
    return records[0] or {}


def compare(then: Mapping[str, Any], now: Mapping[str, Any]) -> Reproduction:
    """Two records of one configuration, column by column; what was different around them beside it."""
    told = {name: declared(name) for name in (*then, *now)}
    names = ["status", *(name for name, column in told.items() if column in OF_THE_LINE and not name.endswith(TIMES))]
    pairs = [Comparison(column=name, then=then.get(name), now=now.get(name)) for name in names]
    about = sorted(name for name in {*then, *now} if name.startswith(("version_", "git_", "machine", "threads")))
    circumstances = [Comparison(column=name, then=then.get(name), now=now.get(name)) for name in about]
    return Reproduction(
        comparisons=tuple(pair for pair in pairs if pair.then is not None or pair.now is not None),
        circumstances=tuple(pair for pair in circumstances if pair.then != pair.now),
    )
