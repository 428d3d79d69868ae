"""The Jacobian ball of a network by semidefinite programming: LipSDP with the centre of the ball
among the unknowns.

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

from ssm_study.bounds.network import Network
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
    """Smallest ball of matrices that, as semidefinite programming proves, contains every Jacobian
    of a network. Centre and least radius with `|J(v) - centre|_2 <= radius` for every v, for any
    centre or (`scalar_centre`) for a centre `alpha I`. Raises `BadRequest` as stated above."""
    hidden = [len(b) for b in network.biases]
    multipliers = [cp.Variable(h, nonneg=True) for h in hidden]
    shape = (network.outputs, network.inputs)
    centre = cp.Variable() * np.eye(network.inputs) if scalar_centre else cp.Variable(shape)
    square = cp.Variable(nonneg=True)  # L^2: the inequality is linear in it
    first = _selection_matrix(network, 0)
    last = _selection_matrix(network, len(hidden))
    form = _slope_constraint(network, multipliers) + square * first.T @ first
    output = network.weights[-1] @ last - centre @ first
    # Schur complement of |W d - C v|^2
    matrix = cp.bmat([[form, output.T], [output, np.eye(network.outputs)]])
    problem = cp.Problem(cp.Minimize(square), [matrix >> 0])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver="CLARABEL")
    except (cp.error.SolverError, ArithmeticError) as error:
        raise BadRequest(
            "bound_method", "lipsdp", f"the solver failed ({error})", "use interval"
        ) from error
    require(
        square.value is not None,
        "bound_method",
        "lipsdp",
        f"the solver reports {problem.status}",
        "use interval",
    )
    best = np.asarray(centre.value, dtype=float).reshape(shape)
    values = [np.asarray(t.value, dtype=float) for t in multipliers]
    radius = min(
        _proved_radius(network, [(1 + share) * t for t in values], best) for share in ENLARGED
    )
    require(
        np.isfinite(radius),
        "bound_method",
        "lipsdp",
        "the multipliers do not prove a bound",
        "use interval",
    )
    return best, radius


def _proved_radius(
    network: Network, multipliers: list[Float[np.ndarray, "_"]], centre: Float[np.ndarray, "k m"]
) -> float:
    """Smallest radius of a ball of Jacobians around a given centre that given multipliers prove;
    infinite if they prove none. The radius follows from the Schur complement onto v of all other
    signals."""
    m = network.inputs
    largest = max(float(t.max(initial=0.0)) for t in multipliers)
    kept = [
        np.maximum(t, 0) + 1e-9 * largest for t in multipliers
    ]  # strictly positive, so the block is invertible
    form = _slope_constraint(network, kept)
    output = network.weights[-1] @ _selection_matrix(
        network, len(kept)
    ) - centre @ _selection_matrix(network, 0)
    form = form - output.T @ output
    inner = (form[m:, m:] + form[m:, m:].T) / 2
    try:
        factor = scipy.linalg.cho_factor(inner)  # fails where these multipliers prove nothing
    except np.linalg.LinAlgError:
        return np.inf
    needed = form[:m, m:] @ scipy.linalg.cho_solve(factor, form[m:, :m]) - form[:m, :m]
    return float(
        np.sqrt(max(np.linalg.eigvalsh((needed + needed.T) / 2)[-1], 0.0)) * (1 + ROUNDING_SHARE)
    )


def _selection_matrix(network: Network, layer: int) -> Float[np.ndarray, "h w"]:
    """Matrix that picks the input or the output of one layer from one stacked vector. The stack is
    `(v, d_1, ..., d_L)`; layer 0 stands for the input `v`."""
    sizes = [network.inputs, *(len(b) for b in network.biases)]
    start = sum(sizes[:layer])
    return np.eye(sum(sizes))[start : start + sizes[layer]]


def _slope_constraint(network: Network, multipliers: Sequence[Any]) -> Any:
    """Quadratic constraint that bounds the slopes of all neurons of a network. `-2 sum_l (d - lo
    q)^T T (hi q - d)` as a symmetric matrix; T symbolic or numeric."""
    total: Any = 0
    for layer, t in enumerate(multipliers):
        low, high = np.sort(
            np.stack([network.negative_slopes[layer], network.positive_slopes[layer]]), axis=0
        )
        d = _selection_matrix(network, layer + 1)
        q = network.weights[layer] @ _selection_matrix(network, layer)
        left = d - low[:, None] * q
        right = high[:, None] * q - d
        scaled = (cp.diag(t) if isinstance(t, cp.Expression) else np.diag(t)) @ right
        total = total - (left.T @ scaled + scaled.T @ left)
    return total
