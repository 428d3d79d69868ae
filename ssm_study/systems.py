"""The systems everyone shares: a discrete-time linear state space, and a ball of Jacobians."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class StateSpace:
    """`x+ = a x + b u,  y = c x + d u` in discrete time.

    Shapes: `a (n, n)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, real. Raises `BadRequest` for entries that are not finite.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]

    def __post_init__(self) -> None:
        for label, matrix in (("a", self.a), ("b", self.b), ("c", self.c), ("d", self.d)):
            require(
                bool(np.isfinite(matrix).all()),
                label,
                "NaN or infinity",
                "the matrix is not finite",
                "identify the model again",
            )

    @property
    def order(self) -> int:
        return self.a.shape[0]

    @property
    def spectral_radius(self) -> float:
        return float(np.abs(np.linalg.eigvals(self.a)).max())

    def simulate(
        self, u: Float[np.ndarray, "*batch T m"], x0: Float[np.ndarray, "*batch n"] | None = None
    ) -> tuple[Float[np.ndarray, "*batch T p"], Float[np.ndarray, "*batch n"]]:
        """Step through `u` from `x0` (default 0); returns the outputs and the state after the last sample."""
        batch, samples = u.shape[:-2], u.shape[-2]
        x = np.zeros((*batch, self.order)) if x0 is None else x0
        states, forced, turn = np.empty((*batch, samples, self.order)), u @ self.b.T, self.a.T
        for k in range(samples):
            states[..., k, :] = x
            x = x @ turn + forced[..., k, :]
        return states @ self.c.T + u @ self.d.T, x


@dataclass(frozen=True, kw_only=True)
class JacobianBall:
    """All Jacobians `J = alpha I + beta Delta`, `||Delta||_2 <= 1`: what the theorems really need of a scaffolding.

    `alpha` keeps its sign; for a scalar map with slopes in `[mu, nu]`, `alpha = (nu + mu)/2`, `beta = (nu - mu)/2`.
    Source: THEORY section 3; [Z26] Theorems 1 and 2 use the singular values, which is not enough.
    """

    alpha: float
    beta: float

    def __post_init__(self) -> None:
        require(
            np.isfinite(self.alpha) and np.isfinite(self.beta) and self.beta >= 0,
            "alpha, beta",
            (self.alpha, self.beta),
            "a ball needs a finite centre and a finite radius >= 0",
            "bound the scaffolding again",
        )

    @classmethod
    def from_slopes(cls, lower: float, upper: float) -> "JacobianBall":
        require(lower <= upper, "slopes", (lower, upper), "lower exceeds upper", "swap them")
        return cls(alpha=(upper + lower) / 2, beta=(upper - lower) / 2)

    @property
    def lower(self) -> float:
        return self.alpha - self.beta

    @property
    def upper(self) -> float:
        return self.alpha + self.beta

    @property
    def relative_radius(self) -> float:
        """`beta / |alpha|`: what the exact frontier is stated in."""
        return float("inf") if self.alpha == 0 else self.beta / abs(self.alpha)
