"""The game Riccati equation of a structured model and the search over its multipliers.

One evaluation is compiled (`game_kernel`). Source: docs/theory.md, "With neurons"; the equation: `structured_riccati`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ssm_study.synthesis.game_kernel import saddle_point

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "_"]
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
        return np.ascontiguousarray(np.hstack([self.alpha * self.g, self.beta * self.g][: 1 + (self.beta > 0)]))

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


def evaluate(game: Game, logs: Vector, barrier: float) -> Saddle:
    """The saddle point at the log multipliers (`Lambda`, then `lambda_p`); its goal is infinite where they admit none.

    The goal is `log trace X - barrier log det(-T'H T / D)`, `D = diag(lambda_p, Lambda)`: the second term keeps
    the search off the edge of what is admissible, where the gradient of the first one leads.
    """
    (a, b), scaled = game.loop, (game.f, game.moved, game.state_weight, game.input_weight)
    try:
        found = Saddle(*saddle_point(a, b, *scaled, game.b.shape[1], game.r, game.injects, logs, barrier))
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
