"""The loop itself, a thousand cases in one array, and whether they settle.

Judged on the true output alone, never on the noisy measurement.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from ssm_study.loop.controller import Controller
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require

# An estimate (scaled), or an input in the plant's own amplitudes from rest, beyond this counts as
# having left the
# bound: the plant may saturate while the estimate grows without end.
LARGEST_SIGNAL = 1e6
STAYED = -1  # `left_at_sample` of a case that never left the bound
UNLIMITED = (-np.inf, np.inf)
Limit = float | Float[np.ndarray, "*m"]
Limits = tuple[Limit, Limit]
Shrinks = Float[np.ndarray, "N"]
DWELL = 0.1  # share of the horizon, at its end, that a settled case spends in the band: a last sample in it is no rest
STEADY = 0.9  # a case whose largest error in the last quarter is below this share of the one before is still on its way


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """N cases of T samples each; `u[:, k]` is held over sample k, `y[:, k]` is read before it acts.
    Physical units.

    `y` is the true output, `measured` what the controller saw, `estimate` its state estimate (the
    model's scaled
    state, width 0 if it has none). A case that leaves `|y - y_eq| <= bound` is stopped there:
    `left_at_sample` says
    when (`STAYED` if never), and from then on its signals repeat the last values inside the bound.
    One that starts
    outside repeats its start, with the input at rest: none was applied.
    """

    step_s: float
    reference: Float[np.ndarray, "T p"]
    u: Float[np.ndarray, "N T m"]
    y: Float[np.ndarray, "N T p"]
    measured: Float[np.ndarray, "N T p"]
    estimate: Float[np.ndarray, "N T n"]
    states: Float[np.ndarray, "N T x"]
    bound: Float[np.ndarray, "p"]
    left_at_sample: Int[np.ndarray, "N"] = field(repr=False)

    @property
    def stayed(self) -> Bool[np.ndarray, "N"]:
        return self.left_at_sample == STAYED

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        return np.arange(self.y.shape[1]) * self.step_s


def close_loop(
    plant: Plant,
    controller: Controller,
    *,
    x0: Float[np.ndarray, "N x"],
    reference: Float[np.ndarray, "T p"],
    noise: Float[np.ndarray, "N T p"],
    disturbance: Float[np.ndarray, "N T q"],
    bound: Float[np.ndarray, "p"],
    limits: Limits = UNLIMITED,
) -> Rollouts:
    """`u[k] = controller(y[k] + noise[k])`, `x[k+1] = plant.advance(x[k], u[k], d[k])`, all cases
    at once.

    `bound (p,)` is the largest `|y - y_eq|` a case may reach before it is stopped, in the output's
    unit; input limits
    (input's unit) are known to the controller. Raises `BadRequest` for unmatched plant and
    controller.
    """
    _matched(plant, controller)
    (cases, samples, p), memory, x = noise.shape, controller.start(len(noise)), x0
    targets, rest, amplitude = (
        controller.targets(reference),
        plant.equilibrium(),
        np.array(plant.input_amplitude),
    )
    if any(np.isfinite(end).any() for end in limits):
        _reachable(controller.demanded(reference), limits)
    widths = {"u": len(plant.inputs), "y": p, "measured": p, "states": x0.shape[1]}
    widths["estimate"] = controller.estimate(memory).shape[1]
    log = {name: np.zeros((cases, samples, width)) for name, width in widths.items()}
    left, going = np.full(cases, STAYED), np.arange(cases)
    for k in range(samples):
        y = plant.output(x)
        seen = y + noise[going, k]
        u = np.clip(controller.input(memory, seen, targets[k]), *limits)
        sizes = np.hstack([(u - rest.u) / amplitude, controller.estimate(memory)])
        inside = (np.abs(y - rest.y) <= bound).all(axis=1) & (np.abs(sizes) < LARGEST_SIGNAL).all(
            axis=1
        )
        if not inside.all():  # only those that stay go on
            left[going[~inside]] = k
            for name, value in {
                "u": np.tile(rest.u, (len(y), 1)),
                "y": y,
                "measured": seen,
                "states": x,
            }.items():
                log[name][going[~inside], k:] = value[~inside, None]
            x, y, seen, u, memory, going = (part[inside] for part in (x, y, seen, u, memory, going))
            controller = controller.among(inside)
        values = {
            "u": u,
            "y": y,
            "measured": seen,
            "states": x,
            "estimate": controller.estimate(memory),
        }
        for name, value in values.items():
            log[name][going, k] = value
        memory, x = (
            controller.advance(memory, u, seen, targets[k]),
            plant.advance(x, u, disturbance[going, k]),
        )
    for case in np.flatnonzero(left > 0):
        for values_of in log.values():
            values_of[case, left[case] :] = values_of[case, left[case] - 1]
    return Rollouts(
        step_s=plant.step_s, reference=reference, bound=bound, left_at_sample=left, **log
    )


def _matched(plant: Plant, controller: Controller) -> None:
    has, given = (len(plant.inputs), len(plant.outputs)), controller.dimensions
    remedy = "identify the model on this plant's records"
    require(given == has, "controller inputs, outputs", given, f"the plant has {has}", remedy)
    alike = bool(np.isclose(controller.step_s, plant.step_s, rtol=1e-9))
    problem, remedy = (
        f"the plant is sampled every {plant.step_s} s",
        "identify the model at the plant's sampling time",
    )
    require(alike, "controller.step_s", controller.step_s, problem, remedy)


def _reachable(demanded: Float[np.ndarray, "K m"], limits: Limits) -> None:
    excess = float(np.abs(demanded - np.clip(demanded, *limits)).max(initial=0.0))
    if excess == 0.0:
        return
    ends = tuple(np.asarray(end).tolist() for end in limits)
    problem = f"what the loop is to hold is held by inputs from {demanded.min():.4g} to {demanded.max():.4g}"
    remedy = f"widen the limits by {excess:.4g}, or choose a smaller loop.reference"
    raise BadRequest("loop.input_lower, loop.input_upper", ends, problem, remedy)


def last_step(reference: Float[np.ndarray, "T p"]) -> int:
    """The sample at which a reference of steps takes its last value; 0 if it still moves in the
    second half."""
    changes = np.flatnonzero(np.any(np.diff(reference, axis=0) != 0, axis=1))
    last = int(changes[-1]) + 1 if len(changes) else 0
    return last if last <= len(reference) // 2 else 0


def settling_times_s(rollouts: Rollouts, band: float) -> tuple[float | None, ...]:
    """Seconds after the last step of the reference from which `|y - reference| <= band` holds to
    the end.

    None if there is no such time, or if less than `DWELL` of the horizon follows it. `band` in the
    output's unit. A
    case that left the bound never settles, whatever it did before; one that is in the band
    throughout settles in 0.
    """
    outside = (np.abs(rollouts.y - rollouts.reference) > band).any(axis=2)
    samples = outside.shape[1]
    first = np.where(outside.any(axis=1), samples - np.argmax(outside[:, ::-1], axis=1), 0)
    settled = rollouts.stayed & (first <= samples - max(int(np.ceil(DWELL * samples)), 1))
    after = np.maximum(first - last_step(rollouts.reference), 0)
    return tuple(
        float(k * rollouts.step_s) if rests else None
        for k, rests in zip(after, settled, strict=True)
    )


def motions(rollouts: Rollouts, band: float) -> tuple[str, ...]:
    """What each case does: `settled`, `lost`, `slow`, `oscillating` or `drifting`.

    Lost: it left the bound. Slow: the error still shrinks from the third quarter of the horizon to
    the last.
    Oscillating: over these two, the swing about a straight line exceeds what the line itself rises.
    Drifting: the rest,
    an error that stays where it is among them.
    """
    settled = [time_s is not None for time_s in settling_times_s(rollouts, band)]
    error = rollouts.y - rollouts.reference
    size, worst = np.linalg.norm(error, axis=2), np.argmax(np.abs(error).max(axis=1), axis=1)
    quarter = max(size.shape[1] // 4, 1)
    third, last = size[:, -2 * quarter : -quarter].max(axis=1), size[:, -quarter:].max(axis=1)
    tail = np.take_along_axis(error, worst[:, None, None], axis=2)[:, -2 * quarter :, 0]
    time = np.linspace(-0.5, 0.5, 2 * quarter)
    rise = tail @ time / (time @ time)  # least-squares slope over the second half
    swing = np.ptp(tail - tail.mean(axis=1, keepdims=True) - rise[:, None] * time, axis=1)
    moving = np.where(swing > np.maximum(np.abs(rise), band), "oscillating", "drifting")
    kinds = np.where(rollouts.stayed, np.where(last < STEADY * third, "slow", moving), "lost")
    return tuple(str(kind) for kind in np.where(settled, "settled", kinds))


def overshoots(rollouts: Rollouts, band: float) -> Float[np.ndarray, "N"]:
    """`max(0, excursion beyond the reference, on the far side from the start) / |y - reference| at
    the start`.

    The start is the last step of the reference; the worst channel counts. Only excursions beyond
    the band count: within
    it, the measurement noise that the controller passes on decides. Zero for cases that start
    within the band.
    """
    error = (rollouts.y - rollouts.reference)[:, last_step(rollouts.reference) :]
    start = error[:, :1]
    far = np.maximum(-np.sign(start) * error, 0.0).max(axis=1)
    counts = (np.abs(start[:, 0]) > band) & (far > band)
    return np.where(counts, far / np.where(counts, np.abs(start[:, 0]), 1.0), 0.0).max(axis=1)


def empirical_rate(rollouts: Rollouts, band: float) -> float | None:
    """`1 - r^2`, r the mean shrink per sample of `|y_i - y_j|` from the start until it is within
    the band.

    The median over all pairs of cases that start more than twice the band apart; in the convention
    of `rate_controller`
    (distances shrink by `sqrt(1 - rate)`), so the two compare. Pairs that never come within the
    band are taken to the
    end of the horizon. None without such pairs.
    """
    i, j = np.triu_indices(len(rollouts.y), k=1)  # each pair of cases once
    distance = np.linalg.norm(rollouts.y[i] - rollouts.y[j], axis=2)
    distance = np.maximum(
        distance[distance[:, 0] > 2 * band], band / 2
    )  # resolution: an exact zero is not a rate
    return float(1.0 - np.median(squared_shrink(distance, band))) if len(distance) else None


def squared_shrink(
    distance: Float[np.ndarray, "N T"], until: float | Float[np.ndarray, "N 1"]
) -> Shrinks:
    """`r^2`, r the mean factor per sample by which each row shrinks until it is at most `until`,
    else to its end."""
    within = distance <= until
    at = np.where(within.any(axis=1), np.argmax(within, axis=1), distance.shape[1] - 1)
    return np.asarray(
        (distance[np.arange(len(distance)), at] / distance[:, 0]) ** (2.0 / np.maximum(at, 1))
    )


def replay_error(controller: Controller, run: Rollouts, limits: Limits = UNLIMITED) -> float:
    """Largest `|u - u_again| / max |u|` over cases that stayed: `u_again` from the recorded
    measurements alone.

    `u_again` is cut at the limits that the controller knew of; an integrator replays its own hold
    at a limit.
    The memory advances by the recorded input, so that errors do not add up.
    """
    stayed, targets = run.stayed, controller.targets(run.reference)
    memory, worst = controller.start(int(stayed.sum())), 0.0
    for k in range(run.u.shape[1]):
        applied, measured = run.u[stayed, k], run.measured[stayed, k]
        again = np.clip(controller.input(memory, measured, targets[k]), *limits)
        worst = float(np.abs(again - applied).max(initial=worst))
        memory = controller.advance(memory, applied, measured, targets[k])
    return worst / max(float(np.abs(run.u).max()), np.finfo(float).tiny)
