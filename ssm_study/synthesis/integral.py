"""Integral action: the model with an integrator of the tracking error, under the same theorems.

    x+ = A x + B S_u(u),   z+ = z + (y - y*) / s_y = z + G (C x + D S_u(u)) - y* / s_y,   u = u* + K_x (xh - x*) + K_z z

For a linear output map `S_y(v) = G v` the pair `(x, z)` is again a linear recurrence behind `S_u`, so Theorem 1, its
exact frontier (the integrators are modes at 1) and its exact verification hold as they stand; `z` is known exactly, so
the observer is unchanged. The internal model principle then removes constant errors: a constant disturbance leaves the
loop contracting, so `z` converges, and it does so only where `y = y*`, the planned output. Announced as future work in
[Z26] section V.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis.certificate import Design
from ssm_study.synthesis.design import Synthesis
from ssm_study.systems import JacobianBall, StateSpace


def with_integrators(model: SSM, weight: float = 1.0) -> StateSpace:
    """`a = [[A, 0], [G C, I]],  b = [B; G D]`; `c` reads the scaled output and `sqrt(weight) z`, for a cost on both.

    Raises `BadRequest` for a nonlinear output map, or for more outputs than inputs, which could not steer them all.
    """
    linear, gain = model.linear, output_gain(model)
    (n, m), p = linear.b.shape, len(gain)
    require(
        p <= m,
        "synthesis.integral",
        f"{p} outputs, {m} inputs",
        "an input is needed for every integrated output",
        "use a synthesis without integral action",
    )
    return StateSpace(
        a=np.block([[linear.a, np.zeros((n, p))], [gain @ linear.c, np.eye(p)]]),
        b=np.vstack([linear.b, gain @ linear.d]),
        c=np.block([[gain @ linear.c, np.zeros((p, p))], [np.zeros((p, n)), np.sqrt(weight) * np.eye(p)]]),
        d=np.vstack([gain @ linear.d, np.zeros((p, m))]),
    )


def output_gain(model: SSM) -> Float[np.ndarray, "p k"]:
    """`G` of `S_y(v) = G v`. Raises `BadRequest` for any other output map."""
    require(
        isinstance(model.scaffold_out, LinearScaffold),
        "synthesis.integral",
        model.scaffold_out.kind,
        "integral action needs a linear output map, so that the integrator is part of the recurrence",
        "use scaffold@model.scaffold_out=linear",
    )
    return model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))


def controlled_system(model: SSM, k: Float[np.ndarray, "m s"]) -> StateSpace:
    """What a state feedback of this width is certified for: the model's recurrence, or the one with integrators."""
    return model.linear if k.shape[1] == model.order else with_integrators(model)


@dataclass(frozen=True, kw_only=True)
class IntegralSynthesis:
    """Any synthesis, with integral action: its controller for the augmented model, its observer for the model.

    `integral_weight` is the cost of `|z|^2` beside `output_weight |y|^2`, both scaled; larger removes errors sooner.
    """

    synthesis: Synthesis
    integral_weight: float = 1e-3

    method: ClassVar[str] = "integral"

    def __post_init__(self) -> None:
        weight = self.integral_weight
        require(0 < weight < np.inf, "synthesis.integral_weight", weight, "must be positive", "try 1e-3")

    def design(
        self,
        model: SSM,
        input_ball: JacobianBall,
        output_ball: JacobianBall,
        validation: tuple[Trajectory, ...] = (),  # noqa: ARG002 - the same signature for every synthesis
        start_up_samples: int = 0,  # noqa: ARG002
    ) -> Design:
        return Design(
            state_feedback=self.synthesis.state_feedback(with_integrators(model, self.integral_weight), input_ball),
            observer=self.synthesis.observer(model.linear, output_ball),
        )


Synthesis.register(IntegralSynthesis)
