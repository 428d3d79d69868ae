"""The gradient of a structured model's squared error by its adjoint, compiled: the second route to J'r.

With `g = 2 weight r` and `l[T] = 0`, backwards over the samples, S = diag phi'(z):

    dz = S (E' l[k+1] + H' g),   l[k] = A' l[k+1] + F' dz + C' g

    dL/dA = sum l[k+1] x',  dL/dB = sum l[k+1] v',  dL/dE = sum l[k+1] w',  dL/dF = sum dz x',  dL/dG = sum dz v',
    dL/dC = sum g x',  dL/dD = sum g v',  dL/dH = sum g w',  dL/dbias = sum (dz - phi'(bias) dw),  dw = E' l[k+1] + H' g

Source: Bryson & Ho, Applied Optimal Control (1975), section 2.2.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from ssm_study.models.structured_kernel import _rows, bend


@njit(error_model="numpy")
@no_type_check
def _derivatives(k, v, x0, y, weight):
    """Of `sum (weight (ybar - y))^2`, forward with everything kept, then backward, record by record."""
    n, q, m, p, samples = k.a.shape[0], k.e.shape[1], v.shape[2], k.c.shape[0], v.shape[1]
    da, db, dc, dd = np.zeros((n, n)), np.zeros((n, m)), np.zeros((p, n)), np.zeros((p, m))
    de, df, dg, dh, dbias = np.zeros((n, q)), np.zeros((q, n)), np.zeros((q, m)), np.zeros((p, q)), np.zeros(q)
    still, rest = np.empty(q), np.empty(q)
    x, w, slope, g = np.empty((samples + 1, n)), np.empty((samples, q)), np.empty((samples, q)), np.empty((samples, p))
    ahead, here = np.empty(n), np.empty(n)
    for i in range(q):
        still[i], rest[i] = bend(k.kinds[i], k.bias[i])
    for r in range(v.shape[0]):
        x[0] = x0[r]
        for t in range(samples):
            for i in range(q):
                z = k.bias[i]
                for j in range(n):
                    z += k.f[i, j] * x[t, j]
                for j in range(m):
                    z += k.g[i, j] * v[r, t, j]
                value, slope[t, i] = bend(k.kinds[i], z)
                w[t, i] = value - still[i]
            _rows(k.c, k.d, k.h, x[t], v[r, t], w[t], g[t])
            _rows(k.a, k.b, k.e, x[t], v[r, t], w[t], x[t + 1])
            for o in range(p):
                g[t, o] = 2.0 * weight[r, t, 0] ** 2 * (g[t, o] - y[r, t, o])
        ahead[:] = 0.0
        for t in range(samples - 1, -1, -1):
            here[:] = 0.0
            for i in range(q):
                dw = 0.0
                for j in range(n):
                    dw += k.e[j, i] * ahead[j]
                    de[j, i] += ahead[j] * w[t, i]
                for o in range(p):
                    dw += k.h[o, i] * g[t, o]
                    dh[o, i] += g[t, o] * w[t, i]
                dz = slope[t, i] * dw
                dbias[i] += dz - rest[i] * dw
                for j in range(n):
                    df[i, j] += dz * x[t, j]
                    here[j] += k.f[i, j] * dz
                for j in range(m):
                    dg[i, j] += dz * v[r, t, j]
            for i in range(n):
                for j in range(n):
                    da[i, j] += ahead[i] * x[t, j]
                    here[j] += k.a[i, j] * ahead[i]
                for j in range(m):
                    db[i, j] += ahead[i] * v[r, t, j]
            for o in range(p):
                for j in range(n):
                    dc[o, j] += g[t, o] * x[t, j]
                    here[j] += k.c[o, j] * g[t, o]
                for j in range(m):
                    dd[o, j] += g[t, o] * v[r, t, j]
            ahead, here = here, ahead
    return da, de, df, db, dg, dbias, dc, dd, dh


@no_type_check
def gradient(one, theta):
    """`dL/dtheta` of `L = |r|^2` by block, r as `Residuals.residual` has it; linear S_u and S_y, no integrator."""
    u, y, weight = (np.ascontiguousarray(side) for side in one.records)
    parts = _derivatives(one.matrices(theta), u, one.starts(theta)[0], y, weight)
    return dict(zip(("a", "e", "f", "b", "g", "bias", "c", "d", "h"), parts, strict=True))
