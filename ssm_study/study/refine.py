"""`refine`: measure the mismatch again in the loop itself, and choose again, until what is proved
covers what is seen.

Each iteration is a run of the study: the configuration of the one before with one trial more
(`study.trials`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from ssm_study.engine.records import FAILED, INFEASIBLE, OK, read_record
from ssm_study.engine.runs import Outcome
from ssm_study.refusal import require
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.study.line import STUDY
from ssm_study.study.loop_recordings import read_experiment
from ssm_study.study.run_files import CONFIGURATION, RunFiles
from ssm_study.study.trials import named, of_loops, read_logs

# iterations at most: of the designs that failed on plants whose record hid something, two mended
# most
TIMES = 4


@dataclass(frozen=True, kw_only=True)
class Step:
    """One iteration, or the end: the sentence, and the configuration of the run that it speaks of,
    if a new one."""

    said: str
    config: DictConfig | None = None


def refine(run: Path, log: Path | None = None, times: int = TIMES) -> Iterator[Step]:
    """The runs that come of `run`, one after the other, and last why there are no more.

    `log` is the record of a trial of the run's controller: one iteration. Without it the trials are
    the closed loops on the run's own plant. Raises `BadRequest` for a run that is not ok, has no
    controller or no plant, or for its log.
    """
    files = _tried(run, log)
    for _ in range(1 if log else times):
        proved = files.record.get("certified_tolerance") or 0.0
        shown = _seen(files, log)
        if shown <= proved:
            covered = f"what is proved ({proved:.3g}) covers what the loop shows ({shown:.3g})."
            still = (
                "the loop comes to rest, so it shows nothing that makes it swing; the choice "
                "stays as it is."
            )
            yield Step(said=f"Stopped: {covered if shown else still}")
            return
        config = _next(files, log)
        outcome: Outcome = STUDY.job(config)
        child = RunFiles(path=outcome.folder, record=read_record(outcome.folder) or {})
        yield Step(said=_told(child, proved, shown, outcome), config=config)
        if outcome.status == FAILED:
            return
        before = files.design.gains
        after = child.design.gains
        if before.keys() == after.keys() and all(
            np.array_equal(before[name], after[name]) for name in before
        ):
            yield Step(
                said=f"Stopped: the choice no longer changes, although only {proved:.3g} is proved."
            )
            return
        files = child
    yield Step(
        said="Try the new design and refine with its log."
        if log
        else f"Stopped after {times} iterations."
    )


def _tried(run: Path, log: Path | None) -> RunFiles:
    """The run's files; refuses what cannot be refined."""
    files = RunFiles(path=run, record=read_record(run) or {})
    status = files.record.get("status")
    remedy = "give the folder of a run in its study"
    require(
        (run / CONFIGURATION).is_file() and bool(status), "run", run, "is no run folder", remedy
    )
    require(
        status != INFEASIBLE,
        "run",
        run,
        "is infeasible, so there is no loop",
        "change the request first",
    )
    require(status == OK, "run", run, f"its status is {status}", "give a run that is ok")
    require(
        files.record.get("run") == run.name,
        "run",
        run,
        f"was made as {files.record.get('run')}",
        remedy,
    )
    require(
        files.claims_certificate,
        "run",
        run,
        "is a baseline's, which has no controller",
        "use model=ssm",
    )
    if log is None:
        known = files.record.get("loop_on") == "plant"
        remedy = "give the log of a trial: --record log.csv"
        require(known, "run", run, "its data are recorded, so no plant is known", remedy)
    else:
        own = "the run has a plant of its own, on which the loop is closed"
        require(files.specification.plant is None, "--record", log, own, "leave it out")
        require(log.is_file(), "--record", log, "no such file", "check the spelling")
    return files


def _seen(files: RunFiles, log: Path | None) -> float:
    """The largest mismatch gain that the trial shows, beside the noise that the run's records
    measured."""
    if log is None:
        trial = of_loops(read_experiment(files.path)[0].controlled)
    else:
        trial = read_logs([str(log)], files.specification.data, files.model.step_s)  # type: ignore[arg-type]
    known = files.simulated.validation
    kept = tuple(one for one in files.trials if not one.closed_loop)
    shown = measure_mismatch(files.model, known.records, known.start_up_samples, kept + trial)
    return 0.0 if shown.loop is None else shown.loop.gain


def _next(files: RunFiles, log: Path | None) -> DictConfig:
    """The configuration with one trial more, in the study where the run lies."""
    config = files.config.copy()
    before = files.specification.refine
    logs, count = (before, 0) if isinstance(before, list) else ([], before or 0)
    more: Any = count + 1 if log is None else [*logs, str(log)]
    config.update(
        results_dir=str(files.path.parent.parent), study=files.path.parent.name, retry_failed=False
    )
    config["run"] = named(STUDY.settings(config), more)
    config["refine"] = more
    return config


def _told(child: RunFiles, proved: float, shown: float, outcome: Outcome) -> str:
    if outcome.status == FAILED:
        return f"{child.path.name}: failed: {outcome.message}"
    record = child.record
    judged = {
        True: "predicted to be stable",
        False: "not predicted to be stable",
        None: "not judged",
    }
    counts = (record.get(name) for name in ("stable_count", "initial_conditions"))
    settled = ", {:.0f} of {:.0f} settle".format(*counts) if "stable_count" in record else ""
    chosen = f"chosen again: {judged[record['predicted_stable']]}{settled}"
    return (
        f"{child.path.name}: the loop showed a mismatch of {shown:.3g}, {proved:.3g} was proved; "
        f"{chosen}"
    )
