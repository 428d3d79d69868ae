"""Trials in closed loop: records of the loop itself, by which the mismatch is measured again.

With `refine=2` the choice runs on the plant, its records join those for the mismatch, and it is
made again; twice. With `refine=[first.csv,second.csv]` the records are the user's logs of trials,
columns and clock as in the run's own data. What such a record shows: `synthesis.mismatch`. Source:
docs/trust.md, "The loop as a record".
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssm_study.certificates.certificate import Design
from ssm_study.data.clock import AGREEMENT
from ssm_study.data.recording import Columns, listed
from ssm_study.engine.settings import run_name
from ssm_study.engine.stages import Facts, Stage
from ssm_study.loop.rollout import Rollouts
from ssm_study.refusal import at_least, require
from ssm_study.signals import DataSet, Trajectories, Trajectory
from ssm_study.study.recordings import LOOPS, write_records
from ssm_study.study.stages.dataset import read_dataset, write_dataset
from ssm_study.study.stages.files import read_json, write_json
from ssm_study.study.stages.model import read_model

if TYPE_CHECKING:
    from ssm_study.data.recorded import RecordedSource
    from ssm_study.study.specification import Specification
    from ssm_study.study.stages.loop import Experiment

TRIED = "tried_designs.json"  # the designs that were tried before, oldest first
FEWEST = 30  # samples of a trial: a third of them tell its initial state


def compute_tried(folder: Path, data: DataSet, *tried: "Design | Experiment | None") -> None:
    """The records with those of every loop in `tried`: design, its loops, the next design, its
    loops, ..."""
    write_json(
        folder / TRIED, [design.to_json() for design in tried[::2] if isinstance(design, Design)]
    )
    loops = [
        trial
        for found in tried[1::2]
        if isinstance(found, tuple)
        for trial in of_loops(found[0].controlled)
    ]
    _write(folder, data, tuple(loops))


def compute_logged(
    folder: Path, records: DataSet, *, refine: list[str], data: "RecordedSource"
) -> None:
    """The records with the user's logs of trials."""
    _write(folder, records, read_logs(refine, data, records.step_s))


def _write(folder: Path, data: DataSet, loops: Trajectories) -> None:
    write_dataset(folder, replace(data, mismatch_records=(*data.mismatch_records, *loops)))
    write_records(folder / LOOPS, data, loops)


def of_loops(run: Rollouts) -> Trajectories:
    """Input and measured output of every case, up to where it left its bound; none of cases below
    `FEWEST` samples."""
    ends = np.where(run.stayed, run.y.shape[1], run.left_at_sample)
    return tuple(
        Trajectory(u=u[:end], y=y[:end], step_s=run.step_s, name=f"case_{i}", closed_loop=True)
        for i, (u, y, end) in enumerate(zip(run.u, run.measured, ends, strict=True))
        if end >= FEWEST
    )


def read_logs(paths: Sequence[str], data: "RecordedSource", step_s: float) -> Trajectories:
    """Logs of trials, read as the run's data are. Raises `BadRequest` as they do, and for another
    sampling time."""
    columns: Columns = data if isinstance(data, Columns) else data.training[0]  # type: ignore[attr-defined]
    found: list[Trajectory] = []
    both = set(listed(columns.input)) & set(listed(columns.output))
    problem = "names an input and an output, in files of their own"
    remedy = "give the two columns different names"
    require(not both, "data.output", sorted(both), problem, remedy)
    for path in paths:
        record = columns.read_from(Path(path))
        problem = f"the model's sampling time is {step_s:g} s"
        remedy = "log the trial at that sampling time"
        require(
            abs(record.step_s - step_s) <= AGREEMENT * step_s,
            f"{path} (step_s)",
            record.step_s,
            problem,
            remedy,
        )
        at_least(FEWEST, f"{path} (samples)", len(record), "log a longer trial")
        problem = "the input never moves, so nothing was tried"
        remedy = "log the controller's own input"
        require(
            bool(np.ptp(record.u, axis=0).any()),
            f"{path} (input)",
            float(record.u[0, 0]),
            problem,
            remedy,
        )
        found.append(replace(record, step_s=step_s, closed_loop=True))
    return tuple(found)


def repeated(request: "Specification", run: Path) -> Trajectories:
    """The trials of a finished run, made again: its logs read, or the designs that were tried
    simulated."""
    if request.refine is None:
        return ()
    model = read_model(run)
    plant = request.plant
    if isinstance(request.refine, list) or plant is None:
        return read_logs(request.refine, request.data, model.step_s)  # type: ignore[arg-type]  # recorded, as checked
    designs = [Design.from_json(content) for content in read_json(run / TRIED)]
    loops = [
        request.loop.fitted(model).run(plant, model, one, request.loop_seed) for one in designs
    ]
    return tuple(trial for closed in loops for trial in of_loops(closed.controlled))


def lineage(settings: Any) -> Facts:
    """How often a run refines, and the run that it refines: the same with one iteration, or one
    log, less."""
    refine = settings.get("refine")
    if refine is None:
        return {}
    count, before = (len(refine), refine[:-1]) if isinstance(refine, list) else (refine, refine - 1)
    return {"refinements": count, "parent_run": named(settings, before or None)}


def named(settings: Any, refine: int | list[str] | None) -> str:
    """The name of the run of these settings with another `refine`; what stands before its hash
    stays."""
    shown = str(settings["run"]).removesuffix(run_name(settings))
    return shown + run_name(type(settings)({**settings, "refine": refine}))


TRIALS = Stage("trials", compute_tried, read_dataset, files=(LOOPS, TRIED))
LOGS = Stage("trials", compute_logged, read_dataset, files=(LOOPS,))
