"""The points no other point beats in both respects."""

import numpy as np
from jaxtyping import Bool, Float


def pareto_front(x: Float[np.ndarray, "N"], y: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Which points maximise `(x, y)`: no other point is at least as good in both and better in one. NaN never is."""
    known = np.isfinite(x) & np.isfinite(y)
    front = np.zeros(len(x), dtype=bool)
    order = np.flatnonzero(known)[np.lexsort((-y[known], -x[known]))]
    best_y, best_x = -np.inf, np.inf
    for i in order:  # from the largest x down; equal x from the largest y down
        if y[i] > best_y:
            best_y, best_x, front[i] = y[i], x[i], True
        elif y[i] == best_y and x[i] == best_x:
            front[i] = True
    return front
