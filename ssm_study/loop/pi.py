"""A PI controller tuned by a textbook rule from the identified model: what most plants of this kind run on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.loop.controller import Controller
from ssm_study.models.identified import SSM
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class PI(Controller):
    """`u = u_eq + gain (e + i),  i+ = i + (step_s / integral_s) e,  e = r - y`, one input, one output.

    `gain` in input per output unit, `integral_s` in seconds; i is held while a limit keeps the input from what was
    asked (no wind-up).
    """

    gain: float
    integral_s: float
    input_equilibrium: float
    sampled_every_s: float

    @property
    def step_s(self) -> float:
        return self.sampled_every_s

    @property
    def dimensions(self) -> tuple[int, int]:
        return 1, 1

    def start(self, cases: int) -> Float[np.ndarray, "N 1"]:
        return np.zeros((cases, 1))

    def input(
        self, memory: Float[np.ndarray, "N 1"], y: Float[np.ndarray, "N 1"], target: Float[np.ndarray, "1"]
    ) -> Float[np.ndarray, "N 1"]:
        return self.input_equilibrium + self.gain * (target - y + memory)

    def advance(
        self,
        memory: Float[np.ndarray, "N 1"],
        u: Float[np.ndarray, "N 1"],
        y: Float[np.ndarray, "N 1"],
        target: Float[np.ndarray, "1"],
    ) -> Float[np.ndarray, "N 1"]:
        free = np.isclose(u, self.input(memory, y, target), rtol=1e-9, atol=1e-12)
        return memory + np.where(free, self.step_s / self.integral_s * (target - y), 0.0)


@dataclass(frozen=True, kw_only=True)
class Ultimate:
    """The proportional gain at which the linearised loop just oscillates, and the period: physical units, seconds."""

    gain: float
    period_s: float


def ultimate(model: SSM) -> Ultimate:
    """`u = -gain y` puts the first pole of the model (S_u by its mean slope) on the unit circle, at `2 pi / period`.

    Raises `BadRequest` for more than one input or output, or a loop that no gain up to 10^6 makes oscillate.
    """
    shape = (len(model.input_scale), len(model.output_scale))
    require(shape == (1, 1), "model inputs, outputs", shape, "this rule tunes one loop", "compare other controllers")
    b, c = model.linear.b @ mean_slope(model), output_slope(model) @ model.linear.c
    sign = float(np.sign((c @ np.linalg.solve(np.eye(model.order) - model.linear.a, b))[0, 0]))

    def poles(gain: float) -> Complex[np.ndarray, "n"]:
        return np.linalg.eigvals(model.linear.a - sign * gain * b @ c).astype(complex)

    grid = np.geomspace(1e-3, 1e6, 2000)
    unstable = next((i for i, gain in enumerate(grid) if np.abs(poles(gain)).max() >= 1), None)
    require(unstable not in (None, 0), "model", sign, "no gain brings the loop to oscillate", "leave the PI peer out")
    low, high = grid[unstable - 1], grid[unstable]  # type: ignore[operator]  # None has just been refused
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if np.abs(poles(middle)).max() < 1 else (low, middle)
    found = poles(low)
    angle = float(np.abs(np.angle(found[np.argmax(np.abs(found))])))
    period_s = 2 * np.pi / max(angle, 1e-6) * model.step_s
    return Ultimate(gain=sign * low * float(model.input_scale[0] / model.output_scale[0]), period_s=period_s)


def tyreus_luyben(model: SSM) -> PI:
    """`gain = ultimate / 3.2,  integral = 2.2 periods`: Ziegler and Nichols' experiment with a calmer rule.

    Source: Tyreus & Luyben, Ind. Eng. Chem. Res. 31 (1992) 2625-2628. (Rules from a first-order fit, SIMC among them,
    do not see an elastic shaft: on the motor they excite its resonance.)
    """
    limit = ultimate(model)
    return PI(
        gain=limit.gain / 3.2,
        integral_s=2.2 * limit.period_s,
        input_equilibrium=float(model.input_equilibrium[0]),
        sampled_every_s=model.step_s,
    )


def mean_slope(model: SSM) -> Float[np.ndarray, "k m"]:
    """`(S_u(e_i) - S_u(-e_i)) / 2` for each scaled input i: what a linear design takes the nonlinearity for."""
    ends = np.eye(len(model.input_scale))
    return ((model.scaffold_in(ends) - model.scaffold_in(-ends)) / 2).T


def output_slope(model: SSM) -> Float[np.ndarray, "p k"]:
    """The Jacobian of S_y at rest."""
    return model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))
