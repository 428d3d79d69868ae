"""The game Riccati equation of a structured model and the search over its multipliers.

The equation, its conditions and its gradient: `theorems.structured_riccati`; doubling: Chu, Fan, Lin & Wang 2004.
Its loops are compiled, with the eliminations of small matrices written out; the rest is NumPy, which takes 0.1 ms more
an evaluation and saves the compiler most of half a minute.
"""

from dataclasses import dataclass
from functools import cached_property
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


@dataclass(frozen=True, kw_only=True)
class Game:
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

    @cached_property
    def moved(self) -> Matrix:
        """How u, and p where the ball has a radius, enter the neurons."""
        return np.hstack([self.alpha * self.g, self.beta * self.g][: 1 + (self.beta > 0)])

    @cached_property
    def loop(self) -> tuple[Matrix, Matrix]:
        """`A` and `B` of the equation, inputs `(u, p, v)`: `w = (z + v) / 2`, so half of each neuron is linear."""
        drive, half = self.b + self.e @ self.g / 2, self.e / 2
        moves = [self.alpha * drive, self.beta * drive][: 1 + (self.beta > 0)]
        return (self.a + half @ self.f) / self.r, np.hstack([*moves, half]) / self.r


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


def _costs(game: Game, logs: Vector) -> tuple[Matrix, Matrix, Matrix]:
    """`Q, R, S` of the equation, inputs `(u, p, v)`, at these log multipliers."""
    (n, m), q, inputs = game.b.shape, len(game.f), game.moved.shape[1]
    weights = np.exp(logs[:q])
    scaled = game.f.T * (weights / 2)
    own, s = np.zeros((inputs + q, inputs + q)), np.zeros((n, inputs + q))
    own[:inputs, :inputs], s[:, :inputs] = game.moved.T * (weights / 2) @ game.moved, scaled @ game.moved
    bound = float(np.exp(logs[q])) if inputs > m else 0.0  # lambda_p: |p|^2 <= |u|^2
    diagonal = own.reshape(-1)[:: inputs + q + 1]
    diagonal[:m] += game.input_weight + bound
    diagonal[m:inputs] -= bound
    diagonal[inputs:] = weights / -2  # |v_i| <= |z_i|, by Lambda
    return (game.state_weight + scaled @ game.f) / game.r**2, own / game.r**2, s / game.r**2


def _constraint(game: Game, h: Matrix) -> Matrix:
    """`T` with `T'H T < 0` the order of play: (p, v) after u; or, where the gain answers v, v, then u, then p."""
    m, inputs = game.b.shape[1], len(h) - len(game.f)
    t = np.eye(len(h))[:, m:]
    if game.injects:
        _log_det(h[:m, :m])
        t[:inputs, inputs - m :] = -np.linalg.solve(h[:inputs, :inputs], h[:inputs, inputs:])
    return t


def _log_det(matrix: Matrix) -> float:
    """Raises `LinAlgError` unless positive definite."""
    return 2.0 * float(np.log(np.diagonal(np.linalg.cholesky(matrix))).sum())


def _saddle(game: Game, logs: Vector, barrier: float) -> Saddle:
    """As `evaluate`; raises `LinAlgError` where there is none."""
    (a, b), (cost, own, s) = game.loop, _costs(game, logs)
    (n, m), q = game.b.shape, len(game.f)
    inverse = np.linalg.solve(own, np.hstack([s.T, b.T]))
    x = _doubled(a - b @ inverse[:, :n], b @ inverse[:, n:], cost - s @ inverse[:, :n])
    _log_det(x)
    into = b.T @ x
    h, toward = own + into @ b, into @ a + s.T
    t = _constraint(game, h)
    room = -t.T @ h @ t  # the maximising players' curvature: positive, or no saddle exists
    goal = np.log(np.trace(x)) - barrier * (_log_det(room) - logs[:q].sum() - m * logs[q:].sum())
    saddle = -np.linalg.solve(h, toward)
    shadow = t @ np.linalg.solve(room, t.T)  # T (T'(-H)T)^{-1} T'
    reach = _summed(a + b @ saddle, np.eye(n) / np.trace(x) + barrier * b @ shadow @ b.T)
    return Saddle(float(goal), _gradient(game, logs, barrier, saddle, reach, shadow), x, h, toward)


def _gradient(game: Game, logs: Vector, barrier: float, saddle: Matrix, reach: Matrix, shadow: Matrix) -> Vector:
    """The goal's, from the saddle point `(u, p, v)`, the loop's Gramian `reach` and `shadow` of `_saddle`."""
    m, moved = game.b.shape[1], game.moved
    (q, inputs), still = moved.shape, np.diagonal(shadow)
    z, v = game.f + moved @ saddle[:inputs], saddle[inputs:]  # what drives each neuron there
    flow = (z @ reach * z - v @ reach * v).sum(axis=1)
    held = (moved @ shadow[:inputs, :inputs] * moved).sum(axis=1) - still[inputs:]
    # At a saddle point the players' own changes count only in second order: the multipliers act on the cost alone.
    gradient = np.exp(logs) * np.append((flow + barrier * held) / 2, np.zeros(len(logs) - q)) / game.r**2 + barrier
    if inputs > m:
        size = (saddle[:inputs] @ reach * saddle[:inputs]).sum(axis=1) + barrier * still[:inputs]
        gradient[q] = np.exp(logs[q]) * (size[:m].sum() - size[m:].sum()) / game.r**2 + m * barrier
    return np.asarray(gradient)


def evaluate(game: Game, logs: Vector, barrier: float) -> Saddle:
    """The saddle point at the log multipliers (`Lambda`, then `lambda_p`); its goal is infinite where they admit none.

    The goal is `log trace X - barrier log det(-T'H T / D)`, `D = diag(lambda_p, Lambda)`: the second term keeps
    the search off the edge of what is admissible, where the gradient of the first one leads.
    """
    try:
        with np.errstate(all="ignore"):
            found = _saddle(game, logs, barrier)
    except (np.linalg.LinAlgError, ArithmeticError):
        none = np.empty((0, 0))
        found = Saddle(np.inf, np.empty(0), none, none, none)
    return found


def descend(game: Game, logs: Vector, barrier: float, evaluations: int) -> Vector:
    """BFGS on the goal from admissible `logs`; a step to an inadmissible point is shortened. The best logs found."""
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
