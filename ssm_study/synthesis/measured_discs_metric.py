"""Search for a metric P that proves stability for a disc of model errors, among candidates from
Riccati equations.

Source: docs/theory.md, "Measured discs".
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import symmetric_part
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs

SLACKS = (1e-4, 1e-6, 1e-8)  # of the Riccati equation, where each signal's own weight is one
KEPT = 0.5  # of the margin by frequency, for the equation
FLOOR = 1e-10  # directions of the loop that no signal reaches keep this share of the mean


def first_exact_certificate(
    theorem: type[MeasuredDiscs],
    context: VerificationContext,
    numbers: dict[str, Any],
    margin: float,
    start_time: float,
) -> MeasuredDiscs | None:
    """Certificate for a disc of model errors with the first candidate metric P that exact
    arithmetic accepts; None if it accepts none."""
    if margin <= 0:
        return None
    ball = context.balls.input
    matrices = theorem.loop_matrices(context) | numbers
    matrices["alpha"] = ball.alpha
    matrices["beta"] = ball.beta
    for p in metric_candidates(theorem, matrices, margin):
        proof: MeasuredDiscs = theorem.from_numbers(
            matrices | {"p": p},
            started=start_time,
            status="one convex program, one Riccati equation",
            method="measured discs",
        )
        if proof.certified:
            return proof
    return None


def metric_candidates(
    theorem: type[MeasuredDiscs], numbers: dict[str, Any], margin: float
) -> Iterator[Float[np.ndarray, "x x"]]:
    """Candidates for the metric P in a certificate for a disc of model errors, from Riccati
    equations at several values of a slack."""
    matrices = {name: np.atleast_2d(value) for name, value in numbers.items()}
    of = SimpleNamespace(**matrices)
    rows = theorem.signal_matrices(of)
    order = len(rows.xi)
    form = theorem.disc_constraint(of, rows)
    for multiplier, map_form in theorem.static_map_constraints(of, rows):
        form = form + multiplier * map_form
    a = rows.step[:, :order]
    b = rows.step[:, order:]
    free_signals = np.diagonal(form)[order:]
    own_weights = np.abs(free_signals)
    smallest = 1e-9 * own_weights.max()
    root = np.sqrt(np.maximum(own_weights, smallest))
    driven = b / root
    matrix = scipy.linalg.solve_discrete_lyapunov(a, driven @ driven.T)
    gramian = symmetric_part(matrix)
    share = FLOOR * np.trace(gramian) / order
    state_identity = np.eye(order)
    regular_gramian = gramian + share * state_identity
    right = np.linalg.cholesky(regular_gramian)
    left = np.linalg.inv(right)
    unit_signals = np.diag(1 / root)
    scaling = scipy.linalg.block_diag(right, unit_signals)
    scaled = symmetric_part(scaling.T @ form @ scaling)
    state_form = scaled[:order, :order]
    coupling = scaled[:order, order:]
    signal_form = scaled[order:, order:]
    signal_identity = np.eye(len(root))
    scaled_a = left @ a @ right
    scaled_b = left @ driven
    for slack in SLACKS:
        q = state_form - slack * margin * state_identity
        r = signal_form - KEPT * margin * signal_identity
        try:
            x = scipy.linalg.solve_discrete_are(scaled_a, scaled_b, q, r, s=coupling)
        except (np.linalg.LinAlgError, ValueError):
            continue
        p = symmetric_part(-(left.T @ x @ left))
        if lmi_margin(theorem, numbers | {"p": p}) > 0:
            yield p


def lmi_margin(theorem: type[MeasuredDiscs], numbers: dict[str, Any]) -> float:
    """Smallest floating-point eigenvalue of the matrices that a theorem requires to be positive
    definite, each scaled to unit diagonal."""
    matrices = theorem.float_conditions(**numbers)
    smallest_eigenvalues = []
    for name in ("inequality", "p"):
        eigenvalues = np.linalg.eigvalsh(matrices[name])
        smallest_eigenvalues.append(float(eigenvalues[0]))
    return min(smallest_eigenvalues)
