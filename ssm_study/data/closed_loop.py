"""Replacement of the input in a closed-loop log by the part of the input that the known set point
explains.

A fit from input to output would mistake the controller for a part of the plant where noise is slow.
What the set point r explains of the input, `u_r = F r`, knows nothing of the noise: `y = G u_r + S
v`; the model is fitted to `u_r` and y (two stages). F has `LAGS` samples, within which the input
must have responded; for a nonlinear plant it is the best linear approximation. Of a PI `u = u_eq +
gain (e + i)`, `e = r - y`, r is `y + e`. Source: Van den Hof & Schrama, Automatica 29 (1993)
1523-1527.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.refusal import require, require_at_least
from ssm_study.signals import Trajectory, lagged_inputs

LAGS = 60  # samples of r that an input answers to
FEWEST = 10  # samples for each of them
# share of the samples at the largest or the smallest input, of which a PI does not tell what it
# asked
AT_LIMIT = 0.02
Rows = Float[np.ndarray, "_ r"]


def project_inputs_on_set_points(
    logs: Sequence[Trajectory], references: Sequence[Rows]
) -> tuple[list[Trajectory], float]:
    """Replace the input of closed-loop logs by its projection on the filtered set point, fitted by
    least squares. All logs share one filter; the share of the input's power that it explains is
    returned, too.

    Raises `BadRequest` for logs that are too short.
    """
    record_lengths = map(len, logs)
    require_at_least(
        FEWEST * LAGS, "data.reference (samples of the logs)", sum(record_lengths), "log longer"
    )
    past = []
    for reference in references:
        first_reference = reference[:1]
        at_rest = np.repeat(first_reference, LAGS, axis=0)  # before each log
        extended = np.concatenate([at_rest, reference])
        past.append(lagged_inputs(extended, LAGS))
    x = np.concatenate(past)
    all_inputs = [log.u for log in logs]
    u = np.concatenate(all_inputs)
    solution = np.linalg.lstsq(x, u, rcond=1e-9)
    filtered = solution[0]
    mean = u.mean(axis=0)
    explained = x @ filtered - mean
    by_set_point = (explained**2).sum()
    squares = (u - mean) ** 2
    applied = squares.sum()
    positive_power = max(applied, 1e-300)
    share = float(by_set_point / positive_power)
    lowest = u.min(axis=0)  # beyond what was applied nothing is known
    highest = u.max(axis=0)
    projected = []
    for log, rows in zip(logs, past, strict=True):
        u = np.clip(rows @ filtered, lowest, highest)
        projected_log = replace(log, u=u)
        projected.append(projected_log)
    return projected, share


def reconstruct_pi_set_point(log: Trajectory, gain: float, integral_s: float) -> Rows:
    """Reconstruct the set point of a closed-loop log from input, output and the settings of its PI
    controller. `r = y + e`, `e = (u - u_eq) / gain - i`, `i+ = i + (step_s / integral_s) e`, with i
    as at rest in the beginning.

    Raises `BadRequest` for more than one input or output, and where the input is at a limit, which
    hides e.
    """
    field = "data.controller"
    input_count = log.u.shape[1]
    output_count = log.y.shape[1]
    shape = (input_count, output_count)
    u = log.u[:, 0]
    remedy = "name the set point"
    single_channels = (1, 1)
    require(
        shape == single_channels,
        field,
        shape,
        "are the log's numbers of inputs and outputs, of which a PI needs one each",
        remedy,
    )
    problem = (
        "is the share of samples at a limit of the input, where the applied input is not the PI's"
    )
    lowest = u.min()
    at_lowest = float((u == lowest).mean())
    highest = u.max()
    at_highest = float((u == highest).mean())
    share = max(at_lowest, at_highest)
    remedy = "log the set point, and name it data.reference"
    require(share < AT_LIMIT, field, f"{share:.0%}", problem, remedy)
    demanded = (u - u[0]) / gain
    c = log.step_s / integral_s
    filtered = scipy.signal.lfilter([0.0, c], [1.0, c - 1.0], demanded)
    e = demanded - filtered  # i from asked: i+ = (1 - c) i + c asked
    return log.y + e[:, None]
