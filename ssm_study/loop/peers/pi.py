"""A PI controller tuned by a textbook rule from the identified model: what most plants of this kind
run on."""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.loop.controller import Controller, Inputs, Memory, Outputs, Target
from ssm_study.loop.peers.peer import Identified, Peer
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class PI(Controller):
    """`u = u_eq + gain (e + i),  i+ = i + (step_s / integral_s) e,  e = r - y`, one input, one
    output.

    `gain` in input per output unit, `integral_s` in seconds; i is held while a limit keeps the
    input from what was asked (no wind-up).
    """

    gain: float
    integral_s: float
    input_equilibrium: float
    step_s: float
    dimensions: tuple[int, int] = (1, 1)

    @classmethod
    def on(cls, plant: Plant, gain: float, integral_s: float) -> "PI":
        """For this plant and its sampling time; raises `BadRequest` for more than one input or
        output."""
        shape = len(plant.inputs), len(plant.outputs)
        require(
            shape == (1, 1),
            "loop.comparison.own_pi",
            shape,
            "inputs and outputs of the plant",
            "leave it out",
        )
        rest = float(plant.equilibrium().u[0])
        return cls(gain=gain, integral_s=integral_s, input_equilibrium=rest, step_s=plant.step_s)

    def start(self, cases: int) -> Memory:
        return np.zeros((cases, 1))

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        return self.input_equilibrium + self.gain * (target - y + memory)

    def advance(self, memory: Memory, u: Inputs, y: Outputs, target: Target) -> Memory:
        free = np.isclose(u, self.input(memory, y, target), rtol=1e-9, atol=1e-12)
        return memory + np.where(free, self.step_s / self.integral_s * (target - y), 0.0)


class Ultimate(NamedTuple):
    """The proportional gain at which the linearised loop just oscillates, and the period: physical
    units, seconds."""

    gain: float
    period_s: float


def ultimate(model: SSM) -> Ultimate:
    """`u = -gain y` puts the first pole of the model (S_u by its mean slope) on the unit circle, at
    `2 pi / period`.

    Raises `BadRequest` for more than one input or output, or a loop that no gain up to 10^6 makes
    oscillate.
    """
    shape = (model.scale.inputs, model.scale.outputs)
    outward = model.scaffold_out
    require(
        shape == (1, 1),
        "model inputs, outputs",
        shape,
        "this rule tunes one loop",
        "compare other controllers",
    )
    b = model.linear.b @ mean_slope(model)
    c = outward.jacobian(np.zeros(outward.inputs)) @ model.linear.c
    sign = float(np.sign((c @ np.linalg.solve(np.eye(model.order) - model.linear.a, b))[0, 0]))

    def poles(gain: float) -> Complex[np.ndarray, "n"]:
        return np.linalg.eigvals(model.linear.a - sign * gain * b @ c).astype(complex)

    def excess(gain: float) -> float:
        return float(np.abs(poles(gain)).max() - 1)

    grid = np.geomspace(1e-3, 1e6, 2000)  # the first crossing, then bisection
    unstable = next((i for i, gain in enumerate(grid) if excess(gain) >= 0), 0)
    require(
        unstable > 0, "model", sign, "no gain brings the loop to oscillate", "leave the PI peer out"
    )
    limit = float(scipy.optimize.bisect(excess, grid[unstable - 1], grid[unstable], xtol=1e-12))
    found = poles(limit)
    angle = float(np.abs(np.angle(found[np.argmax(np.abs(found))])))
    physical = sign * limit * float(model.scale.input_scale[0] / model.scale.output_scale[0])
    return Ultimate(gain=physical, period_s=2 * np.pi / max(angle, 1e-6) * model.step_s)


def tyreus_luyben(model: SSM) -> PI:
    """`gain = ultimate / 3.2,  integral = 2.2 periods`: Ziegler and Nichols' experiment with a
    calmer rule.

    Source: Tyreus & Luyben, Ind. Eng. Chem. Res. 31 (1992) 2625-2628. (Rules from a first-order
    fit, SIMC among them, do not see an elastic shaft: on the motor they excite its resonance.)
    """
    (gain, period_s), rest = ultimate(model), float(model.scale.input_equilibrium[0])
    return PI(
        gain=gain / 3.2, integral_s=2.2 * period_s, input_equilibrium=rest, step_s=model.step_s
    )


def mean_slope(model: SSM) -> Float[np.ndarray, "k m"]:
    """`(S_u(e_i) - S_u(-e_i)) / 2` for each scaled input i: what a linear design takes the
    nonlinearity for."""
    ends = np.eye(model.scale.inputs)
    return ((model.scaffold_in(ends) - model.scaffold_in(-ends)) / 2).T


class PiPeer(Peer, names=("pi",)):
    """Tyreus and Luyben's rule on the linearised model."""

    def build(self, plant: Plant, known: Identified, rate: float) -> PI:
        return tyreus_luyben(known.without_neurons)
