"""The loop itself: sampled outputs, held inputs, a thousand cases in one array."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from ssm_study.loop.controller import Controller
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require

LARGEST_SIGNAL = 1e6
"""An input or a controller's memory beyond this counts as having left the bound: the plant may saturate while the
estimate grows without end."""
STAYED = -1
"""`left_at_sample` of a case that never left the bound."""


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """N cases of T samples each; `u[:, k]` is held over sample k, `y[:, k]` is read before it acts. Physical units.

    `y` is the true output, `measured` what the controller saw, `estimate` its state estimate (the model's scaled
    state, width 0 if it has none). A case that leaves `|y - y_eq| <= bound` is stopped there: `left_at_sample` says
    when (`STAYED` if never), and from then on its signals repeat the last values inside the bound.
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
    def left_at_s(self) -> tuple[float | None, ...]:
        """The time each case left the bound, in seconds; None for those that stayed."""
        return tuple(None if k == STAYED else float(k * self.step_s) for k in self.left_at_sample)

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        return np.arange(self.y.shape[1]) * self.step_s


def matched(plant: Plant, controller: Controller) -> None:
    """Raise `BadRequest` unless plant and controller agree in inputs, outputs and sampling time."""
    plant_dimensions = (len(plant.inputs), len(plant.outputs))
    require(
        controller.dimensions == plant_dimensions,
        "controller inputs, outputs",
        controller.dimensions,
        f"the plant has {plant_dimensions}",
        "identify the model on this plant's records",
    )
    require(
        bool(np.isclose(controller.step_s, plant.step_s, rtol=1e-9)),
        "controller.step_s",
        controller.step_s,
        f"the plant is sampled every {plant.step_s} s",
        "identify the model at the plant's sampling time",
    )


def close_loop(
    plant: Plant,
    controller: Controller,
    *,
    x0: Float[np.ndarray, "N x"],
    reference: Float[np.ndarray, "T p"],
    noise: Float[np.ndarray, "N T p"],
    disturbance: Float[np.ndarray, "N T q"],
    bound: Float[np.ndarray, "p"],
    input_lower: Float[np.ndarray, "m"] | None = None,
    input_upper: Float[np.ndarray, "m"] | None = None,
) -> Rollouts:
    """`u[k] = controller(y[k] + noise[k])`, `x[k+1] = plant.advance(x[k], u[k], d[k])`, all cases at once.

    `bound (p,)` is the largest `|y - y_eq|` a case may reach before it is stopped, in the output's unit; input limits
    (input's unit) are known to the controller. Raises `BadRequest` for unmatched plant and controller.
    """
    matched(plant, controller)
    (cases, samples, outputs), inputs = noise.shape, len(plant.inputs)
    targets, rest = controller.targets(reference), plant.equilibrium().y
    _reachable(controller.demanded(targets), input_lower, input_upper)
    log = {
        "u": np.zeros((cases, samples, inputs)),
        "y": np.zeros((cases, samples, outputs)),
        "measured": np.zeros((cases, samples, outputs)),
        "states": np.zeros((cases, samples, x0.shape[1])),
        "estimate": np.zeros((cases, samples, controller.estimate(controller.start(1)).shape[1])),
    }
    x, memory, left = x0, controller.start(cases), np.full(cases, STAYED)
    going = np.arange(cases)
    for k in range(samples):
        y = plant.output(x)
        seen = y + noise[going, k]
        u = _limited(controller.input(memory, seen, targets[k]), input_lower, input_upper)
        inside = (np.abs(y - rest) <= bound).all(axis=1) & _sane(u) & _sane(memory)
        if not inside.all():
            left[going[~inside]] = k
            x, y, seen, u, memory, going = x[inside], y[inside], seen[inside], u[inside], memory[inside], going[inside]
            if not len(going):
                break
        values = {"u": u, "y": y, "measured": seen, "states": x, "estimate": controller.estimate(memory)}
        for name, value in values.items():
            log[name][going, k] = value
        memory = controller.advance(memory, u, seen, targets[k])
        x = plant.advance(x, u, disturbance[going, k])
    _hold_last(log, left)
    return Rollouts(step_s=plant.step_s, reference=reference, bound=bound, left_at_sample=left, **log)


def _reachable(
    demanded: Float[np.ndarray, "K m"],
    lower: Float[np.ndarray, "m"] | None,
    upper: Float[np.ndarray, "m"] | None,
) -> None:
    excess = float(np.abs(demanded - _limited(demanded, lower, upper)).max(initial=0.0))
    require(
        excess == 0.0,
        "loop.reference",
        f"needs inputs in [{demanded.min(initial=0.0):.4g}, {demanded.max(initial=0.0):.4g}]",
        f"beyond the limits loop.input_lower, loop.input_upper by {excess:.4g}",
        "choose a smaller or slower reference",
    )


def _sane(values: Float[np.ndarray, "N k"]) -> Bool[np.ndarray, "N"]:
    return (np.abs(values) < LARGEST_SIGNAL).all(axis=1)


def _limited(
    u: Float[np.ndarray, "N m"], lower: Float[np.ndarray, "m"] | None, upper: Float[np.ndarray, "m"] | None
) -> Float[np.ndarray, "N m"]:
    return u if lower is None and upper is None else np.clip(u, lower, upper)


def _hold_last(log: dict[str, np.ndarray], left: Int[np.ndarray, "N"]) -> None:
    """Stopped cases repeat their last sample inside the bound (zeros if there was none)."""
    for case in np.flatnonzero(left > 0):
        for values in log.values():
            values[case, left[case] :] = values[case, left[case] - 1]
