"""Unconstrained parameters of recurrences with neurons: every value gives a contracting recurrence.

All `(A, E, F)` whose open-loop inequality (docs/theory.md, "With neurons") holds at r with `M = I,
Lambda = I` are

    E = sqrt2 con(X_E),   [A; Gh] = r con(X_G),   R R' = 2 I - E'E,   F = R Gh - E'A,   con(X) = X
    chol(I + X'X)^{-T}

for the LMI's Schur complement is `(F + E'A)' (2 I - E'E)^{-1} (F + E'A) = Gh'Gh < r^2 I - A'A`.
Then F <- diag(d) F and E <- E diag(d)^{-1} with `d > 0` stand for `Lambda = diag(d)^{-2}`. `M = I`
is a choice of coordinates.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.refusal import BadRequest

ANGLES = np.append(0.0, np.geomspace(1e-4, np.pi, 200))  # rad per sample
FREQUENCIES = np.exp(1j * ANGLES)  # the Riccati equation has the last word
INSIDE = 0.9
PULLED = 0.99  # shares of the largest gain, and of the rate, that a projected model may have
STRICT = 1e-2  # relative: what makes the Riccati equation's inequality strict
HALVINGS = 12  # of the path from a free model to one that contracts
Square = Float[np.ndarray, "k k"]
Tall = Float[np.ndarray, "r k"]
Moved = Float[np.ndarray, "d _ _"]


class FreeParameters(NamedTuple):
    """Unconstrained parameters of a recurrence with neurons; the recurrence contracts for every
    value of them. `x_e (n, q)`, `x_g (n + q, n)`, `log_d (q,)` may be any numbers."""

    x_e: Float[np.ndarray, "*k n q"]
    x_g: Float[np.ndarray, "*k nq n"]
    log_d: Float[np.ndarray, "*k q"]


class RecurrenceMatrices(NamedTuple):
    """Matrices of a recurrence with neurons that decide whether the recurrence contracts. `a (n,
    n)`, `e (n, q)`, `f (q, n)`."""

    a: Float[np.ndarray, "*k n n"]
    e: Float[np.ndarray, "*k n q"]
    f: Float[np.ndarray, "*k q n"]


class ContractingRecurrence(NamedTuple):
    """Recurrence with neurons, together with a metric in which it provably contracts. `Lambda =
    diag(d)^{-2}`."""

    core: RecurrenceMatrices
    t: Float[np.ndarray, "n n"]
    d: Float[np.ndarray, "q"]


def matrices_from_parameters(free: FreeParameters, rate: float) -> RecurrenceMatrices:
    """Matrices of a contracting recurrence with neurons, computed from unconstrained parameters. It
    contracts with `r = rate` in the metric `M = I`."""
    n = free.x_g.shape[1]
    con_e, _ = _cayley_contraction(free.x_e)
    e = np.sqrt(2.0) * con_e
    con_g, _ = _cayley_contraction(free.x_g)
    stacked = rate * con_g
    a = stacked[:n]
    root = _slack_cholesky_factor(e)  # R
    scaled_g = stacked[n:]
    through_neurons = e.T @ a
    f = root @ scaled_g - through_neurons
    d = np.exp(free.log_d)  # positive, whatever the parameter
    scale_column = d[:, None]
    return RecurrenceMatrices(a=a, e=e / d, f=scale_column * f)


def differentiate_matrices(
    free: FreeParameters, directions: FreeParameters, rate: float
) -> RecurrenceMatrices:
    """Directional derivatives of a contracting recurrence's matrices with respect to the
    unconstrained parameters. The leading axis of `directions` counts directions.

    `con(X) = X L^{-T}`, `L L' = I + X'X`: `d con = (dX - con dL') L^{-T}` with `dL = L low(L^{-1}
    dS L^{-T})`, low the lower triangle with half its diagonal. The same rule gives `dR` of `R R' =
    2 I - E'E`.
    """
    n = free.x_g.shape[1]
    root2 = np.sqrt(2.0)
    con_e, low_e = _cayley_contraction(free.x_e)
    con_g, low_g = _cayley_contraction(free.x_g)
    e = root2 * con_e
    a = rate * con_g[:n]
    gh = rate * con_g[n:]
    dcon_e = _differentiate_cayley_contraction(free.x_e, directions.x_e, con_e, low_e)
    de = root2 * dcon_e
    dcon_g = _differentiate_cayley_contraction(free.x_g, directions.x_g, con_g, low_g)
    stacked = rate * dcon_g
    da = stacked[:, :n]
    dgh = stacked[:, n:]
    root = _slack_cholesky_factor(e)
    slack_change = de.mT @ e + e.T @ de
    droot = _differentiate_cholesky(root, -slack_change)  # of R R' = 2 I - E'E
    f = root @ gh - e.T @ a
    d = np.exp(free.log_d)
    dlog = directions.log_d
    scaled_change = droot @ gh + root @ dgh
    change_of_e = de.mT @ a
    change_of_a = e.T @ da
    df = scaled_change - change_of_e - change_of_a
    change_of_scale = e * dlog[:, None, :]
    de_scaled = (de - change_of_scale) / d
    scale_column = d[:, None]
    change_of_rows = dlog[:, :, None] * f
    df_scaled = scale_column * (df + change_of_rows)
    return RecurrenceMatrices(a=da, e=de_scaled, f=df_scaled)


def _slack_cholesky_factor(e: Float[np.ndarray, "n q"]) -> Float[np.ndarray, "q q"]:
    """Cholesky factor of `2 I - E'E` for the neuron output matrix E of a contracting recurrence."""
    identity = np.eye(e.shape[1])
    squared_e = e.T @ e
    return np.linalg.cholesky(2.0 * identity - squared_e)


def parameters_from_matrices(matrices: RecurrenceMatrices, rate: float) -> FreeParameters:
    """Unconstrained parameters that reproduce the matrices of a given contracting recurrence. The
    inverse of `matrices_from_parameters` with `d = 1`; `LinAlgError` where the LMI does not hold
    with `M = I, Lambda = I`."""
    e = matrices.e / np.sqrt(2.0)
    root = _slack_cholesky_factor(matrices.e)
    through_neurons = matrices.e.T @ matrices.a
    gh = np.linalg.solve(root, matrices.f + through_neurons)  # from F = R Gh - E'A
    rows = [matrices.a, gh]
    stacked = np.vstack(rows)
    x_e = _inverse_cayley_transform(e)
    x_g = _inverse_cayley_transform(stacked / rate)
    zero_scales = np.zeros(e.shape[1])
    return FreeParameters(x_e=x_e, x_g=x_g, log_d=zero_scales)


def project_to_contracting(
    matrices: RecurrenceMatrices, slope: Float[np.ndarray, "q"], rate: float
) -> ContractingRecurrence:
    """Change the matrices of a recurrence with neurons just so far that it contracts at a given
    rate. It is the first on a path from `matrices` that does; `slope` is the neurons' average
    slope.

    Along the path E shrinks while A takes over what the neurons did on average, `A + E diag(slope)
    F`, which is itself pulled inside `rate` first: at the end of the path no neuron is left. Raises
    `BadRequest` where floats hold none.
    """
    scaled_e = matrices.e * slope
    mean = scaled_e @ matrices.f  # what the neurons add to A on average
    mean_matrix = matrices.a + mean
    eigenvalues = np.linalg.eigvals(mean_matrix)
    moduli = np.abs(eigenvalues)
    radius = float(moduli.max(initial=0.0))
    positive_radius = max(radius, 1e-12)
    shrinkage = PULLED * rate / positive_radius
    pulled = min(1.0, shrinkage)
    average = pulled * (matrices.a + mean)
    low = 0.0
    high = 1.0
    share = 1.0
    contracting = None
    for _ in range(HALVINGS):
        shifted_a = average - share * mean
        shrunk_e = share * matrices.e
        on_path = RecurrenceMatrices(a=shifted_a, e=shrunk_e, f=matrices.f)
        trial = find_contraction_metric(on_path, rate)
        if trial is None:
            high = share
        else:
            low = share
            contracting = trial
        if low == 1.0:
            break
        share = 0.5 * (low + high)
    if contracting is None:
        no_e = 0.0 * matrices.e
        without_neurons = RecurrenceMatrices(a=average, e=no_e, f=matrices.f)
        contracting = find_contraction_metric(without_neurons, rate)
    if contracting is None:
        problem = "the linear part of the model does not contract at this rate"
        raise BadRequest("model", "no metric", problem, "use a larger rate")
    return contracting


def find_contraction_metric(
    matrices: RecurrenceMatrices, rate: float
) -> ContractingRecurrence | None:
    """Find a metric in which a recurrence with neurons contracts at a given rate; None if the
    search finds none. The metric is M and Lambda.

    With `w = (z + v)/2` the LMI is the bounded-real lemma of `C (zI - A)^{-1} B < 1`, `A = (A + E
    F/2)/r`, `B = E Lambda^{-1/2}/2`, `C = Lambda^{1/2} F/r`; Lambda balances the rows and columns
    of its largest entries over the frequencies (Osborne 1960), `2 M` solves the Riccati equation.
    """
    mean_neurons = matrices.e @ matrices.f / 2.0
    a = (matrices.a + mean_neurons) / rate
    b = matrices.e / 2.0
    c = matrices.f / rate
    eigenvalues = np.linalg.eigvals(a)
    moduli = np.abs(eigenvalues)
    if moduli.max(initial=0.0) >= 1.0:
        return None
    points = FREQUENCIES[:, None, None]
    identity = np.eye(len(a))
    shifted = points * identity - a
    state_response = np.linalg.solve(shifted, b + 0j)
    response = c @ state_response
    magnitudes = np.abs(response)
    d = _balancing_scales(magnitudes.max(axis=0, initial=0.0))
    b = b * d / INSIDE  # asks for a gain below INSIDE, not only below one
    c = c / d[:, None]
    q = b.shape[1]
    weight = c.T @ c  # of the bounded-real lemma: |C x|^2
    trace = np.trace(weight)
    regularisation = STRICT * max(1.0, trace)
    weight += regularisation * np.eye(len(a))
    try:
        if q:
            identity_of_neurons = np.eye(q)
            p = scipy.linalg.solve_discrete_are(a, b, weight, -identity_of_neurons)
        else:
            p = scipy.linalg.solve_discrete_lyapunov(a.T, weight)
        half_metric_factor = np.linalg.cholesky(p / 2.0)
        contracting = ContractingRecurrence(matrices, half_metric_factor.T, d)
        parameters_from_matrices(transform_to_metric(contracting), rate)
    except (np.linalg.LinAlgError, ValueError):  # the gain is one or more: there is no solution
        return None
    return contracting


def transform_to_metric(contracting: ContractingRecurrence) -> RecurrenceMatrices:
    """Transform a contracting recurrence to state coordinates in which its contraction metric is
    the identity. `xt = T x`, with Lambda moved into E and F: `M = I, Lambda = I`."""
    core, t, d = contracting
    back = np.linalg.inv(t)
    a = t @ core.a @ back
    f = core.f @ back
    transformed_e = t @ core.e
    scale_column = d[:, None]
    return RecurrenceMatrices(a=a, e=transformed_e * d, f=f / scale_column)


def _balancing_scales(gains: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "q"]:
    """Diagonal scaling that gives the rows and columns of a matrix equal norms (balancing). Off the
    diagonal, the rows and columns of `diag(1/d) gains diag(d)` have equal norms."""
    diagonal = np.diagonal(gains)
    off = gains - np.diag(diagonal)
    d = np.ones(len(gains))  # the diagonal does not move under scaling
    for _ in range(20):  # sweeps of Osborne's iteration
        for i in range(len(d)):
            scaled_row = off[i] * d
            row = np.linalg.norm(scaled_row) / d[i]
            scaled_column = off[:, i] / d
            column = np.linalg.norm(scaled_column) * d[i]
            if row > 0 and column > 0:
                d[i] *= np.sqrt(row / column)
    return d


def _cayley_contraction(x: Tall) -> tuple[Tall, Square]:
    """Matrix of norm below one from any matrix, by the Cayley transform, together with the Cholesky
    factor used in it."""
    identity = np.eye(x.shape[1])
    squared = x.T @ x
    low = np.linalg.cholesky(identity + squared)
    contraction = np.linalg.solve(low, x.T)
    return contraction.T, low


def _inverse_cayley_transform(y: Tall) -> Tall:
    """Matrix that the Cayley transform maps to a given matrix of norm below one. `con(X) = Y`. `I -
    Y'Y = L^{-1} L^{-T}`, so `X = Y L'` with the inverse of its Cholesky factor as L."""
    identity = np.eye(y.shape[1])
    squared = y.T @ y
    inverse = np.linalg.cholesky(identity - squared)
    inverse_factor = np.linalg.inv(inverse)
    return y @ inverse_factor.T


def _differentiate_cayley_contraction(x: Tall, dx: Moved, con: Tall, low: Square) -> Moved:
    """Directional derivatives of the norm-bounded matrix that the Cayley transform computes."""
    slack_change = dx.mT @ x + x.T @ dx
    dlow = _differentiate_cholesky(low, slack_change)
    through_factor = con @ dlow.mT
    inverse_factor = np.linalg.inv(low)
    return (dx - through_factor) @ inverse_factor.T


def _differentiate_cholesky(low: Square, ds: Moved) -> Moved:
    """Directional derivatives of the Cholesky factor of a positive definite matrix. `dL = L
    low(L^{-1} dS L^{-T})` for `L L' = S`."""
    back = np.linalg.inv(low)
    inner = np.tril(back @ ds @ back.T)  # low() with its whole diagonal
    identity = np.eye(len(low))
    half_diagonal = 0.5 * inner * identity
    return low @ (inner - half_diagonal)
