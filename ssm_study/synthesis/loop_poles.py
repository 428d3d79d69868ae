"""Eigenvalues of a loop at the equilibrium, and whether its controller moves them.

Source: docs/theory.md, the linearised loop.
"""

import numpy as np
from jaxtyping import Complex

from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.systems import Gains

LEAST_EFFECT = 1e-3  # distance of a pole, in the unit circle
Poles = Complex[np.ndarray, "_"]


def moves_poles(uncontrolled: Poles, controlled: Poles) -> bool:
    """Whether a controller moves the poles of a model by more than a small threshold."""
    if len(uncontrolled) != len(controlled):  # an internal model
        return True
    before = np.sort_complex(uncontrolled)
    after = np.sort_complex(controlled)
    return bool(np.abs(before - after).max(initial=0.0) > LEAST_EFFECT)


def eigenvalue_groups(model: Model, gains: Gains) -> dict[str, Poles]:
    """Eigenvalues of the model, the controlled model and the estimation error at the equilibrium.
    `A + B J_u K`, `A + L J_y C`."""
    linear = linearise_at_equilibrium(model)
    n = len(linear.a)
    inputs = model.scaffold_in.inputs
    slope_in = model.scaffold_in.jacobian(np.zeros(inputs))
    slope_out = model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))
    controlled = linear.a + linear.b @ slope_in @ gains.k[:, :n]
    observed = linear.a + gains.l[:n] @ slope_out @ linear.c
    eigenvalues = np.linalg.eigvals(linear.a)
    estimate = np.linalg.eigvals(observed).astype(complex)
    return {
        "model": eigenvalues.astype(complex),
        "controlled": np.linalg.eigvals(controlled).astype(complex),
        "estimate": estimate,
    }
