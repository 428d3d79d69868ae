"""Smallest ball that contains all Jacobians of a network, centre included, by semidefinite
programming (LipSDP).

Neurons of slopes `lo <= hi`, a diagonal `T >= 0`: every Jacobian lies in the ball of centre C and
radius L if

    L^2 |v|^2 - |W d - C v|^2 - 2 sum_l (d_l - lo q_l)^T T_l (hi q_l - d_l) >= 0     for all v, d
    (q_l = W_l d_{l-1})

Source: Fazlyab et al. 2019, eq. (10) (C = 0 there; here the inequality is linear in C as well, so C
is optimised).
"""

import warnings
from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.bounds.network import Matrix, Network, Vector
from ssm_study.refusal import BadRequest, require

# The radius is recomputed from the solver's multipliers by a Schur complement in floats; widened by
# this share, far above that computation's rounding.
ROUNDING_SHARE = 1e-7
# Any multipliers prove a bound or none. Where the solver stopped just outside, slightly larger ones
# lie inside.
ENLARGED = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)


def lipsdp_ball(
    network: Network, scalar_centre: bool = False
) -> tuple[Float[np.ndarray, "k m"], float]:
    """Smallest ball of matrices that provably contains every Jacobian of a network, by semidefinite
    programming (LipSDP). Centre and least radius with `|J(v) - centre|_2 <= radius` for every v,
    for any centre or (`scalar_centre`) for a centre `alpha I`. Raises `BadRequest` if the solver
    fails."""
    hidden = [len(b) for b in network.biases]
    multipliers = [cp.Variable(h, nonneg=True) for h in hidden]
    shape = (network.output_count, network.input_count)
    centre = cp.Variable() * np.eye(network.input_count) if scalar_centre else cp.Variable(shape)
    square = cp.Variable(nonneg=True)  # L^2: the inequality is linear in it
    input_selection = _selection_matrix(network, 0)
    output_selection = _selection_matrix(network, len(hidden))
    form = _slope_constraint(network, multipliers) + square * input_selection.T @ input_selection
    deviation = network.weights[-1] @ output_selection - centre @ input_selection  # W d - C v
    # Schur complement of |W d - C v|^2
    identity = np.eye(network.output_count)
    matrix = cp.bmat([[form, deviation.T], [deviation, identity]])
    problem = cp.Problem(cp.Minimize(square), [matrix >> 0])
    _solve_program(problem)
    message = f"the solver reports {problem.status}"
    require(square.value is not None, "bound_method", "lipsdp", message, "use interval")
    best_centre = np.asarray(centre.value, dtype=float).reshape(shape)
    values = [np.asarray(t.value, dtype=float) for t in multipliers]
    radii = []
    for share in ENLARGED:
        enlarged = [(1 + share) * t for t in values]
        radii.append(_proved_radius(network, enlarged, best_centre))
    radius = min(radii)
    message = "the multipliers do not prove a bound"
    require(np.isfinite(radius), "bound_method", "lipsdp", message, "use interval")
    return best_centre, radius


def _solve_program(problem: cp.Problem) -> None:
    """Solve a semidefinite program, and raise `BadRequest` if the solver fails."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver="CLARABEL")
    except (cp.error.SolverError, ArithmeticError) as error:
        message = f"the solver failed ({error})"
        raise BadRequest("bound_method", "lipsdp", message, "use interval") from error


def _proved_radius(network: Network, multipliers: list[Vector], centre: Matrix) -> float:
    """Radius of a ball around a given centre that, by given multipliers, provably contains every
    Jacobian of a network. The radius follows from the Schur complement onto v of all other
    signals."""
    m = network.input_count
    largest = max(float(t.max(initial=0.0)) for t in multipliers)
    # strictly positive, so the block is invertible
    positive = [np.maximum(t, 0) + 1e-9 * largest for t in multipliers]
    input_selection = _selection_matrix(network, 0)
    output_selection = _selection_matrix(network, len(positive))
    deviation = network.weights[-1] @ output_selection - centre @ input_selection
    form = _slope_constraint(network, positive) - deviation.T @ deviation
    neuron_block = form[m:, m:]
    symmetric_block = (neuron_block + neuron_block.T) / 2
    try:
        factor = scipy.linalg.cho_factor(symmetric_block)
    except np.linalg.LinAlgError:  # these multipliers prove nothing
        return np.inf
    solution = scipy.linalg.cho_solve(factor, form[m:, :m])
    schur_complement = form[:m, m:] @ solution - form[:m, :m]
    symmetric_complement = (schur_complement + schur_complement.T) / 2
    squared_radius = max(np.linalg.eigvalsh(symmetric_complement)[-1], 0.0)
    radius = np.sqrt(squared_radius) * (1 + ROUNDING_SHARE)
    return float(radius)


def _selection_matrix(network: Network, layer: int) -> Float[np.ndarray, "h w"]:
    """Matrix that selects one layer's input or output from the vector of all signals of a network.
    The stack is `(v, d_1, ..., d_L)`; layer 0 stands for the input `v`."""
    sizes = [network.input_count, *(len(b) for b in network.biases)]
    start = sum(sizes[:layer])
    end = start + sizes[layer]
    identity = np.eye(sum(sizes))
    return identity[start:end]


def _slope_constraint(network: Network, multipliers: Sequence[Any]) -> Any:
    """Matrix of the quadratic constraint that bounds the slopes of all neurons of a network. `-2
    sum_l (d - lo q)^T T (hi q - d)` as a symmetric matrix; T symbolic or numeric."""
    total: Any = 0
    for layer, t in enumerate(multipliers):
        negative = network.negative_slopes[layer]
        positive = network.positive_slopes[layer]
        low, high = np.sort(np.stack([negative, positive]), axis=0)
        output = _selection_matrix(network, layer + 1)
        pre_activation = network.weights[layer] @ _selection_matrix(network, layer)
        above_least = output - low[:, None] * pre_activation
        below_largest = high[:, None] * pre_activation - output
        diagonal = cp.diag(t) if isinstance(t, cp.Expression) else np.diag(t)
        scaled = diagonal @ below_largest
        total = total - (above_least.T @ scaled + scaled.T @ above_least)
    return total
