"""Linear and structured state-space systems, balls of Jacobians, and controller gains. The systems
everyone shares: a discrete-time linear state space, balls of Jacobians, a pair of gains."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ssm_study.refusal import BadRequest, require

AGAIN = "write model.json again"


class _SystemMatrices:
    """Base class of state-space systems, which checks that all matrices are finite."""

    a: Float[np.ndarray, "n n"]

    def __post_init__(self) -> None:
        wrong = [name for name, matrix in vars(self).items() if not np.isfinite(matrix).all()]
        require(
            not wrong,
            ", ".join(wrong),
            "NaN or infinity",
            "is not finite",
            "identify the model again",
        )

    @property
    def order(self) -> int:
        """Order of the system, that is, the number of its states."""
        return self.a.shape[0]


@dataclass(frozen=True, kw_only=True)
class StateSpace(_SystemMatrices):
    """Linear discrete-time state-space system. `x+ = a x + b u, y = c x + d u`.

    Shapes: `a (n, n)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, real. Raises `BadRequest` for entries
    that are not finite.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]

    @property
    def spectral_radius(self) -> float:
        """Spectral radius of the state matrix; below one, the system is stable."""
        return spectral_radius(self.a)

    @property
    def integrates(self) -> bool:
        """Whether the state matrix has an eigenvalue at one, so that the system integrates its
        input."""
        return bool(np.linalg.matrix_rank(np.eye(self.order) - self.a) < self.order)

    def equilibrium_basis(
        self,
    ) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "m r"], Float[np.ndarray, "p r"]]:
        """Basis of all equilibria of a linear system: the states, inputs and outputs that can stay
        constant. `X = A X + B V` and `C X + D V`.

        `V = I` and `r = m`, one for each constant input, unless the model integrates.
        """
        left = np.eye(self.order) - self.a
        if self.integrates:
            from scipy.linalg import null_space  # slow to load

            x, v = np.split(null_space(np.hstack([left, -self.b])), [self.order])
        else:
            x = np.linalg.solve(left, self.b)
            v = np.eye(self.b.shape[1])
        return x, v, self.c @ x + self.d @ v

    def simulate(
        self, u: Float[np.ndarray, "*batch T m"], x0: Float[np.ndarray, "*batch n"] | None = None
    ) -> tuple[Float[np.ndarray, "*batch T p"], Float[np.ndarray, "*batch n"]]:
        """Simulate a linear system for a sequence of inputs, and return the outputs and the final
        state. The initial state is zero by default."""
        batch = u.shape[:-2]
        samples = u.shape[-2]
        x = np.zeros((*batch, self.order)) if x0 is None else x0
        states = np.empty((*batch, samples, self.order))
        forced = u @ self.b.T
        turn = self.a.T
        for k in range(samples):
            states[..., k, :] = x
            x = x @ turn + forced[..., k, :]
        return states @ self.c.T + u @ self.d.T, x

    def impulse_response_length(
        self, max_samples: int = 4000, remaining_fraction: float = 0.1
    ) -> int:
        """Number of samples after which only a given fraction of the impulse response remains. At
        most `max_samples` samples; the share is `remaining_fraction` of `sum |C A^k B|`.

        By default the bulk of it, not the tail of a mode that no record filled. One run for each
        input, since the answers to several at once may cancel.
        """
        impulses = np.eye(max_samples, 1) * np.eye(self.b.shape[1])[:, None, :]
        size = np.abs(self.simulate(impulses)[0]).sum(axis=(0, 2))
        left = 1 - np.cumsum(size) / max(float(size.sum()), np.finfo(float).tiny)
        return int(np.argmax(left <= remaining_fraction)) + 1


@dataclass(frozen=True, kw_only=True)
class StructuredSystem(_SystemMatrices):
    """State-space system with neurons inside its recurrence. `x+ = a x + b v + e w,  y = c x + d v
    + h w,  w = phi(f x + g v + bias) - phi(bias)`, slopes of phi in [0, 1].

    What the theorems need of a structured model: the neurons act one by one and are known by their
    slopes alone. Shapes: `a (n, n)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, `e (n, q)`, `f (q, n)`, `g
    (q, m)`, `h (p, q)`, real. With `q = 0` it is `StateSpace`. Raises `BadRequest` for entries that
    are not finite. Source: Revay, Wang & Manchester 2024 (REN with `D11 = 0`).
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]
    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    g: Float[np.ndarray, "q m"]
    h: Float[np.ndarray, "p q"]

    @property
    def neurons(self) -> int:
        """Number of neurons inside the recurrence of the system."""
        return self.e.shape[1]

    def slope_corners(self, max_neurons: int = 10) -> Float[np.ndarray, "k q"]:
        """Combinations of neuron slopes zero and one, one combination per row. All of them for up
        to `max_neurons` neurons; for more, those with at most one slope unlike the others."""
        q = self.neurons
        if q <= max_neurons:
            return np.array(list(product((0.0, 1.0), repeat=q))).reshape(-1, q)
        return np.vstack([np.zeros(q), np.ones(q), np.eye(q), 1 - np.eye(q)])

    def linearise_at_slopes(self, slopes: Float[np.ndarray, "q"]) -> StateSpace:
        """Linear system in which each neuron is replaced by a constant gain, its slope."""
        driven = self.e * slopes
        output_slopes = self.h * slopes
        a = self.a + driven @ self.f
        b = self.b + driven @ self.g
        return StateSpace(
            a=a, b=b, c=self.c + output_slopes @ self.f, d=self.d + output_slopes @ self.g
        )


System = StateSpace | StructuredSystem


@dataclass(frozen=True, kw_only=True)
class JacobianBall:
    """Ball of matrices that contains every Jacobian of a static map. `J = alpha I + beta Delta`,
    `||Delta||_2 <= 1`: all that the theorems need of the map.

    `alpha` keeps its sign; for a scalar map with slopes in `[mu, nu]`, `alpha = (nu + mu)/2`, `beta
    = (nu - mu)/2`. Source: docs/theory.md, "The ball of Jacobians"; [Z26] has singular values,
    which are not enough.
    """

    alpha: float
    beta: float

    def __post_init__(self) -> None:
        sound = np.isfinite(self.alpha) and 0 <= self.beta < np.inf
        requirement = "needs a finite centre and radius >= 0"
        require(
            sound,
            "alpha, beta",
            (self.alpha, self.beta),
            requirement,
            "compute the slope bounds again",
        )

    @classmethod
    def from_slopes(cls, lower: float, upper: float) -> "JacobianBall":
        """Ball of Jacobians of a scalar map from its smallest and largest slope."""
        require(lower <= upper, "slopes", (lower, upper), "lower exceeds upper", "swap them")
        return cls(alpha=(upper + lower) / 2, beta=(upper - lower) / 2)

    @property
    def lower(self) -> float:
        """Smallest slope of a scalar static map: the centre minus the radius of its slope range."""
        return self.alpha - self.beta

    @property
    def upper(self) -> float:
        """Largest slope that a ball of Jacobians allows for a scalar static map."""
        return self.alpha + self.beta

    @property
    def relative_radius(self) -> float:
        """Radius of the ball of Jacobians, divided by the size of its centre."""
        return float("inf") if self.alpha == 0 else self.beta / abs(self.alpha)


@dataclass(frozen=True, kw_only=True)
class JacobianBalls:
    """Two balls of matrices that contain all Jacobians of a model's input map and of its output
    map. `input` contains the Jacobians of `S_u`, `output` those of `S_y`."""

    input: JacobianBall
    output: JacobianBall


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Gains of a state-feedback controller with its observer. `u = K xh, xh+ = A xh + B S_u(u) + L
    (yh - y)`, scaled; many, if batched.

    `s` is the model's order, and that of an internal model `z+ = internal z + error_input_matrix(y
    - y*)` where there is one: None
    stands for integrators. Of a structured model `l_z` injects `L_z (yh - y)` into the neurons as
    well.
    """

    k: Float[np.ndarray, "*pairs m s"]
    l: Float[np.ndarray, "*pairs n p"]  # noqa: E741 - the paper's letter
    l_z: Float[np.ndarray, "*pairs q p"] | None = None
    internal: Float[np.ndarray, "z z"] | None = None  # one for all pairs

    @property
    def modes(self) -> Float[np.ndarray, "z z"]:
        """State matrix of the controller's internal model, of size zero if there is none."""
        return (
            np.eye(self.k.shape[-1] - self.l.shape[-2]) if self.internal is None else self.internal
        )

    @property
    def matrices_by_symbol(self) -> dict[str, Float[np.ndarray, "*pairs r c"]]:
        """Gain matrices of controller and observer, keyed by symbol, without those that are
        absent."""
        matrices = {"k": self.k, "l": self.l, "l_z": self.l_z}
        return {symbol: matrix for symbol, matrix in matrices.items() if matrix is not None}

    def select_pairs(self, indices: int | Int[np.ndarray, "N"]) -> "Gains":
        """Select one controller with its observer, or several, from a stack of gains."""
        l_z = None if self.l_z is None else self.l_z[indices]
        return Gains(k=self.k[indices], l=self.l[indices], l_z=l_z, internal=self.internal)


def spectral_radius(matrix: Float[np.ndarray, "n n"]) -> float:
    """Largest modulus of the eigenvalues of a matrix."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def error_input_matrix(modes: Float[np.ndarray, "z z"], outputs: int) -> Float[np.ndarray, "z p"]:
    """Input matrix through which the control error drives the controller's internal model. Each
    output enters all states of its own copy alike."""
    return np.tile(np.eye(outputs), (len(modes) // outputs, 1))


def stopped_integrator_matrix(modes: Float[np.ndarray, "z z"]) -> Float[np.ndarray, "z z"]:
    """State matrix of the controller's internal model while its integrators are stopped because an
    input limit is active. Integrators (ones on the diagonal) hold their state, oscillators go
    on."""
    return np.where(np.diagonal(modes)[:, None] == 1, np.eye(len(modes)), modes)


def array_from_json(data: Mapping[str, Any], key: str, dimensions: int) -> Float[np.ndarray, "..."]:
    """Read a finite array with a given number of dimensions from JSON data. Raises `BadRequest` for
    any other entry `data[key]`."""
    require(key in data, key, "missing", "the stored model lacks this entry", AGAIN)
    try:
        values = np.asarray(data[key], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(key, data[key], "not a rectangular array of numbers", AGAIN) from error
    if values.size == 0 and values.ndim < dimensions:  # JSON keeps no shape of an empty array
        values = values.reshape((0,) * dimensions)
    sound = values.ndim == dimensions
    problem = f"expected a finite array of {dimensions} dimension(s)"
    require(sound and bool(np.isfinite(values).all()), key, f"shape {values.shape}", problem, AGAIN)
    return values
