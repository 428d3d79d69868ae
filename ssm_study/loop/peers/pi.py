"""PI controller that is tuned by a textbook rule from the identified model."""

# ruff: noqa: ARG002 - every law gets all arguments; some need less
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.loop.controller import Controller, Inputs, Measured, Memory, Outputs, Target
from ssm_study.loop.peers.peer import ComparisonMethod, IdentificationResult
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class PI(Controller):
    """PI controller for a plant with one input and one output.

    `u = u_eq + gain (e + i),  i+ = i + (step_s / integral_s) e,  e = r - y`. `gain` in input per
    output unit, `integral_s` in seconds; i is held while a limit keeps the
    input from what was asked (no wind-up).
    """

    gain: float
    integral_s: float
    input_equilibrium: float
    step_s: float
    dimensions: tuple[int, int] = (1, 1)

    @classmethod
    def for_plant(cls, plant: Plant, gain: float, integral_s: float) -> "PI":
        """PI controller around the equilibrium of a plant, at the plant's sampling time.

        Raises `BadRequest` for more than one input or output.
        """
        input_count = len(plant.inputs)
        output_count = len(plant.outputs)
        shape = (input_count, output_count)
        problem = "are the plant's numbers of inputs and outputs, of which a PI needs one each"
        single_channels = (1, 1)
        require(shape == single_channels, "loop.comparison.own_pi", shape, problem, "leave it out")
        equilibrium = plant.equilibrium()
        u_eq = float(equilibrium.u[0])
        return cls(gain=gain, integral_s=integral_s, input_equilibrium=u_eq, step_s=plant.step_s)

    def initial_memory(self, cases: int) -> Memory:
        """Zero integral states of the PI controller before the first sample."""
        return np.zeros((cases, 1))

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """Input of the PI controller: proportional part plus integral state."""
        shifted_error = target - y + memory
        return self.input_equilibrium + self.gain * shifted_error

    def next_memory(
        self, memory: Memory, u: Inputs, y: Outputs, target: Target, d: Measured = None
    ) -> Memory:
        """Next integral state of the PI controller; it stays constant while an input limit is
        active."""
        unlimited_input = self.input(memory, y, target)
        is_unlimited = np.isclose(u, unlimited_input, rtol=1e-9, atol=1e-12)
        share_of_integral = self.step_s / self.integral_s
        increment = share_of_integral * (target - y)
        allowed_increment = np.where(is_unlimited, increment, 0.0)
        return memory + allowed_increment


def _critical_gain(instability_margin: Callable[[float], float], static_gain_sign: float) -> float:
    """Smallest proportional gain, up to 10^6, at which a loop reaches the limit of stability.

    Raises `BadRequest` if there is none; `static_gain_sign` is the sign of the static gain, for the
    message.
    """
    grid = np.geomspace(1e-3, 1e6, 2000)
    unstable_numbers = (i for i, gain in enumerate(grid) if instability_margin(gain) >= 0)
    first_unstable = next(unstable_numbers, 0)
    problem = "no gain makes the loop oscillate, so the tuning rule does not apply"
    require(first_unstable > 0, "model", static_gain_sign, problem, "leave the PI peer out")
    below = grid[first_unstable - 1]
    above = grid[first_unstable]
    critical_gain = scipy.optimize.bisect(instability_margin, below, above, xtol=1e-12)
    return float(critical_gain)


class UltimateGain(NamedTuple):
    """Proportional gain at which a loop just oscillates (ultimate gain), with the period of the
    oscillation.

    Physical units, seconds.
    """

    gain: float
    period_s: float


def ultimate_gain(model: SSM) -> UltimateGain:
    """Ultimate gain of a model with one input and one output (the proportional gain at which the
    loop just oscillates), with the period.

    `u = -gain y` puts the first pole of the model (S_u by its mean slope) on the unit circle, at
    `2 pi / period`. Raises `BadRequest` for more than one input or output, or a loop that no gain
    up to 10^6 makes oscillate.
    """
    scale = model.scale
    shape = (scale.inputs, scale.outputs)
    problem = "the PI's tuning rule needs one input and one output"
    remedy = "compare other controllers"
    single_channels = (1, 1)
    require(shape == single_channels, "model inputs, outputs", shape, problem, remedy)
    outward = model.scaffold_out
    a = model.linear.a
    b = model.linear.b @ mean_input_slope(model)
    linear_c = model.linear.c
    zero_output = np.zeros(outward.inputs)
    c = outward.jacobian(zero_output) @ linear_c
    state_gain = np.linalg.solve(np.eye(model.order) - a, b)
    static_gain = c @ state_gain
    scalar_gain = static_gain[0, 0]
    sign = float(np.sign(scalar_gain))

    def closed_loop_poles(gain: float) -> Complex[np.ndarray, "n"]:
        """Poles of the closed loop with a given proportional gain."""
        closed_loop_matrix = a - sign * gain * b @ c
        eigenvalues = np.linalg.eigvals(closed_loop_matrix)
        return eigenvalues.astype(complex)

    def instability_margin(gain: float) -> float:
        """Spectral radius of the closed loop with a given proportional gain, minus one."""
        moduli = np.abs(closed_loop_poles(gain))
        return float(moduli.max() - 1)

    limit = _critical_gain(instability_margin, sign)
    poles_at_limit = closed_loop_poles(limit)
    slowest = poles_at_limit[np.argmax(np.abs(poles_at_limit))]
    signed_angle = np.angle(slowest)
    angle = float(np.abs(signed_angle))
    unit_ratio = scale.input_scale[0] / scale.output_scale[0]
    unit = float(unit_ratio)
    positive_angle = max(angle, 1e-6)
    period_samples = 2 * np.pi / positive_angle
    ultimate_gain_gain = sign * limit * unit
    period_s = period_samples * model.step_s
    return UltimateGain(gain=ultimate_gain_gain, period_s=period_s)


def tyreus_luyben_pi(model: SSM) -> PI:
    """PI controller tuned by the rule of Tyreus and Luyben, a more cautious form of Ziegler and
    Nichols' rule.

    `gain = ultimate / 3.2,  integral = 2.2 periods`. Source: Tyreus & Luyben, Ind. Eng. Chem. Res.
    31 (1992) 2625-2628. (Rules from a first-order
    fit, SIMC among them, do not see an elastic shaft: on the motor they excite its resonance.)
    """
    limit = ultimate_gain(model)
    gain = limit.gain / 3.2
    integral_s = 2.2 * limit.period_s
    input_equilibria = model.scale.input_equilibrium
    input_equilibrium = float(input_equilibria[0])
    return PI(
        gain=gain, integral_s=integral_s, input_equilibrium=input_equilibrium, step_s=model.step_s
    )


def mean_input_slope(model: SSM) -> Float[np.ndarray, "k m"]:
    """Mean slope of a model's static input map, which replaces the map in a linear design.

    `(S_u(e_i) - S_u(-e_i)) / 2` for each scaled input i.
    """
    ends = np.eye(model.scale.inputs)
    upper_values = model.scaffold_in(ends)
    lower_values = model.scaffold_in(-ends)
    differences = upper_values - lower_values
    return (differences / 2).T


class PiMethod(ComparisonMethod, names=("pi",)):
    """Comparison method with a PI controller that is tuned by Tyreus and Luyben's rule."""

    def build_controller(self, plant: Plant, identified: IdentificationResult, rate: float) -> PI:
        """Build the PI controller of an identified model, tuned by the rule of Tyreus and
        Luyben."""
        return tyreus_luyben_pi(identified.linear_model)
