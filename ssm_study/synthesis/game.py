"""The game Riccati equation of a structured model and the search over its multipliers.

The equation, its conditions and its gradient: `theorems.structured_riccati`; doubling: Chu, Fan, Lin & Wang 2004.
In plain NumPy: compiled, a search takes 0.4 of the time, but the compiler takes as long as 2,000 searches.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "_"]
DOUBLINGS = 40
CONVERGED = 1e-11
STRIDE = 2.0  # the largest change of a log multiplier in one step
FLAT = 1e-3  # a descent ends when a step gains less of the logarithm of its goal


class Game(NamedTuple):
    """One side's data: a state feedback's own; an observer's transposed, `C', F', E', H'` for `b, e, f, g`.

    `a (n, n)`, `b (n, m)`, `e (n, q)`, `f (q, n)`, `g (q, m)`; the ball `alpha, beta`; the factor `r`; the weights
    `state_weight (n, n)`, `input_weight`; `injects`: the gain also answers the neurons' injection.
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


def _log_det(matrix: Matrix) -> float:
    """Raises `LinAlgError` unless positive definite."""
    value = 2.0 * float(np.log(np.linalg.cholesky(matrix).diagonal()).sum())
    if not np.isfinite(value):
        raise np.linalg.LinAlgError("not finite")
    return value


def _doubled(a: Matrix, g: Matrix, h: Matrix) -> Matrix:
    """The limit of `H <- H + A'H (I + G H)^{-1} A`; raises `LinAlgError` where there is none."""
    one, n = np.eye(len(a)), len(a)
    for _ in range(DOUBLINGS):
        solved = np.linalg.solve(one + g @ h, np.hstack((a, g)))
        left = solved[:, :n]
        step = a.T @ h @ left
        step = (step + step.T) / 2  # rounding must not make H unsymmetric
        h = h + step
        largest = np.abs(h).max()
        if not largest < 1e200:  # and NaN, before a square overflows
            break
        if np.abs(step).max() <= CONVERGED * largest:
            return h
        g = g + a @ solved[:, n:] @ a.T
        g = (g + g.T) / 2
        a = a @ left  # the closed-loop matrix is squared: after k steps 2^k samples are summed
    raise np.linalg.LinAlgError("the doubling has no limit")


def _summed(a: Matrix, source: Matrix) -> Matrix:
    """`P = a P a' + source`; raises `LinAlgError` unless a is stable."""
    total, power = source, a
    for _ in range(DOUBLINGS):
        step = power @ total @ power.T
        total = total + step
        largest = np.abs(total).max()
        if not largest < 1e200:
            break
        if np.abs(step).max() <= CONVERGED * largest:
            return total
        power = power @ power  # Smith's squaring: as many terms again in each step
    raise np.linalg.LinAlgError("not stable")


def _matrices(game: Game, logs: Vector) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """`A, B, Q, R, S` of the equation, inputs `(u, p, v)`, at these log multipliers."""
    m, q, r = game.b.shape[1], game.e.shape[1], game.r
    weights, move = np.exp(logs[:q]), (game.alpha, game.beta)[: 2 if game.beta > 0 else 1]
    drive = game.b + game.e @ game.g / 2  # w = (z + v) / 2: half of each neuron is linear
    scaled = game.f * weights[:, None] / 2
    seen, both = scaled.T @ game.g, (game.g * weights[:, None] / 2).T @ game.g
    b = np.hstack([*(factor * drive for factor in move), game.e / 2]) / r
    s = np.hstack([*(factor * seen for factor in move), np.zeros_like(game.e)]) / r**2
    own = np.zeros((b.shape[1], b.shape[1]))
    own[:-q, :-q] = np.kron(np.outer(move, move), both)
    own[:m, :m] += game.input_weight * np.eye(m)
    if game.beta > 0:  # lambda_p: |p|^2 <= |u|^2
        extra = np.exp(logs[q]) * np.eye(m)
        own[:m, :m] += extra
        own[m : 2 * m, m : 2 * m] -= extra
    own[-q:, -q:] = -np.diag(weights) / 2  # |v_i| <= |z_i|, weighed by Lambda
    cost = (game.state_weight + scaled.T @ game.f) / r**2
    return (game.a + game.e @ game.f / 2) / r, b, cost, own / r**2, s


def _constraint(game: Game, h: Matrix) -> Matrix:
    """`T` with `T'H T < 0` the order of play: (p, v) after u; or, where the gain answers v, what v has left then."""
    m, size = game.b.shape[1], len(h)
    t = np.vstack([np.zeros((m, size - m)), np.eye(size - m)])
    if game.injects:
        _log_det(h[:m, :m])
        t[:m] = -np.linalg.solve(h[:m, :m], h[:m, m:])
    return t


def evaluate(game: Game, logs: Vector, barrier: float) -> Saddle | None:
    """The saddle point at the log multipliers (`Lambda`, then `lambda_p`); None where they admit none.

    The goal is `log trace X - barrier log det(-T'H T / D)`, `D = diag(lambda_p, Lambda)`: the second term keeps
    the search off the edge of what is admissible, where the gradient of the first one leads.
    """
    try:
        with np.errstate(all="ignore"):
            return _saddle(game, logs, barrier)
    except np.linalg.LinAlgError:
        return None


def _saddle(game: Game, logs: Vector, barrier: float) -> Saddle:
    a, b, cost, own, s = _matrices(game, logs)
    m, q, size, n = game.b.shape[1], game.e.shape[1], len(own), len(a)
    inverse = np.linalg.solve(own, np.hstack((s.T, b.T)))
    x = _doubled(a - b @ inverse[:, :n], b @ inverse[:, n:], cost - s @ inverse[:, :n])
    _log_det(x)
    h, toward = own + b.T @ x @ b, b.T @ x @ a + s.T
    t = _constraint(game, h)
    room = -(t.T @ h @ t)  # the maximising players' curvature: positive, or no saddle exists
    goal = float(np.log(np.trace(x)) - barrier * (_log_det(room) - logs[:q].sum()))
    if size > m + q:
        goal += barrier * m * logs[q]
    saddle = -np.linalg.solve(h, toward)
    shadow = t @ np.linalg.solve(room, t.T)  # T (T'(-H)T)^{-1} T'
    reach = _summed(a + b @ saddle, np.eye(n) / np.trace(x) + barrier * (b @ shadow @ b.T))
    return Saddle(goal, _gradient(game, logs, barrier, saddle, reach, shadow), x, h, toward)


def _gradient(game: Game, logs: Vector, barrier: float, saddle: Matrix, reach: Matrix, shadow: Matrix) -> Vector:
    """The goal's, from the saddle point `(u, p, v)`, the loop's Gramian `reach` and `shadow` of `_saddle`."""
    m, q, size = game.b.shape[1], game.e.shape[1], len(saddle)
    u, p, v = saddle[:m], saddle[m : size - q], saddle[size - q :]
    move = (game.alpha, game.beta)[: 2 if len(p) else 1]
    z = game.f + game.g @ (game.alpha * u + (game.beta * p if len(p) else 0.0))  # what drives each neuron there
    fixed = np.hstack([factor * game.g for factor in move])
    flow = ((z @ reach) * z - (v @ reach) * v).sum(axis=1)
    still = ((fixed @ shadow[:-q, :-q]) * fixed).sum(axis=1) - shadow.diagonal()[size - q :]
    gradient = np.exp(logs[:q]) * (flow + barrier * still) / (2 * game.r**2) + barrier
    if not len(p):
        return gradient
    flow = np.trace(u @ reach @ u.T) - np.trace(p @ reach @ p.T)
    still = np.trace(shadow[:m, :m]) - np.trace(shadow[m : 2 * m, m : 2 * m])
    return np.append(gradient, np.exp(logs[q]) * (flow + barrier * still) / game.r**2 + m * barrier)


def descend(game: Game, logs: Vector, barrier: float, evaluations: int) -> Vector:
    """BFGS on the goal from admissible `logs`; a step to an inadmissible point is shortened. The best logs found."""
    at = evaluate(game, logs, barrier)
    metric, left = np.eye(len(logs)), evaluations
    while at is not None and left > 0:
        step = -(metric @ at.gradient)
        step = step * min(1.0, STRIDE / max(np.abs(step).max(), 1e-300))
        there = None
        while left > 0 and there is None and np.abs(step).max() > 1e-6:
            left -= 1
            there = evaluate(game, logs + step, barrier)
            if there is None or not there.goal < at.goal + 1e-4 * (step @ at.gradient):  # Armijo's condition
                there, step = None, step / 3
        if there is None:
            break
        logs, change, gained = logs + step, there.gradient - at.gradient, at.goal - there.goal
        if step @ change > 1e-12:  # BFGS's curvature condition: without it the metric would lose definiteness
            turn = np.eye(len(logs)) - np.outer(step, change) / (step @ change)
            metric = turn @ metric @ turn.T + np.outer(step, step) / (step @ change)
        at = there
        if gained < FLAT:
            break
    return logs
