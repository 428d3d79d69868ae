"""The game Riccati equation of a structured model and the search over its multipliers.

The equation, its conditions and its gradient: `theorems.structured_riccati`; doubling: Chu, Fan, Lin & Wang 2004.
Compiled, with the eliminations of small matrices written out: the calls of NumPy took ten times as long as the sums.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured_kernel import compiled

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "_"]
DOUBLINGS = 40
CONVERGED = 1e-11
STRIDE = 2.0  # the largest change of a log multiplier in one step
FLAT = 1e-3  # a descent ends when a step gains less of the logarithm of its goal


class Game(NamedTuple):
    """One side's data: a state feedback's own; an observer's transposed, `C', F', E', H'` for `b, e, f, g`.

    `a (n, n)`, `b (n, m)`, `e (n, q)`, `f (q, n)`, `g (q, m)`, rows in sequence; the ball `alpha, beta`; the factor
    `r`; the weights `state_weight (n, n)`, `input_weight`; `injects`: the gain also answers the neurons' injection.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    g: Float[np.ndarray, "q m"]
    alpha: float
    beta: float
    r: float
    state_weight: Float[np.ndarray, "n n"]
    input_weight: float
    injects: bool


class Saddle(NamedTuple):
    """At admissible multipliers: the goal and its gradient, `X`, `H = R + B'X B` and `B'X A + S'`."""

    goal: float
    gradient: Vector
    x: Matrix
    h: Matrix
    toward: Matrix


@compiled
@no_type_check
def turned(a):
    """`a'`, its rows in sequence: one kind of array, one compilation."""
    out = np.empty((a.shape[1], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]
    return out


@compiled
@no_type_check
def solved(a, b):
    """`a^{-1} b` by elimination with partial pivots; raises `LinAlgError` for a singular a, or NaN."""
    n, rows = len(a), np.hstack((a, b))
    for i in range(n):
        best = i + np.argmax(np.abs(rows[i:, i]))
        if not abs(rows[best, i]) > 0.0:
            raise np.linalg.LinAlgError("singular")
        for k in range(i, rows.shape[1]):
            rows[best, k], rows[i, k] = rows[i, k], rows[best, k]
        for k in range(i + 1, rows.shape[1]):
            rows[i, k] /= rows[i, i]
        for j in range(n):
            for k in range(i + 1, rows.shape[1] if j != i else 0):
                rows[j, k] -= rows[j, i] * rows[i, k]
    return rows[:, n:].copy()


@compiled
@no_type_check
def log_det(matrix):
    """By Cholesky's factor; raises `LinAlgError` unless positive definite."""
    factor, total = matrix.copy(), 0.0
    for j in range(len(factor)):
        for k in range(j):
            for i in range(j, len(factor)):
                factor[i, j] -= factor[i, k] * factor[j, k]
        if not 0.0 < factor[j, j] < np.inf:
            raise np.linalg.LinAlgError("not positive definite")
        root = np.sqrt(factor[j, j])
        total += 2.0 * np.log(root)
        for i in range(j, len(factor)):
            factor[i, j] /= root
    return total


@compiled
@no_type_check
def _grown(total, step):
    """Adds the step, made symmetric; 1 where it no longer counts, -1 where the sum has no limit (or is NaN), else 0."""
    largest = change = 0.0
    for i in range(len(total)):
        for j in range(i + 1):
            middle = (step[i, j] + step[j, i]) / 2  # rounding must not make the sum unsymmetric
            total[i, j] = total[j, i] = (total[i, j] + total[j, i]) / 2 + middle
            if not abs(total[i, j]) < 1e200:  # and NaN, before a square overflows
                return -1
            largest, change = max(largest, abs(total[i, j])), max(change, abs(middle))
    return 1 if change <= CONVERGED * largest else 0


@compiled
@no_type_check
def _doubled(a, g, h):
    """The limit of `H <- H + A'H (I + G H)^{-1} A`; raises `LinAlgError` where there is none."""
    n = len(a)
    for _ in range(DOUBLINGS):
        # One elimination serves both: the closed-loop matrix, and what it adds to G.
        both = solved(np.eye(n) + g @ h, np.hstack((a, g)))
        left, right = both[:, :n].copy(), both[:, n:].copy()
        ended = _grown(h, turned(a) @ h @ left)
        if ended:
            break
        _grown(g, a @ right @ turned(a))
        a = a @ left  # the closed-loop matrix is squared: after k steps 2^k samples are summed
    if ended != 1:
        raise np.linalg.LinAlgError("the doubling has no limit")
    return h


@compiled
@no_type_check
def _summed(a, source):
    """`P = a P a' + source`; raises `LinAlgError` unless a is stable."""
    for _ in range(DOUBLINGS):
        ended = _grown(source, a @ source @ turned(a))
        if ended:
            break
        a = a @ a  # Smith's squaring: as many terms again in each step
    if ended != 1:
        raise np.linalg.LinAlgError("not stable")
    return source


@compiled
@no_type_check
def _matrices(game, logs):
    """`A, B, Q, R, S` of the equation, inputs `(u, p, v)`, at these log multipliers."""
    (n, m), q, r = game.b.shape, game.e.shape[1], game.r
    inputs = m if game.beta == 0.0 else 2 * m
    weights, scaled = np.exp(logs[:q]), np.empty((q, n))
    b, s, own = np.zeros((n, inputs + q)), np.zeros((n, inputs + q)), np.zeros((inputs + q, inputs + q))
    for i in range(q):
        scaled[i] = game.f[i] * weights[i] / 2
        b[:, inputs + i] = game.e[:, i] / (2 * r)
        own[inputs + i, inputs + i] = -weights[i] / (2 * r * r)  # |v_i| <= |z_i|, weighed by Lambda
    drive = game.b + game.e @ game.g / 2  # w = (z + v) / 2: half of each neuron is linear
    seen = turned(scaled) @ game.g
    for i in range(inputs):
        move = game.alpha if i < m else game.beta
        b[:, i], s[:, i] = move * drive[:, i % m] / r, move * seen[:, i % m] / r**2
        for j in range(inputs):
            both = (game.g[:, i % m] * game.g[:, j % m] * weights).sum() / 2
            own[i, j] = move * (game.alpha if j < m else game.beta) * both / r**2
        own[i, i] += (game.input_weight if i < m else 0.0) / r**2
        if inputs > m:  # lambda_p: |p|^2 <= |u|^2
            own[i, i] += (1.0 if i < m else -1.0) * np.exp(logs[q]) / r**2
    cost = (game.state_weight + turned(scaled) @ game.f) / r**2
    return (game.a + game.e @ game.f / 2) / r, b, cost, own, s


@compiled
@no_type_check
def _constraint(game, h):
    """`T` with `T'H T < 0` the order of play: (p, v) after u; or, where the gain answers v, what v has left then."""
    m, size = game.b.shape[1], len(h)
    t = np.zeros((size, size - m))
    for i in range(size - m):
        t[m + i, i] = 1.0
    if game.injects:
        first = h[:m, :m].copy()
        log_det(first)
        t[:m] = -solved(first, h[:m, m:].copy())
    return t


@compiled
@no_type_check
def _saddle(game, logs, barrier):
    """As `evaluate`; raises `LinAlgError` where there is none."""
    a, b, cost, own, s = _matrices(game, logs)
    (n, m), q, size = game.b.shape, game.e.shape[1], len(own)
    inverse = solved(own, np.hstack((turned(s), turned(b))))
    to_a, to_b = inverse[:, :n].copy(), inverse[:, n:].copy()
    x = _doubled(a - b @ to_a, b @ to_b, cost - s @ to_a)
    log_det(x)
    into = turned(b) @ x
    h, toward = own + into @ b, into @ a + turned(s)
    t = _constraint(game, h)
    room = -turned(t) @ h @ t  # the maximising players' curvature: positive, or no saddle exists
    goal = np.log(np.trace(x)) - barrier * (log_det(room) - logs[:q].sum())
    if size > m + q:
        goal += barrier * m * logs[q]
    saddle = -solved(h, toward)
    shadow = t @ solved(room, turned(t))  # T (T'(-H)T)^{-1} T'
    source = np.eye(n) / np.trace(x) + barrier * b @ shadow @ turned(b)
    reach = _summed(a + b @ saddle, source)
    return Saddle(goal, _gradient(game, logs, barrier, saddle, reach, shadow), x, h, toward)


@compiled
@no_type_check
def _gradient(game, logs, barrier, saddle, reach, shadow):
    """The goal's, from the saddle point `(u, p, v)`, the loop's Gramian `reach` and `shadow` of `_saddle`."""
    m, q = game.b.shape[1], game.e.shape[1]
    inputs, r2 = len(saddle) - q, game.r**2
    u, p, fixed = saddle[:m].copy(), np.zeros((m, len(reach))), np.zeros((q, len(saddle)))
    fixed[:, :m] = game.alpha * game.g
    if inputs > m:
        p, fixed[:, m:inputs] = saddle[m:inputs].copy(), game.beta * game.g
    z = game.f + game.g @ (game.alpha * u + game.beta * p)  # what drives each neuron there
    gradient, v = np.empty(len(logs)), saddle[inputs:].copy()
    flow = (z @ reach * z - v @ reach * v).sum(axis=1)
    still = (fixed @ shadow * fixed).sum(axis=1)
    # At a saddle point the players' own changes count only in second order: the multipliers act on the cost alone.
    for i in range(q):
        still[i] -= shadow[inputs + i, inputs + i]
        gradient[i] = np.exp(logs[i]) * (flow[i] + barrier * still[i]) / (2 * r2) + barrier
    if inputs > m:
        both = (u @ reach * u - p @ reach * p).sum()
        for i in range(m):
            both += barrier * (shadow[i, i] - shadow[m + i, m + i])
        gradient[q] = np.exp(logs[q]) * both / r2 + m * barrier
    return gradient


def evaluate(game: Game, logs: Vector, barrier: float) -> Saddle:
    """The saddle point at the log multipliers (`Lambda`, then `lambda_p`); its goal is infinite where they admit none.

    The goal is `log trace X - barrier log det(-T'H T / D)`, `D = diag(lambda_p, Lambda)`: the second term keeps
    the search off the edge of what is admissible, where the gradient of the first one leads.
    """
    try:
        found: Saddle = _saddle(game, logs, barrier)
    except (np.linalg.LinAlgError, ArithmeticError):
        none = np.empty((0, 0))
        found = Saddle(np.inf, np.empty(0), none, none, none)
    return found


def descend(game: Game, logs: Vector, barrier: float, evaluations: int) -> Vector:
    """BFGS on the goal from admissible `logs`; a step to an inadmissible point is shortened. The best logs found.

    Not compiled, like `evaluate`: the compiler would optimise all of the equation again in each, for half a minute.
    """
    at, metric, left, gained = evaluate(game, logs, barrier), np.eye(len(logs)), evaluations, np.inf
    while np.isfinite(at.goal) and left > 0 and gained >= FLAT:
        step = -(metric @ at.gradient)
        step *= min(1.0, STRIDE / max(np.abs(step).max(), 1e-300))
        there, lower = at, False
        while left > 0 and not lower and np.abs(step).max() > 1e-6:
            left -= 1
            there = evaluate(game, logs + step, barrier)
            lower = bool(there.goal < at.goal + 1e-4 * (step @ at.gradient))  # Armijo's condition
            step = step if lower else step / 3
        if not lower:
            break
        logs, change, gained = logs + step, there.gradient - at.gradient, at.goal - there.goal
        along, at = step @ change, there
        if along > 1e-12:  # BFGS's curvature condition: without it the metric would lose definiteness
            turn = np.eye(len(logs)) - np.outer(step, change) / along
            metric = turn @ metric @ turn.T + np.outer(step, step) / along
    return logs
