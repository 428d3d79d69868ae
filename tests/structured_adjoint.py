"""The gradient of a structured model's squared error by its adjoint, compiled: the second route to
J'r.

With `g = 2 weight^2 (ybar - y)` and `l[T] = 0`, backwards over the samples, S = diag phi'(z):

    dw = E' l[k+1] + H' g,   dz = S dw,   l[k] = A' l[k+1] + F' dz + C' g

    dL/dA = sum l[k+1] x',  dL/dB = sum l[k+1] v',  dL/dE = sum l[k+1] w',  dL/dF = sum dz x',
    dL/dG = sum dz v',
    dL/dC = sum g x',  dL/dD = sum g v',  dL/dH = sum g w',  dL/dbias = sum (dz - phi'(bias) dw)

Source: Bryson & Ho, Applied Optimal Control (1975), section 2.2.
"""

from math import exp
from typing import no_type_check

import numpy as np
from numba import njit
from numba.extending import register_jitable

from ssm_study.models.structured_kernel import activation_and_slope

AT_ONCE = 8  # records side by side, the innermost index: what the processor does in one instruction


@register_jitable(error_model="numpy", inline="always")
@no_type_check
def _add(matrix, vectors, out):  # out += matrix vectors, a column for each record
    for i in range(out.shape[0]):
        for j in range(vectors.shape[0]):
            for r in range(AT_ONCE):
                out[i, r] += matrix[i, j] * vectors[j, r]


@register_jitable(error_model="numpy", inline="always")
@no_type_check
def _add_outer(left, right, out):  # out[i, j] += left[i] right[j], record by record
    for i in range(left.shape[0]):
        for j in range(right.shape[0]):
            for r in range(AT_ONCE):
                out[i, j, r] += left[i, r] * right[j, r]


@register_jitable(error_model="numpy")
@no_type_check
def _simulate(k, v, still, x, w, slope, z):
    """States, neurons and their slopes over one block of records, from `x[0]` on."""
    q = k.e.shape[1]
    for t in range(v.shape[0]):
        for i in range(q):
            z[i] = k.bias[i]
        _add(k.f, x[t], z)
        _add(k.g, v[t], z)
        for i in range(q):
            if k.kinds[i] == 0:  # tanh by one exponential: four times as fast, to 4e-16
                for r in range(AT_ONCE):
                    activation = z[i, r]
                    growth = exp(2.0 * activation)
                    value = 1.0 - 2.0 / (growth + 1.0)
                    w[t, i, r] = value - still[i]
                    slope[t, i, r] = 1.0 - value * value
                continue
            for r in range(AT_ONCE):
                kind = k.kinds[i]
                value, slope[t, i, r] = activation_and_slope(kind, z[i, r])
                w[t, i, r] = value - still[i]
        x[t + 1] = 0.0
        _add(k.a, x[t], x[t + 1])
        _add(k.b, v[t], x[t + 1])
        _add(k.e, w[t], x[t + 1])


@register_jitable(error_model="numpy")
@no_type_check
def _weigh_errors(k, v, y, weight, x, w, g):
    """`g = 2 weight^2 (ybar - y)` over one block of records."""
    for t in range(v.shape[0]):
        g[t] = -y[t]
        _add(k.c, x[t], g[t])
        _add(k.d, v[t], g[t])
        _add(k.h, w[t], g[t])
        for o in range(k.c.shape[0]):
            for r in range(AT_ONCE):
                g[t, o, r] *= 2.0 * weight[t, 0, r] ** 2


@register_jitable(error_model="numpy")
@no_type_check
def _accumulate(k, v, rest, x, w, slope, g, sums):
    """Backwards over one block of records, the derivatives added to `sums`."""
    da, de, df, db, dg, dbias, dc, dd, dh = sums
    n, q = k.e.shape
    shape_of_neurons = (q, AT_ONCE)
    dw = np.empty(shape_of_neurons)
    dz = np.empty(shape_of_neurons)
    shape_of_states = (n, AT_ONCE)
    ahead = np.zeros(shape_of_states)
    here = np.empty(shape_of_states)
    last = v.shape[0] - 1
    for t in range(last, -1, -1):
        dw[:] = 0.0
        here[:] = 0.0
        _add(k.e.T, ahead, dw)
        _add(k.h.T, g[t], dw)
        _add(k.a.T, ahead, here)
        _add(k.c.T, g[t], here)
        _add_outer(ahead, x[t], da)
        _add_outer(ahead, v[t], db)
        _add_outer(ahead, w[t], de)
        _add_outer(g[t], x[t], dc)
        _add_outer(g[t], v[t], dd)
        _add_outer(g[t], w[t], dh)
        for i in range(q):
            for r in range(AT_ONCE):
                dz[i, r] = slope[t, i, r] * dw[i, r]
                dbias[i, r] += dz[i, r] - rest[i] * dw[i, r]
        _add(k.f.T, dz, here)
        _add_outer(dz, x[t], df)
        _add_outer(dz, v[t], dg)
        ahead, here = here, ahead


@njit(error_model="numpy")
@no_type_check
def _derivatives(k, v, x0, y, weight):
    """Derivatives of `sum (weight (ybar - y))^2`, `v (N, T, m, AT_ONCE)`: forward with everything
    kept, then backward."""
    n = k.a.shape[0]
    q = k.e.shape[1]
    m = v.shape[2]
    p = k.c.shape[0]
    samples = v.shape[1]
    da = np.zeros((n, n, AT_ONCE))
    db = np.zeros((n, m, AT_ONCE))
    de = np.zeros((n, q, AT_ONCE))
    df = np.zeros((q, n, AT_ONCE))
    dg = np.zeros((q, m, AT_ONCE))
    shape_of_bias = (q, AT_ONCE)
    dbias = np.zeros(shape_of_bias)
    dc = np.zeros((p, n, AT_ONCE))
    dd = np.zeros((p, m, AT_ONCE))
    dh = np.zeros((p, q, AT_ONCE))
    x = np.empty((samples + 1, n, AT_ONCE))
    g = np.empty((samples, p, AT_ONCE))
    shape_of_w = (samples, q, AT_ONCE)
    w = np.empty(shape_of_w)
    slope = np.empty(shape_of_w)
    z = np.empty(shape_of_bias)
    still = np.empty(q)
    rest = np.empty(q)
    for i in range(q):
        still[i], rest[i] = activation_and_slope(k.kinds[i], k.bias[i])
    sums = (da, de, df, db, dg, dbias, dc, dd, dh)
    for block in range(v.shape[0]):
        x[0] = x0[block]
        _simulate(k, v[block], still, x, w, slope, z)
        _weigh_errors(k, v[block], y[block], weight[block], x, w, g)
        _accumulate(k, v[block], rest, x, w, slope, g, sums)
    return sums


def gradient(one, theta, derivatives=_derivatives):  # type: ignore[no-untyped-def]
    """`dL/dtheta` of `L = |r|^2` by block, r as `Residuals.residual` has it; linear S_u and S_y, no
    integrator."""

    def blocks(side):  # type: ignore[no-untyped-def]
        missing = -len(side) % AT_ONCE
        empty = np.zeros((missing, *side.shape[1:]))  # records of no weight
        side = np.concatenate([side, empty])
        grouped = side.reshape(-1, AT_ONCE, *side.shape[1:])
        records_last = np.moveaxis(grouped, 1, -1)
        return np.ascontiguousarray(records_last)

    u, y, weight = map(blocks, one.records)
    matrices = one.kernel_matrices(theta)
    initial_conditions = one.initial_conditions(theta)
    first_states = blocks(initial_conditions[0])
    parts = derivatives(matrices, u, first_states, y, weight)
    names = ("a", "e", "f", "b", "g", "bias", "c", "d", "h")
    return {name: part.sum(axis=-1) for name, part in zip(names, parts, strict=True)}


def stepped_gradient(one, theta):  # type: ignore[no-untyped-def]
    """The same formulas by the interpreter: of a few samples sooner than the compiler is done."""
    return gradient(one, theta, _derivatives.py_func)
