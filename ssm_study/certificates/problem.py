"""Synthesis problem that every design method solves: the matrix inequality of a state feedback
(Theorem 1), or of an observer (Theorem 2) as the dual.

Source: [Z26], with the corrections of docs/theory.md.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import JacobianBall, System

# Each matrix of a system, and the one that stands, transposed, in its place in the dual system.
Square = Float[np.ndarray, "n n"]
InputMatrix = Float[np.ndarray, "n m"]

DUAL = {"a": "a", "b": "c", "c": "b", "d": "d", "e": "f", "f": "e", "g": "h", "h": "g"}


def dual_system(system: System) -> System:
    """Dual (transposed) system, by which an observer is designed in the same way as a state
    feedback. `(A^T, C^T, B^T, D^T)`, and of neurons `(F^T, E^T, H^T, G^T)`: its state feedback is
    the observer, transposed."""
    turned = {name: np.ascontiguousarray(getattr(system, DUAL[name]).T) for name in vars(system)}
    return type(system)(**turned)


@dataclass(frozen=True, kw_only=True)
class Neurons:
    """Matrices of the neurons in a synthesis problem, which stand inside the model's recurrence. `w
    = phi(z) - phi(bias)` with slopes in [0, 1], beside the `a, b` of a problem; for an observer,
    the neurons of the dual system."""

    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    g: Float[np.ndarray, "q m"]
    observes: bool

    @property
    def allows_injection(self) -> bool:
        """Whether an observer may inject the output error into the neurons of the model."""
        return self.observes and not self.g.any()

    @property
    def neuron_scales(self) -> Float[np.ndarray, "q"]:
        """Scale factor of each neuron that makes the neuron's input and output weights equal in
        size. Powers of two `d` that make `|e_i| / d_i` and `d_i |f_i|` alike, since trained neurons
        differ by many decades."""
        into = np.linalg.norm(self.e, axis=0)
        input_norms = np.linalg.norm(self.f, axis=1)
        ratio = np.divide(
            into, input_norms, out=np.ones_like(into), where=(into > 0) & (input_norms > 0)
        )
        return np.exp2(np.round(np.log2(ratio) / 2))

    def in_balanced_units(self) -> "Neurons":
        """Copy of the neurons, scaled so that their input and output weights are of equal size."""
        d = self.neuron_scales
        return Neurons(
            e=self.e / d, f=self.f * d[:, None], g=self.g * d[:, None], observes=self.observes
        )


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Data of the synthesis problem of one gain and its contraction metric. Find `K` and `P` such
    that `A + B J K` contracts by `r = sqrt(1 - rate)` for every `J` of the ball.

    Shapes: `a (n, n)`, `b (n, m)`; weights of the cost `x^T state_weight x + u^T input_weight u`,
    symmetric: `state_weight (n, n) >= 0`, `input_weight > 0`. Raises `BadRequest` for a rate
    outside (0, 1) or matrices that are not finite. A ball that holds zero admits analysis only:
    `design.DesignAttempt` refuses it.
    """

    a: Square
    b: InputMatrix
    ball: JacobianBall
    rate: float
    state_weight: Square
    input_weight: float
    neurons: Neurons | None = None

    def __post_init__(self) -> None:
        require(
            bool(0 < self.rate < 1),
            "rate",
            self.rate,
            "a contraction rate lies in (0, 1)",
            "try 0.1",
        )
        finite = all(np.isfinite(m).all() for m in (self.a, self.b, self.state_weight))
        require(
            bool(finite),
            "a, b",
            "NaN or infinity",
            "the matrices are not finite",
            "identify the model again",
        )
        require(
            bool(self.input_weight > 0),
            "input_weight",
            self.input_weight,
            "must be positive",
            "try 1",
        )

    @property
    def contraction_factor(self) -> float:
        """Contraction factor per sample, `sqrt(1 - rate)`."""
        return float(np.sqrt(1 - self.rate))

    @property
    def a_hat(self) -> Square:
        """State matrix divided by the contraction factor."""
        return self.a / self.contraction_factor

    @property
    def b_hat(self) -> InputMatrix:
        """Input matrix divided by the contraction factor."""
        return self.b / self.contraction_factor

    @property
    def required_neurons(self) -> Neurons:
        """Neurons of a synthesis problem; raises `ValueError` for a problem without neurons."""
        if self.neurons is None:
            raise ValueError("this problem has no neurons")
        return self.neurons

    def at_rate(self, rate: float) -> "Problem":
        """Copy of a synthesis problem with another contraction rate."""
        return replace(self, rate=rate)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Gain and contraction metric that a synthesis method returns, not yet verified. Symbols of
    Theorem 1: `p, y (n, n)`, `k (m, n)`, `sigma`.

    With neurons also their `multipliers (q,)`, the diagonal of Lambda, and `k_w (m, q)`, what an
    observer injects; `logs` is where a search over multipliers ended.
    """

    p: Square
    y: Square
    k: Float[np.ndarray, "m n"]
    sigma: float
    status: str
    multipliers: Float[np.ndarray, "q"] | None = None
    k_w: Float[np.ndarray, "m q"] | None = None
    logs: Float[np.ndarray, "s"] | None = None

    def undo_neuron_scaling(self, neurons: Neurons) -> "Solution":
        """Convert a solution's multipliers and its observer gain at the neurons to the units of the
        unscaled neurons."""
        assert self.multipliers is not None
        assert self.k_w is not None
        d = neurons.neuron_scales
        weights = self.multipliers * (d**-2 if neurons.observes else d**2)
        return replace(self, multipliers=weights, k_w=self.k_w * d)


def symmetric_part(matrix: Square) -> Square:
    """Symmetric part of a matrix, by which rounding errors are removed."""
    return (matrix + matrix.T) / 2


class NoSolution(Exception):
    """Error raised when a synthesis method ends without finding a gain. The message is the
    solver's; it is information, not a verdict."""


@contextmanager
def linear_algebra_failures_as_no_solution() -> Iterator[None]:
    """Context manager that turns a failure of linear algebra into the error `NoSolution`."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise NoSolution(f"the numbers exceed floating point: {error}") from error
