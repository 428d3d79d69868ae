"""Poles of a loop at the equilibrium, and whether the controller moves them.

Source: docs/theory.md, the linearised loop.
"""

import numpy as np
from jaxtyping import Complex

from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.systems import Gains

LEAST_EFFECT = 1e-3  # distance of a pole, in the unit circle
Poles = Complex[np.ndarray, "_"]


def moves_poles(open_loop_poles: Poles, closed_loop_poles: Poles) -> bool:
    """Whether a controller moves the poles of a model by more than a small threshold."""
    if len(open_loop_poles) != len(closed_loop_poles):  # an internal model
        return True
    before = np.sort_complex(open_loop_poles)
    after = np.sort_complex(closed_loop_poles)
    movements = np.abs(before - after)
    return bool(movements.max(initial=0.0) > LEAST_EFFECT)


def eigenvalue_groups(model: Model, gains: Gains) -> dict[str, Poles]:
    """Eigenvalues of the model, of the controlled model and of the estimation error at the
    equilibrium, by name. `A + B J_u K`, `A + L J_y C`."""
    linear = linearise_at_equilibrium(model)
    n = len(linear.a)
    inputs = model.scaffold_in.inputs
    zero_input = np.zeros(inputs)
    slope_in = model.scaffold_in.jacobian(zero_input)
    zero_output = np.zeros(model.scaffold_out.inputs)
    slope_out = model.scaffold_out.jacobian(zero_output)
    input_matrix = linear.b @ slope_in
    through_gain = input_matrix @ gains.k[:, :n]
    controlled = linear.a + through_gain
    through_observer = gains.l[:n] @ slope_out @ linear.c
    observed = linear.a + through_observer
    eigenvalues = np.linalg.eigvals(linear.a)
    estimate_poles = np.linalg.eigvals(observed)
    estimate = estimate_poles.astype(complex)
    complex_eigenvalues = eigenvalues.astype(complex)
    controlled_poles = np.linalg.eigvals(controlled)
    return {
        "model": complex_eigenvalues,
        "controlled": controlled_poles.astype(complex),
        "estimate": estimate,
    }
