"""Closed-loop trials whose records serve to measure the error between plant and model again.

With `refine=2` the chosen controller runs on the plant, the records of this trial join those for
the mismatch, and the choice is made again; this happens twice. With `refine=[first.csv,second.csv]`
the records are the user's logs of trials, columns and clock as in the run's own data. What such a
record shows: `robustness.mismatch`. Source: docs/trust.md, "The loop as a record".
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssm_study.certificates.certificate import Design
from ssm_study.data.channel_names import as_name_tuple
from ssm_study.data.clock import AGREEMENT
from ssm_study.data.recording import ColumnSettings
from ssm_study.durable import read_json
from ssm_study.engine.settings import run_name
from ssm_study.engine.stages import Facts, Stage
from ssm_study.loop.rollout import Rollouts
from ssm_study.refusal import require, require_at_least
from ssm_study.signals import DataSet, Trajectories, Trajectory
from ssm_study.study.recordings import LOOPS, write_records
from ssm_study.study.stages.dataset import read_dataset, write_dataset
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.model import read_model

if TYPE_CHECKING:
    from ssm_study.data.recorded import RecordedSource
    from ssm_study.study.specification import Specification
    from ssm_study.study.stages.loop import Experiment

TRIED = "tried_designs.json"  # the designs that were tried before, oldest first
FEWEST = 30  # samples of a trial: a third of them tell its initial state


def compute_dataset_with_trials(
    folder: Path, data: DataSet, *designs_and_loops: "Design | Experiment | None"
) -> None:
    """Write the data set of a run together with the records of all closed-loop trials.

    `designs_and_loops` is a design, its loops, the next design, its loops, ...
    """
    designs = [design.to_json() for design in designs_and_loops[::2] if isinstance(design, Design)]
    write_json(folder / TRIED, designs)
    trials: list[Trajectory] = []
    for experiment in designs_and_loops[1::2]:
        if isinstance(experiment, tuple):
            closed, _ = experiment
            trials += records_from_loops(closed.controlled)
    _write_data_with_trials(folder, data, tuple(trials))


def compute_dataset_with_logged_trials(
    folder: Path, records: DataSet, *, refine: list[str], data: "RecordedSource"
) -> None:
    """Write the data set of a run together with the user's logs of closed-loop trials."""
    trials = read_trial_logs(refine, data, records.step_s)
    _write_data_with_trials(folder, records, trials)


def _write_data_with_trials(folder: Path, data: DataSet, trials: Trajectories) -> None:
    """Write a data set to which closed-loop trials are added as records for measuring the model
    error, and a recording of the trials."""
    mismatch_records = (*data.mismatch_records, *trials)
    write_dataset(folder, replace(data, mismatch_records=mismatch_records))
    write_records(folder / LOOPS, data, trials)


def records_from_loops(run: Rollouts) -> Trajectories:
    """Input and output records of closed-loop simulations, each up to the sample at which a signal
    exceeded its bound.

    Cases with fewer than `FEWEST` samples are left out.
    """
    ends = np.where(run.stayed_within_bound, run.y.shape[1], run.left_at_sample)
    records = []
    for i, end in enumerate(ends):
        if end >= FEWEST:
            u = run.u[i, :end]
            y = run.measured[i, :end]
            name = f"case_{i}"
            trajectory = Trajectory(u=u, y=y, step_s=run.step_s, name=name, closed_loop=True)
            records.append(trajectory)
    return tuple(records)


def read_trial_logs(paths: Sequence[str], data: "RecordedSource", step_s: float) -> Trajectories:
    """Read the user's logs of closed-loop trials with the column names and units of the run's data.

    Raises `BadRequest` for logs that the run's own data source would refuse, and for another
    sampling time.
    """
    source: Any = data
    columns: ColumnSettings = source if isinstance(source, ColumnSettings) else source.training[0]
    in_both = set(as_name_tuple(columns.input)) & set(as_name_tuple(columns.output))
    problem = "names an input and an output, in files of their own"
    remedy = "give the two columns different names"
    require(not in_both, "data.output", sorted(in_both), problem, remedy)
    trials: list[Trajectory] = []
    for path in paths:
        record = columns.read_record(Path(path))
        _check_trial_log(record, path, step_s)
        trials.append(replace(record, step_s=step_s, closed_loop=True))
    return tuple(trials)


def _check_trial_log(record: Trajectory, path: str, step_s: float) -> None:
    """Raise `BadRequest` for the log of a trial that is too short, has another sampling time, or
    has a constant input."""
    is_in_step = abs(record.step_s - step_s) <= AGREEMENT * step_s
    problem = f"the model's sampling time is {step_s:g} s"
    remedy = "log the trial at that sampling time"
    require(is_in_step, f"{path} (step_s)", record.step_s, problem, remedy)
    require_at_least(FEWEST, f"{path} (samples)", len(record), "log a longer trial")
    moves = bool(np.ptp(record.u, axis=0).any())
    problem = "the input never moves, so nothing was tried"
    remedy = "log the controller's own input"
    require(moves, f"{path} (input)", float(record.u[0, 0]), problem, remedy)


def reproduce_trials(request: "Specification", run: Path) -> Trajectories:
    """Read the closed-loop trials of a finished run again from its logs, or simulate them again."""
    if request.refine is None:
        return ()
    model = read_model(run)
    plant = request.plant
    if isinstance(request.refine, list) or plant is None:
        logs: Any = request.refine
        data: Any = request.data
        return read_trial_logs(logs, data, model.step_s)
    experiment = request.loop.with_default_horizon(model)
    trials: list[Trajectory] = []
    for content in read_json(run / TRIED):
        design = Design.from_json(content)
        closed = experiment.run_design(plant, model, design, request.loop_seed)
        trials += records_from_loops(closed.controlled)
    return tuple(trials)


def refinement_columns(settings: Any) -> Facts:
    """Table columns on the refinement of a run: the number of refinements, and the run that was
    refined.

    That is the same run with one iteration, or one log, less.
    """
    refine = settings.get("refine")
    if refine is None:
        return {}
    if isinstance(refine, list):
        count = len(refine)
        before = refine[:-1]
    else:
        count = refine
        before = refine - 1
    return {"refinements": count, "parent_run": refined_run_name(settings, before or None)}


def refined_run_name(settings: Any, refine: int | list[str] | None) -> str:
    """Name of the run that has the same settings except for another number of refinements. The part
    before the hash stays the same."""
    prefix = str(settings["run"]).removesuffix(run_name(settings))
    changed = type(settings)({**settings, "refine": refine})
    return prefix + run_name(changed)


TRIALS = Stage("trials", compute_dataset_with_trials, read_dataset, files=(LOOPS, TRIED))
LOGS = Stage("trials", compute_dataset_with_logged_trials, read_dataset, files=(LOOPS,))
