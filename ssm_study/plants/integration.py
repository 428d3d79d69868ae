"""Simulation of a smooth plant over one sampling period by the classical Runge-Kutta method, for a
batch of states."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

States = Float[np.ndarray, "N n"]
Rate = Callable[[States], States]


def integrate_runge_kutta(rate: Rate, x: States, step_s: float, substeps: int) -> States:
    """Integrate a differential equation over one sampling period by the classical Runge-Kutta
    method of order four.

    Fourth order where the rate is smooth.
    """
    h = step_s / substeps
    for _ in range(substeps):
        a = rate(x)
        b = rate(x + 0.5 * h * a)
        c = rate(x + 0.5 * h * b)
        d = rate(x + h * c)
        x = x + (h / 6.0) * (a + 2.0 * b + 2.0 * c + d)  # Simpson weights
    return x
