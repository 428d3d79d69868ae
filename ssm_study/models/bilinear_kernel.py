"""Compiled code for free runs of a bilinear model and their derivatives.

`x+ = sum_i h_i (A_i x + b_i)` with the hat functions h given, `hats (T, q)`, `a (q, n, n)`, `b (q,
n)`, `x0 (n,)`, all float64 and contiguous.
"""

from typing import no_type_check

import numpy as np

from ssm_study.compilation import compile_with_numba


@compile_with_numba
@no_type_check
def simulate_states(hats, a, b, x0):
    """States `(T, n)` of the bilinear recurrence `x+ = sum_i hats[k, i] (a_i x + b_i)` from
    `x0`."""
    samples, q = hats.shape
    n = len(x0)
    states = np.empty((samples, n))
    x = x0.copy()
    after = np.empty(n)
    for k in range(samples):
        states[k] = x
        for row in range(n):
            total = 0.0
            for i in range(q):
                if hats[k, i] != 0.0:
                    inner = b[i, row]
                    for j in range(n):
                        inner += a[i, row, j] * x[j]
                    total += hats[k, i] * inner
            after[row] = total
        x[:] = after
    return states


@compile_with_numba
@no_type_check
def simulate_state_derivatives(hats, a, b, x0, by_initial_state):
    """States of a bilinear recurrence, and their derivatives with respect to all parameters and the
    initial state, or to the initial state alone."""
    samples, q = hats.shape
    n = len(x0)
    first_b = 0 if by_initial_state else q * n * n
    first_x0 = 0 if by_initial_state else first_b + q * n
    states = simulate_states(hats, a, b, x0)
    derivatives = np.zeros((samples, n, first_x0 + n))
    s = np.zeros((n, first_x0 + n))
    for row in range(n):
        s[row, first_x0 + row] = 1.0
    mean = np.empty((n, n))
    for k in range(samples):
        derivatives[k] = s
        mean[:] = 0.0
        for i in range(q):
            if hats[k, i] != 0.0:
                mean += hats[k, i] * a[i]
        s = mean @ s
        if by_initial_state:
            continue
        for i in range(q):
            share = hats[k, i]
            if share != 0.0:
                for row in range(n):
                    for j in range(n):
                        s[row, (i * n + row) * n + j] += share * states[k, j]
                    s[row, first_b + i * n + row] += share
    return states, derivatives
