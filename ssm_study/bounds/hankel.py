"""Which states matter: Hankel singular values, balanced coordinates, balanced truncation."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.bounds.gramians import controllability_gramian, observability_gramian
from ssm_study.refusal import require
from ssm_study.systems import StateSpace

# Balancing divides by the square roots of the Hankel singular values; below this share of the largest, a state is
# rounding noise of the Gramians (they are accurate to about 1e-16 of their norm, and the values are square roots).
BALANCING_FLOOR = 1e-8


@dataclass(frozen=True, kw_only=True)
class Balanced:
    """`z = t_inverse x`: both Gramians of `linear` equal `diag(hankel)`; truncated, `t_inverse t = I` still holds.

    Shapes: `t (n, k)`, `t_inverse (k, n)`, `hankel (n,)` in descending order; `2 sum(hankel[k:])` bounds the
    H-infinity norm of what truncation dropped (Enns 1984; Glover 1984).
    """

    linear: StateSpace
    t: Float[np.ndarray, "n k"]
    t_inverse: Float[np.ndarray, "k n"]
    hankel: Float[np.ndarray, "n"]


def hankel_singular_values(linear: StateSpace) -> Float[np.ndarray, "n"]:
    """`sqrt(eig(W_c W_o))`, descending: how much each balanced state carries from past input to future output."""
    return np.asarray(
        scipy.linalg.svdvals(_root(observability_gramian(linear)).T @ _root(controllability_gramian(linear)))
    )


def balance(linear: StateSpace, order: int | None = None) -> Balanced:
    """Square-root balancing (Laub et al. 1987), keeping the first `order` states (default: all).

    Raises `BadRequest` for a model that is not stable, an order outside `1 .. n`, or kept states whose Hankel singular
    value lies below `BALANCING_FLOOR` of the largest: such coordinates would be rounding noise.
    """
    order = linear.order if order is None else order
    require(
        1 <= order <= linear.order, "truncate_to", order, f"the model has order {linear.order}", "choose 1 .. order"
    )
    root_c, root_o = _root(controllability_gramian(linear)), _root(observability_gramian(linear))
    left, hankel, right_t = np.linalg.svd(root_o.T @ root_c)
    require(
        bool(hankel[order - 1] > BALANCING_FLOOR * hankel[0]),
        "hankel_smallest",
        float(hankel[order - 1]),
        f"below {BALANCING_FLOOR:g} of the largest ({hankel[0]:.3g}), so balanced coordinates are ill-conditioned",
        f"set reduction.truncate_to to at most {int((hankel > BALANCING_FLOOR * hankel[0]).sum())}",
    )
    scale = 1 / np.sqrt(hankel[:order])
    t = root_c @ right_t[:order].T * scale
    t_inverse = scale[:, None] * (left[:, :order].T @ root_o.T)
    reduced = StateSpace(a=t_inverse @ linear.a @ t, b=t_inverse @ linear.b, c=linear.c @ t, d=linear.d)
    return Balanced(linear=reduced, t=t, t_inverse=t_inverse, hankel=hankel)


def _root(gramian: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """`R` with `R R^T = W`, by eigenvalues, so that a singular Gramian is no error."""
    values, vectors = np.linalg.eigh(gramian)
    return vectors * np.sqrt(np.maximum(values, 0.0))
