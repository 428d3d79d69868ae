"""Is a record sampled uniformly, at the rate that is claimed? If not, say where, and offer to resample."""

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import BadRequest, require

AGREEMENT = 1e-3  # relative difference allowed between the claimed sampling time and the one the times show


def uniform_step_s(
    time_s: Float[np.ndarray, "T"], claimed_s: float | None, jitter_tolerance: float, where: str
) -> float:
    """The sampling time of increasing, uniform `time_s`: the claimed one if given, else the mean period.

    Every instant must lie within `jitter_tolerance` of a period of where the clock puts it. Raises `BadRequest`.
    """
    mean_s = mean_period_s(time_s, where)
    late = np.abs(time_s - time_s[0] - mean_s * np.arange(len(time_s))) / mean_s
    worst = int(np.argmax(late))
    require(
        float(late[worst]) <= jitter_tolerance,
        f"{where} (time)",
        time_s[worst],
        f"sample {worst} is {late[worst]:.2g} periods off a uniform clock, and {jitter_tolerance:g} is tolerated",
        "set data.resample=true to interpolate onto a uniform clock, or raise data.jitter_tolerance",
    )
    require(
        claimed_s is None or abs(claimed_s - mean_s) <= AGREEMENT * mean_s,
        "data.step_s",
        claimed_s,
        f"the times of {where} show {mean_s:.6g} s",
        "correct one of them (units?), or leave step_s null",
    )
    return mean_s if claimed_s is None else claimed_s


def mean_period_s(time_s: Float[np.ndarray, "T"], where: str) -> float:
    """Refuses times that do not increase; the mean period otherwise."""
    require(len(time_s) >= 2, f"{where} (time)", len(time_s), "two samples are needed", "use a longer record")
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise BadRequest(
            f"{where} (time)", time_s[k], f"sample {k} is not later than the one before", "sort the record"
        )
    return float((time_s[-1] - time_s[0]) / (len(time_s) - 1))


def resampled(
    time_s: Float[np.ndarray, "T"], values: Float[np.ndarray, "T c"], step_s: float
) -> Float[np.ndarray, "T2 c"]:
    """Linear interpolation onto `t0, t0 + step_s, ...`."""
    count = int(np.floor((time_s[-1] - time_s[0]) / step_s + 1e-9)) + 1
    clock = time_s[0] + step_s * np.arange(count)
    return np.stack([np.interp(clock, time_s, column) for column in values.T], axis=1)
