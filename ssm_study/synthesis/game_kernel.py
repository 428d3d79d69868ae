"""Compiled solver of the Riccati equation of a dynamic game, which gives its saddle point and the
gradient there.

Everything is a matrix of floats with its rows in sequence and every product a loop of its own: one
kind of array, few instances, a compiler that is done in seconds. A step that has no solution raises
`LinAlgError`.

Source: docs/theory.md, "With neurons" (`structured_riccati` has the equation); doubling: Chu, Fan,
Lin & Wang 2004.
"""

from math import exp, log
from typing import no_type_check

import numpy as np

from ssm_study.models.structured_kernel import compile_with_numba

DOUBLINGS = 40
CONVERGED = 1e-11


@compile_with_numba
@no_type_check
def transpose(a):
    """Transpose `a'` of a matrix."""
    out = np.empty((a.shape[1], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]
    return out


@compile_with_numba
@no_type_check
def multiply(a, b):
    """Matrix product of two matrices."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            each = a[i, k]
            for j in range(b.shape[1]):
                out[i, j] += each * b[k, j]
    return out


@compile_with_numba
@no_type_check
def weighted_sum(a, b, factor):
    """Weighted sum `a + factor b` of two matrices."""
    out = np.empty(a.shape)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j] + factor * b[i, j]
    return out


@compile_with_numba
@no_type_check
def join_columns(a, b):
    """Block matrix `[a, b]` of two matrices side by side."""
    out = np.empty((a.shape[0], a.shape[1] + b.shape[1]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]
        for j in range(b.shape[1]):
            out[i, a.shape[1] + j] = b[i, j]
    return out


@compile_with_numba
@no_type_check
def solve_linear(a, b):
    """Solution `a^{-1} b` of a system of linear equations by elimination with partial pivots.
    Raises an error if a is singular or has NaN."""
    n = len(a)
    rows = join_columns(a, b)
    width = rows.shape[1]
    for i in range(n):
        best = i
        for j in range(i + 1, n):
            if abs(rows[j, i]) > abs(rows[best, i]):
                best = j
        if not abs(rows[best, i]) > 0.0:
            raise np.linalg.LinAlgError("singular")
        for k in range(i, width):
            rows[best, k], rows[i, k] = rows[i, k], rows[best, k]
        for k in range(i + 1, width):
            rows[i, k] /= rows[i, i]
        for j in range(n):
            for k in range(i + 1, width if j != i else 0):
                rows[j, k] -= rows[j, i] * rows[i, k]
    return rows[:, n:].copy()


@compile_with_numba
@no_type_check
def log_determinant(a):
    """Logarithm of the determinant of a positive definite matrix, by its Cholesky factor. Raises an
    error for any other matrix."""
    n = len(a)
    total = 0.0
    lower = np.zeros(a.shape)
    for i in range(n):
        for j in range(i + 1):
            left = a[i, j]
            for k in range(j):
                left -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = left / lower[j, j]
        if not left > 0.0:  # and NaN
            raise np.linalg.LinAlgError("not positive definite")
        lower[i, i] = left**0.5
        total += log(left)
    return total


@compile_with_numba
@no_type_check
def _add_symmetrised(total, increment):
    """Add the symmetric part of a matrix to a sum, in place. Returns 1 if the step is negligible,
    -1 if the sum diverges (or is NaN), else 0."""
    largest = change = 0.0
    for i in range(len(total)):
        for j in range(i + 1):
            middle = (
                increment[i, j] + increment[j, i]
            ) / 2  # rounding must not make the sum unsymmetric
            total[i, j] = total[j, i] = (total[i, j] + total[j, i]) / 2 + middle
            if not abs(total[i, j]) < 1e200:  # and NaN, before a square overflows
                return -1
            largest = max(largest, abs(total[i, j]))
            change = max(change, abs(middle))
    return 1 if change <= CONVERGED * largest else 0


@compile_with_numba
@no_type_check
def riccati_solution(a, g, h):
    """Stabilising solution of `H = Q + A'H (I + G H)^{-1} A`, by the doubling algorithm. Raises an
    error if there is none. G and H are overwritten."""
    n = len(a)
    ended = 0
    for _ in range(DOUBLINGS):
        # One elimination serves both: the closed-loop matrix, and what it adds to G.
        both = solve_linear(weighted_sum(np.eye(n), multiply(g, h), 1.0), join_columns(a, g))
        left = both[:, :n].copy()
        right = both[:, n:].copy()
        across = transpose(a)
        ended = _add_symmetrised(h, multiply(multiply(across, h), left))
        if ended:
            break
        _add_symmetrised(g, multiply(multiply(a, right), across))
        a = multiply(
            a, left
        )  # the closed-loop matrix is squared: after k steps 2^k samples are summed
    if ended != 1:
        raise np.linalg.LinAlgError("the doubling has no limit")
    return h


@compile_with_numba
@no_type_check
def solve_lyapunov(a, source):
    """Solution of the Lyapunov equation `P = a P a' + source`. Raises an error unless a is stable.
    The source is overwritten."""
    ended = 0
    for _ in range(DOUBLINGS):
        ended = _add_symmetrised(source, multiply(multiply(a, source), transpose(a)))
        if ended:
            break
        a = multiply(a, a)  # Smith's squaring: as many terms again in each step
    if ended != 1:
        raise np.linalg.LinAlgError("not stable")
    return source


@compile_with_numba
@no_type_check
def _cost_matrices(f, input_to_neurons, state_weight, input_weight, m, r, log_multipliers):
    """Cost matrices of the game Riccati equation for given logarithms of the multipliers."""
    (q, n), inputs = f.shape, input_to_neurons.shape[1]
    bound = exp(log_multipliers[q]) if inputs > m else 0.0  # lambda_p: |p|^2 <= |u|^2
    rows = join_columns(input_to_neurons, f)  # what drives each neuron, by (u, p, x)
    weighted = np.empty(rows.shape)
    for i in range(q):
        for j in range(inputs + n):
            weighted[i, j] = rows[i, j] * exp(log_multipliers[i]) / 2
    every = multiply(transpose(rows), weighted)
    own = np.zeros((inputs + q, inputs + q))
    s = np.zeros((inputs + q, n))
    for i in range(inputs):
        for j in range(inputs):
            own[i, j] = every[i, j] / r**2
        for j in range(n):
            s[i, j] = every[i, inputs + j] / r**2
        own[i, i] += (input_weight + bound if i < m else -bound) / r**2
    for i in range(q):  # |v_i| <= |z_i|, by Lambda
        own[inputs + i, inputs + i] = -exp(log_multipliers[i]) / 2 / r**2
    cost = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            cost[i, j] = (state_weight[i, j] + every[inputs + i, inputs + j]) / r**2
    return cost, own, s


@compile_with_numba
@no_type_check
def _constraint_matrix(h, m, inputs, has_injection):
    """Matrix that selects the signals of a game's maximising players, for which the quadratic form
    of the game must be negative. It depends on the order in which the players move."""
    size = len(h)
    t = np.zeros((size, size - m))
    for i in range(m, size):
        t[i, i - m] = 1.0
    if has_injection:
        log_determinant(h[:m, :m].copy())
        answered = solve_linear(h[:inputs, :inputs].copy(), h[:inputs, inputs:].copy())
        for i in range(inputs):
            for j in range(size - inputs):
                t[i, inputs - m + j] = -answered[i, j]
    return t


@compile_with_numba
@no_type_check
def _cost_gradient(
    f,
    input_to_neurons,
    m,
    r,
    log_multipliers,
    barrier_weight,
    saddle_gain,
    state_gramian,
    barrier_matrix,
):
    """Gradient of the guaranteed cost with respect to the logarithms of the multipliers, at the
    saddle point of the game.

    At a saddle point the players' own changes count only in second order: the multipliers act on
    the cost alone.
    """
    (q, n), inputs = f.shape, input_to_neurons.shape[1]
    z = weighted_sum(
        f, multiply(input_to_neurons, saddle_gain[:inputs].copy()), 1.0
    )  # what drives each neuron there
    driven = multiply(z, state_gramian)
    played = multiply(saddle_gain, state_gramian)
    moved_shadow = multiply(input_to_neurons, barrier_matrix[:inputs, :inputs].copy())
    gradient = np.full(len(log_multipliers), barrier_weight)
    for i in range(q):
        flow = barrier_weight * -barrier_matrix[inputs + i, inputs + i]
        for j in range(n):
            flow += driven[i, j] * z[i, j] - played[inputs + i, j] * saddle_gain[inputs + i, j]
        for j in range(inputs):
            flow += barrier_weight * moved_shadow[i, j] * input_to_neurons[i, j]
        gradient[i] += exp(log_multipliers[i]) * flow / 2 / r**2
    if inputs > m:
        size = 0.0
        for i in range(inputs):
            own = barrier_weight * barrier_matrix[i, i]
            for j in range(n):
                own += played[i, j] * saddle_gain[i, j]
            size += own if i < m else -own
        gradient[q] = exp(log_multipliers[q]) * size / r**2 + m * barrier_weight
    return gradient


@compile_with_numba
@no_type_check
def solve_saddle_point(a, b, f, drive, state_weight, input_weight, m, r, injects, logs, barrier):
    """Saddle point of a dynamic game for given logarithms of the multipliers, with guaranteed cost
    and gradient."""
    (q, n), inputs = f.shape, drive.shape[1]
    cost, own, s = _cost_matrices(f, drive, state_weight, input_weight, m, r, logs)
    across = transpose(b)
    inverse = solve_linear(own, join_columns(s, across))
    first = inverse[:, :n].copy()
    second = inverse[:, n:].copy()
    x = riccati_solution(
        weighted_sum(a, multiply(b, first), -1.0),
        multiply(b, second),
        weighted_sum(cost, multiply(transpose(s), first), -1.0),
    )
    log_determinant(x)
    into = multiply(across, x)
    h = weighted_sum(own, multiply(into, b), 1.0)
    toward = weighted_sum(s, multiply(into, a), 1.0)
    t = _constraint_matrix(h, m, inputs, injects)
    room = multiply(transpose(t), multiply(h, t))
    for i in range(len(room)):  # the maximising players' curvature: positive, or no saddle exists
        for j in range(len(room)):
            room[i, j] = -room[i, j]
    trace = 0.0
    log_volume = 0.0
    for i in range(n):
        trace += x[i, i]
    for i in range(len(logs)):
        log_volume += logs[i] if i < q else m * logs[i]
    goal = log(trace) - barrier * (log_determinant(room) - log_volume)
    saddle = solve_linear(h, toward)
    for i in range(len(saddle)):
        for j in range(n):
            saddle[i, j] = -saddle[i, j]
    shadow = multiply(t, solve_linear(room, transpose(t)))  # T (T'(-H)T)^{-1} T'
    source = weighted_sum(np.eye(n) / trace, multiply(multiply(b, shadow), across), barrier)
    reach = solve_lyapunov(weighted_sum(a, multiply(b, saddle), 1.0), source)
    gradient = _cost_gradient(f, drive, m, r, logs, barrier, saddle, reach, shadow)
    return goal, gradient, x, h, toward
