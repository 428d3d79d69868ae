"""One sampling period of a smooth plant: classical Runge-Kutta, all cases at once."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Rate = Callable[[Float[np.ndarray, "N n"]], Float[np.ndarray, "N n"]]


def runge_kutta(
    rate: Rate, x: Float[np.ndarray, "N n"], step_s: float, substeps: int
) -> Float[np.ndarray, "N n"]:
    """`x(t + step_s)` of `dx/dt = rate(x)` in `substeps` steps, fourth order where the rate is
    smooth."""
    h = step_s / substeps
    for _ in range(substeps):
        a = rate(x)
        b = rate(x + 0.5 * h * a)
        c = rate(x + 0.5 * h * b)
        d = rate(x + h * c)
        x = x + (h / 6.0) * (a + 2.0 * b + 2.0 * c + d)  # Simpson weights
    return x
