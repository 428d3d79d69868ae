"""Tabulated equilibria of the controller's model over the range of the input. They are found by
matrices, or with neurons by interpolation between stored points.

With neurons `x = A x + B v + E w(x, v)` has no closed form. It has one solution for each v, since
the model contracts; of one input and one output they are a curve, of which the device stores some
points, joined by straight lines.
"""

from dataclasses import dataclass

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ssm_study.export.portable import PortableController, PortableNeurons, Vector, multiply_in_order
from ssm_study.models.structured import evaluate_activations
from ssm_study.systems import StructuredSystem

# On each side of rest: where the input's range is ten times that of a bend, a thousandth is missed.
PIECES = 32
LARGEST_RESIDUAL = 1e-9  # scaled states: what is left of x+ - x
Rows = Float[np.ndarray, "h r"]


@dataclass(frozen=True, kw_only=True)
class PiecewiseLinear:
    """Piecewise-linear map of a scalar to a vector. `out = slopes[j] w + offsets[j]`, j the count
    of `points <= w`.

    Beyond the ends the last line continues.
    """

    points: Vector
    slopes: Rows
    offsets: Rows

    @classmethod
    def from_points(cls, arguments: Vector, values: Rows) -> "PiecewiseLinear":
        """Construct the piecewise-linear map through given points."""
        order = np.argsort(arguments)
        arguments = arguments[order]
        values = values[order]
        steps = np.diff(arguments)[:, None]
        slopes = np.diff(values, axis=0) / steps
        starts = arguments[:-1, None]
        offsets = values[:-1] - slopes * starts
        points = arguments[1:-1].copy()
        return cls(points=points, slopes=slopes, offsets=offsets)

    def __call__(self, w: Vector) -> Vector:
        """Value of the piecewise-linear map at a scalar argument."""
        j = int((self.points <= w[0]).sum())
        return self.slopes[j] * w[0] + self.offsets[j]


def evaluate_equilibrium_map(
    equilibrium_map: "PiecewiseLinear | Float[np.ndarray, 'r c']", argument: Vector
) -> Vector:
    """Value of a map from set points to equilibria, given as a matrix or as a piecewise-linear map.
    The product is in the order of the C code."""
    if isinstance(equilibrium_map, PiecewiseLinear):
        return equilibrium_map(argument)
    return multiply_in_order(equilibrium_map, argument)


@dataclass(frozen=True, kw_only=True)
class EquilibriumCurve:
    """Equilibria of a model with neurons, ordered by the value of the mapped input.

    For each of `lifted (h,)`: states `x (h, n)`, and the arguments of S_y, `read (h,)`.

    `read` rises or falls throughout.
    """

    lifted: Vector
    x: Rows
    read: Vector


def compute_equilibrium_curve(
    controller: PortableController, lowest_input: float, highest_input: float
) -> EquilibriumCurve | None:
    """Equilibria of a model with neurons over a range of values of the mapped input; None where
    they are not unique or not found.

    None where two of them share an output, or one is not found.
    """
    model = controller.recurrence()
    neurons = controller.neurons
    if not isinstance(model, StructuredSystem) or neurons is None:
        return None
    if model.d.shape != (1, 1):
        return None
    states: dict[float, Vector] = {}
    for end in (lowest_input, highest_input):
        if end == 0.0:
            continue
        near = np.zeros(model.order)  # each side begins at rest
        for v in np.linspace(0.0, end, 2 * PIECES + 1):
            x = _find_equilibrium(model, neurons, v, near)
            if x is None:
                return None
            states[float(v)] = x
            near = x
    lifted = np.array(sorted(states))
    x = np.array([states[v] for v in lifted])
    z = x @ model.f.T + lifted[:, None] * model.g.T + neurons.bias
    w = evaluate_activations(neurons.kinds, z) - neurons.phi_bias
    read = x @ model.c[0] + lifted * model.d[0, 0] + w @ model.h[0]
    apart = np.diff(read)
    rises = (apart > 0).all()
    falls = (apart < 0).all()
    if not rises and not falls:
        return None
    return EquilibriumCurve(lifted=lifted, x=x, read=read)


def _find_equilibrium(
    model: StructuredSystem, neurons: PortableNeurons, mapped_input: float, start: Vector
) -> Vector | None:
    """Equilibrium state of a model with neurons for one value of the mapped input; None if none is
    found."""

    def equilibrium_residual(x: Vector) -> tuple[Vector, Float[np.ndarray, "n n"]]:
        """Difference between the next state of the model and its present state, with the Jacobian
        of this difference."""
        z = model.f @ x + model.g[:, 0] * mapped_input + neurons.bias
        w = evaluate_activations(neurons.kinds, z) - neurons.phi_bias
        slopes = evaluate_activations(neurons.kinds, z, "slope")
        tangent = model.linearise_at_slopes(slopes)
        following = model.a @ x + model.b[:, 0] * mapped_input + model.e @ w
        jacobian = tangent.a - np.eye(len(x))
        return following - x, jacobian

    solved = scipy.optimize.root(equilibrium_residual, start, jac=True, tol=1e-12)
    # At a kink it ends without success, and exactly there.
    residuals = np.abs(solved.fun)
    is_solved = residuals.max(initial=0.0) <= LARGEST_RESIDUAL
    return solved.x if is_solved else None
