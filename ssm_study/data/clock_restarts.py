"""Detection of several experiments in one log file. Where the clock starts again, the log is
cut."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data.clock import AGREEMENT, HOLE, EvenlySpacedRows, resample_to_even_clock
from ssm_study.refusal import require

SHORTEST_EXPERIMENT = 10  # rows: of a clock that starts again more often than this it is none
APART = 2  # samples between two experiments: none follows the other


def find_time_restarts(time_s: Float[np.ndarray, "T"]) -> list[int]:
    """Rows of a log file at which its time starts again and another experiment begins. There are
    none where the clock also runs backwards elsewhere."""
    finite = time_s[np.isfinite(time_s)]
    finite_count = len(finite)
    row_count = len(time_s)
    if finite_count < row_count or len(time_s) < 2 * SHORTEST_EXPERIMENT:
        return []
    steps = np.diff(time_s)
    backwards = np.flatnonzero(steps < 0) + 1
    if not len(backwards) or not (steps > 0).any():
        return []
    forward_steps = steps[steps > 0]
    period_s = float(np.median(forward_steps))
    since_first_s = time_s[backwards] - time_s[0]
    begins_again = np.abs(since_first_s) <= HOLE * period_s
    restarts = backwards.tolist()
    bounds = [0, *restarts, len(time_s)]
    lengths = np.diff(bounds)
    all_begin_again = begins_again.all()
    whole = bool(all_begin_again) and int(lengths.min()) >= SHORTEST_EXPERIMENT
    return [int(row) for row in backwards] if whole else []


def resample_experiments(
    time_s: Float[np.ndarray, "T"],
    values: Float[np.ndarray, "T c"],
    inputs: int,
    source: str,
    *,
    step_s: float | None,
    tolerance: float,
    resample: bool,
) -> EvenlySpacedRows:
    """Bring the rows of each experiment in a log file to evenly spaced times, one experiment at a
    time.

    Raises `BadRequest` as `resample_to_even_clock` does, and for experiments of different sampling
    times.
    """
    restarts = find_time_restarts(time_s)
    row_count = len(time_s)
    bounds = [0, *restarts, row_count]
    settings: dict[str, Any] = {"step_s": step_s, "tolerance": tolerance, "resample": resample}
    experiments = []
    for a, b in pairwise(bounds):
        own_times = time_s[a:b]
        own_values = values[a:b]
        rows = resample_to_even_clock(own_times, own_values, inputs, source, **settings)
        experiments.append(rows)
    if not restarts:
        return experiments[0]
    return join_experiments(experiments, source)


def join_experiments(experiments: Sequence[EvenlySpacedRows], source: str) -> EvenlySpacedRows:
    """Join the experiments of one log file, all with the same sampling period, into one log with
    gaps between them."""
    steps_s = [experiment.step_s for experiment in experiments]
    step_s = float(np.median(steps_s))
    differences_s = (abs(each - step_s) for each in steps_s)
    alike = max(differences_s) <= AGREEMENT * step_s
    listing = ", ".join(f"{each:.4g}" for each in steps_s)
    problem = "its clock starts again, and the experiments have different sampling times"
    remedy = "put each experiment into a file of its own"
    require(alike, f"{source} (time)", listing, problem, remedy)
    values: list[np.ndarray] = []
    starts: list[int] = []
    end = 0
    for experiment in experiments:
        values += experiment.values
        starts += [end + start for start in experiment.starts]
        last_row = starts[-1] + len(values[-1])
        end = last_row + APART
    words = [remark for experiment in experiments for remark in experiment.remarks]
    remark = f"the clock starts again: {len(experiments)} experiments"
    distinct_words = dict.fromkeys(words)
    remarks = [remark, *distinct_words]
    return EvenlySpacedRows(values=values, starts=starts, step_s=step_s, remarks=remarks)
