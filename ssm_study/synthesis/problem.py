"""What every method solves: Theorem 1's inequality for one pair; Theorem 2's is the same for the transposed pair.

Source: [Z26], with the corrections of docs/theory.md.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import JacobianBall


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Find `K` and `P` such that `A + B J K` contracts by `r = sqrt(1 - rate)` for every `J` of the ball.

    Shapes: `a (n, n)`, `b (n, m)`; weights of the cost `x^T state_weight x + u^T input_weight u`, symmetric:
    `state_weight (n, n) >= 0`, `input_weight > 0`. Raises `BadRequest` for a rate outside (0, 1), matrices that are not
    finite, or a ball that holds zero.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    ball: JacobianBall
    rate: float
    state_weight: Float[np.ndarray, "n n"]
    input_weight: float

    def __post_init__(self) -> None:
        require(bool(0 < self.rate < 1), "rate", self.rate, "a contraction rate lies in (0, 1)", "try 0.1")
        finite = all(np.isfinite(m).all() for m in (self.a, self.b, self.state_weight))
        require(bool(finite), "a, b", "NaN or infinity", "the matrices are not finite", "identify the model again")
        require(bool(self.input_weight > 0), "input_weight", self.input_weight, "must be positive", "try 1")
        require(
            bool(abs(self.ball.alpha) > self.ball.beta),
            "slopes",
            (self.ball.lower, self.ball.upper),
            "the ball holds zero, so no input is certain to act",
            "constrain the slopes (model.slope_lower > 0)",
        )

    @property
    def contraction(self) -> float:
        """`r`."""
        return float(np.sqrt(1 - self.rate))

    @property
    def a_hat(self) -> Float[np.ndarray, "n n"]:
        return self.a / self.contraction

    @property
    def b_hat(self) -> Float[np.ndarray, "n m"]:
        return self.b / self.contraction


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Matrices of Theorem 1 as a method found them, not yet verified: `p, y (n, n)`, `k (m, n)`, `sigma`."""

    p: Float[np.ndarray, "n n"]
    y: Float[np.ndarray, "n n"]
    k: Float[np.ndarray, "m n"]
    sigma: float
    status: str


class NoSolution(Exception):
    """A method ended without matrices; the message says what the solver reported. Information, not a verdict."""


def theorem_matrix(
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n m"],
    ball: JacobianBall,
    rate: float,
    solution: Solution,
) -> Float[np.ndarray, "s s"]:
    """Theorem 1's block matrix in floats, scaled to a unit diagonal where the diagonal is positive."""
    p, y, sigma = solution.p, solution.y, solution.sigma
    n, m = b.shape
    x = solution.k @ y
    coupling, border = a @ y + ball.alpha * b @ x, ball.beta * x.T
    matrix = np.block(
        [
            [(1 - rate) * p - sigma * b @ b.T, coupling, np.zeros((n, m))],
            [coupling.T, y + y.T - p, border],
            [np.zeros((m, n)), border.T, sigma * np.eye(m)],
        ]
    )
    return unit_diagonal(matrix)


def unit_diagonal(matrix: Float[np.ndarray, "s s"]) -> Float[np.ndarray, "s s"]:
    """`D M D` with `D = diag(|M_ii|)^(-1/2)`: what definiteness and conditioning mean whatever the units."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diagonal(matrix)), np.finfo(float).tiny))
    scaled = scale[:, None] * matrix * scale
    return (scaled + scaled.T) / 2


def margin(matrix: Float[np.ndarray, "s s"]) -> float:
    """Smallest eigenvalue; of a matrix scaled to unit diagonal, between minus infinity and one."""
    return float(np.linalg.eigvalsh(matrix)[0])


def condition(matrix: Float[np.ndarray, "n n"]) -> float:
    """Condition number after scaling to a unit diagonal, which is what rounding sees."""
    return float(np.linalg.cond(unit_diagonal(matrix)))
