"""Integral action: the model with an integrator of the tracking error, under the same theorems.

Problem. Remove constant errors: `y = y*` at rest, whatever constant disturbance acts, with a certified rate.

Hypotheses. Those of `state_feedback`; a linear output map `S_y(v) = G v`, and an input for every integrated output.

Statement. With `z+ = z + (y - y*) / s_y = z + G (C x + D S_u(u)) - y* / s_y` and `u = u* + K_x (xh - x*) + K_z z`,

    (x, z)+ = [A 0; G C I] (x, z) + [B; G D] S_u(u)

is again a linear recurrence behind `S_u`, so the inequality of `state_feedback` with this `(A, B)`, `[(1 - rate) P -
sigma B B^T, ...] > 0`, its frontier (the integrators are modes at 1) and its verdict hold as they stand; z is known
exactly, so the observer is unchanged. The loop contracts, so z converges, which it does only where `y = y*`.

When not to use it. With a nonlinear output map, fewer inputs than outputs, or inputs that saturate for long.

Reference. [Z26] Theorem 1, eq. (11), for the augmented pair, announced as future work in its section V; the internal
model principle: Francis & Wonham 1976.

Example. A gain `y = 0.5 x` of `x+ = 0.9 x + S_u(u)`: the integrator is a second state, driven by `0.5 x`.

>>> import numpy as np
>>> from ssm_study.systems import StateSpace
>>> model = StateSpace(a=np.array([[0.9]]), b=np.ones((1, 1)), c=np.array([[0.5]]), d=np.zeros((1, 1)))
>>> print(augmented(model, gain=np.eye(1), weight=1.0).a.tolist())
[[0.9, 0.0], [0.5, 1.0]]
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model
from ssm_study.refusal import positive, require
from ssm_study.signals import Trajectories
from ssm_study.synthesis.certificate import Design
from ssm_study.synthesis.commanded import designed
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.mismatch import Mismatch
from ssm_study.systems import Balls, StateSpace, StructuredSystem, System


def with_integrators(model: Model, weight: float = 1.0) -> System:
    """`a = [[A, 0], [G C, I]],  b = [B; G D]`; `c` reads the scaled output and `sqrt(weight) z`, for a cost on both.

    Raises `BadRequest` for a nonlinear output map, or for more outputs than inputs, which could not steer them all.
    """
    gain, inputs = output_gain(model), model.linear.b.shape[1]
    problem, remedy = "an input is needed for every integrated output", "use a synthesis without integral action"
    require(len(gain) <= inputs, "synthesis.integral", f"{len(gain)} outputs, {inputs} inputs", problem, remedy)
    return augmented(model.system, gain, weight)


def augmented(system: System, gain: Float[np.ndarray, "p k"], weight: float) -> System:
    """The recurrence of `(x, z)`; its output is what a cost weighs. Neurons drive both and see x alone."""
    (n, m), p = system.b.shape, len(gain)
    linear = {
        "a": np.block([[system.a, np.zeros((n, p))], [gain @ system.c, np.eye(p)]]),
        "b": np.vstack([system.b, gain @ system.d]),
        "c": np.block([[gain @ system.c, np.zeros((p, p))], [np.zeros((p, n)), np.sqrt(weight) * np.eye(p)]]),
        "d": np.vstack([gain @ system.d, np.zeros((p, m))]),
    }
    if isinstance(system, StateSpace):
        return StateSpace(**linear)
    return StructuredSystem(
        **linear,
        e=np.vstack([system.e, gain @ system.h]),
        f=np.hstack([system.f, np.zeros((system.neurons, p))]),
        g=system.g,
        h=np.vstack([gain @ system.h, np.zeros((p, system.neurons))]),
    )


def output_gain(model: Model) -> Float[np.ndarray, "p k"]:
    """`G` of `S_y(v) = G v`. Raises `BadRequest` for any other output map."""
    found = model.scaffold_out.portable()
    problem = "integral action needs a linear output map, so that the integrator is part of the recurrence"
    remedy = "use scaffold@model.scaffold_out=linear"
    require(found.network is None, "synthesis.integral", model.scaffold_out.kind, problem, remedy)
    return found.linear


def controlled_system(model: Model, k: Float[np.ndarray, "m s"]) -> System:
    """What a state feedback of this width is certified for: the model's recurrence, or the one with integrators."""
    return model.system if k.shape[1] == model.order else with_integrators(model)


@dataclass(frozen=True, kw_only=True)
class IntegralSynthesis:
    """Any synthesis, with integral action: its controller for the augmented model, its observer for the model.

    `integral_weight` is the cost of `|z|^2` beside `output_weight |y|^2`, both scaled; larger removes errors sooner.
    """

    synthesis: Synthesis
    integral_weight: float = 1e-3

    method: ClassVar[str] = "integral"

    def __post_init__(self) -> None:
        positive("synthesis.integral_weight", self.integral_weight, "try 1e-3")

    def design(
        self,
        model: Model,
        balls: Balls,
        validation: Trajectories = (),
        shown: Mismatch | None = None,
    ) -> Design:
        if self.invert_input:
            plain = replace(self, synthesis=replace(self.synthesis, invert_input=False))
            return designed(plain, model, validation, shown)
        feedback = self.synthesis.state_feedback(with_integrators(model, self.integral_weight), balls.input)
        return Design(state_feedback=feedback, observer=self.synthesis.observer(model.system, balls.output))

    @property
    def invert_input(self) -> bool:
        return self.synthesis.invert_input


Synthesis.register(IntegralSynthesis)
