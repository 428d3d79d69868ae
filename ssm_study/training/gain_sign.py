"""Training penalty that gives a model of an integrating plant a gain of the same sign at all slopes
of its neurons.

Behind an integrator the rate `y[k+1] - y[k]` has to answer the input with one sign at every slope,
or no feedback stabilises all of them and nothing can be certified. A model of a motor that stands
still at small inputs fits as well with a gain that is slightly turned round at rest.

At slopes `s` in {0, 1}^q the gain is `g(s) = C (I - A - E diag(s) F)^{-1} B`. It is a ratio of two
functions that are linear in each slope, and the lower one is positive wherever the model contracts.
So `g` has one sign at all slopes if it has at these corners. Source: docs/models.md, "A gain of one
sign".
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Float, Shaped

from ssm_study.models.structured_kernel import KernelMatrices

WEIGHT = 2.0  # of a missing share, in units of the training error
MOST_NEURONS = 8  # 256 corners
DIFFERENCE = 1e-6  # of a parameter, for the derivatives of few residuals


def gains_at_extreme_slopes(matrices: KernelMatrices) -> Float[np.ndarray, "corners"]:
    """Steady-state gain of a model at each combination of extreme neuron slopes, for one input and
    one output."""
    n = len(matrices.a)
    q = matrices.e.shape[1]
    corners = product((0.0, 1.0), repeat=q)
    corner_list = list(corners)
    slopes = np.array(corner_list).reshape(2**q, q)
    slope_rows = slopes[:, None, :]
    through_neurons = (matrices.e * slope_rows) @ matrices.f
    recurrences = matrices.a + through_neurons
    corner_count = len(slopes)
    b = np.broadcast_to(matrices.b, (corner_count, *matrices.b.shape))
    identity = np.eye(n)
    states = np.linalg.solve(identity - recurrences, b)
    gains = matrices.c @ states
    return gains[:, 0, 0]


def gain_shortfall(matrices: KernelMatrices, least_fraction: float) -> Float[np.ndarray, "corners"]:
    """Amount by which a model's gain, at each combination of extreme neuron slopes, falls short of
    a share of the largest gain."""
    with np.errstate(all="ignore"):
        gains = gains_at_extreme_slopes(matrices)
    largest_index = np.argmax(np.abs(gains))
    largest = gains[largest_index]
    is_finite = np.isfinite(gains)
    if not is_finite.all() or largest == 0.0:
        return np.zeros(len(gains))
    shortfall = least_fraction - gains / largest
    return WEIGHT * np.maximum(shortfall, 0.0)


def jacobian_by_differences(
    residuals: Callable[[Float[np.ndarray, "P"]], Float[np.ndarray, "V"]],
    flat: Float[np.ndarray, "P"],
    current: Float[np.ndarray, "V"],
    moving_indices: Shaped[np.ndarray, "M"],
) -> Float[np.ndarray, "V P"]:
    """Jacobian of a residual vector with respect to some of its parameters, by central
    differences."""
    residual_count = len(current)
    parameter_count = len(flat)
    slopes = np.zeros((residual_count, parameter_count))
    for i in moving_indices:
        step = np.zeros(len(flat))
        step[i] = DIFFERENCE
        ahead = residuals(flat + step)
        behind = residuals(flat - step)
        slopes[:, i] = (ahead - behind) / (2.0 * DIFFERENCE)
    return slopes
