"""Compiled code of the recurrence with neurons, for free runs and forward sensitivities. Each takes
one pass over the samples.

`z = F x + G v + b,  w = phi(z) - phi(b),  x+ = A x + B v + E w,  ybar = C x + D v + H w` with v =
S_u(u) given.
Arrays are float64 and contiguous: `v (N, T, m)`, `x0 (N, n)`, `ybar (N, T, p)`; `kinds (q,)` are
the neurons' codes.
By hand: with `S = diag phi'(z)` a change obeys `dx+ = (A + E S F) dx + ...`, `dybar = (C + H S F)
dx + ...`.
"""

from collections.abc import Mapping
from itertools import accumulate
from math import exp, log1p, prod, tanh
from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int

from ssm_study.compilation import compile_with_numba
from ssm_study.models.matrix_shapes import matrix_shapes


class KernelMatrices(NamedTuple):
    """Matrices of a recurrence with neurons in the layout that compiled code takes. `a (n, n), b
    (n, m), c (p, n), d (p, m), e (n, q), f (q, n), g (q, m), h (p, q)`, `bias (q,)`, `kinds
    (q,)`."""

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]
    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    g: Float[np.ndarray, "q m"]
    h: Float[np.ndarray, "p q"]
    bias: Float[np.ndarray, "q"]
    kinds: Int[np.ndarray, "q"]

    @classmethod
    def from_parts(cls, parts: Mapping[str, Any], kinds: Int[np.ndarray, "q"]) -> "KernelMatrices":
        """Make the matrices for compiled code from named arrays. For any other layout, numba would
        compile everything once more."""
        arrays = (np.array(parts[name], dtype=np.float64, order="C") for name in cls._fields[:-1])
        return cls._make((*arrays, kinds))


@compile_with_numba
@no_type_check
def activation_and_slope(code, z):
    """Value and slope of the activation function with a given code. `(phi(z), phi'(z))`."""
    if code == 0:
        value = tanh(z)
        return value, 1.0 - value * value
    if code == 1:
        part = exp(-abs(z))
        slope = 1.0 / (1.0 + part)
        return max(z, 0.0) + log1p(part), slope if z >= 0.0 else 1.0 - slope
    if code == 2:
        if abs(z) < 1.0:
            return z * z * z / 3.0, z * z
        return z - (2.0 / 3.0 if z > 0.0 else -2.0 / 3.0), 1.0
    if code == 3:
        return max(z, 0.0), 1.0 if z >= 0.0 else 0.0
    return min(max(z, -1.0), 1.0), 1.0 if -1.0 <= z < 1.0 else 0.0


@compile_with_numba
@no_type_check
def _evaluate_neurons(
    k, still, x, v, w, slope
):  # Fill w and the slopes at state x and lifted input v; still is phi(b)
    """Compute the outputs and slopes of all neurons at one sample, in place."""
    for i in range(w.shape[0]):
        z = k.bias[i]
        for j in range(x.shape[0]):
            z += k.f[i, j] * x[j]
        for j in range(v.shape[0]):
            z += k.g[i, j] * v[j]
        value, slope[i] = activation_and_slope(k.kinds[i], z)
        w[i] = value - still[i]


@compile_with_numba
@no_type_check
def _apply_matrices(state, through, inner, x, v, w, out):  # out = state x + through v + inner w
    """Compute the next state or the output from state, input and neuron outputs, in place."""
    for i in range(out.shape[0]):
        total = 0.0
        for j in range(x.shape[0]):
            total += state[i, j] * x[j]
        for j in range(v.shape[0]):
            total += through[i, j] * v[j]
        for j in range(w.shape[0]):
            total += inner[i, j] * w[j]
        out[i] = total


@compile_with_numba
@no_type_check
def simulate_compiled(k, v, x0):
    """Simulate the recurrence with neurons in compiled code. `(ybar (N, T, p), states (N, T + 1,
    n))`: the states include the one after the last sample."""
    records = v.shape[0]
    samples = v.shape[1]
    ybar = np.empty((records, samples, k.c.shape[0]))
    states = np.empty((records, samples + 1, k.a.shape[0]))
    q = k.e.shape[1]
    w = np.empty(q)
    slope = np.empty(q)
    still = np.zeros(q)
    _evaluate_neurons(
        k, still, np.zeros(k.a.shape[0]), np.zeros(v.shape[2]), still, slope
    )  # phi(b): at rest
    for r in range(records):
        states[r, 0] = x0[r]
        for t in range(samples):
            _evaluate_neurons(
                k, still, states[r, t], v[r, t], w, slope
            )  # w[t] first: output and next state share it
            _apply_matrices(k.c, k.d, k.h, states[r, t], v[r, t], w, ybar[r, t])
            _apply_matrices(k.a, k.b, k.e, states[r, t], v[r, t], w, states[r, t + 1])
    return ybar, states


def split_blocks(
    sizes: dict[str, tuple[int, ...]], j: Float[np.ndarray, "*batch P"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Cut the last axis of an array into blocks of given shapes, in their order."""
    *ends, _ = accumulate(map(prod, sizes.values()))
    return dict(zip(sizes, np.split(j, ends, axis=-1), strict=True))


@compile_with_numba
@no_type_check
def _add_sample_sensitivity(row, weights, s, inner, scaled, through, here, basis, channel, own, at):
    """Add one sample's contribution to the derivatives of one state or output with respect to all
    parameters. It comes from `weights s`, from this row's own entries (from `own` on), and from the
    neurons.

    `here = (x, v, w, slope, rest)` with the neurons' slopes; `at` are the first columns of f, g,
    bias and scaffold_in.
    """
    x, v, w, slope, rest = here
    for j in range(len(x)):
        for c in range(s.shape[1]):
            row[c] += weights[j] * s[j, c]  # through the state: dx
        row[own[0] + j] += x[j]  # this row of A or C itself
    for j in range(len(v)):
        row[own[1] + j] += v[j]  # of B or D
    for u in range(len(w)):
        row[own[2] + u] += w[u]  # of E or H
        for j in range(len(x)):
            row[at[0] + u * len(x) + j] += scaled[u] * x[j]
        for j in range(len(v)):
            row[at[1] + u * len(v) + j] += scaled[u] * v[j]
        row[at[2] + u] += inner[u] * (slope[u] - rest[u])  # the bias moves phi(z) and phi(b)
    for j in range(len(basis)):
        row[at[3] + j] += through[channel[j]] * basis[j]


BLOCKS = (
    "a",
    "b",
    "e",
    "f",
    "g",
    "bias",
    "scaffold_in",
    "x0",
    "c",
    "d",
    "h",
)  # what moves the states first


def simulate_with_sensitivities(
    k: KernelMatrices,
    v: Float[np.ndarray, "N T m"],
    x0: Float[np.ndarray, "N n"],
    moved: Float[np.ndarray, "N T K"],
    channel: Int[np.ndarray, "K"],
) -> tuple[Float[np.ndarray, "N T p"], dict[str, Float[np.ndarray, "N T p _"]]]:
    """Simulated output and its derivatives with respect to all parameters, in compiled code. The
    derivatives are in the order of `BLOCKS`, flattened by rows.

    Parameter j of `scaffold_in` moves the lifted input of `channel[j]` by `moved[., ., j]` per
    unit; `x0` is the own record's.
    """
    n, m = k.b.shape
    sizes = matrix_shapes(n, m, len(k.c), len(k.bias)) | {"scaffold_in": channel.shape, "x0": (n,)}
    sizes = {name: sizes[name] for name in BLOCKS}
    places = tuple(accumulate(map(prod, sizes.values()), initial=0))
    ybar, j = _sensitivity_loop(
        k, np.ascontiguousarray(v), x0, np.ascontiguousarray(moved), channel, places
    )
    return ybar, split_blocks(sizes, j)


@compile_with_numba
@no_type_check
def _sensitivity_loop(k, v, x0, basis, channel, places):
    """Compiled loop over records and samples for the output's derivatives with respect to the
    parameters. `dx` of a state parameter is one row of `s`; what drives it is sparse and is added
    by its place."""
    records, samples, m = v.shape
    n = k.a.shape[0]
    p = k.c.shape[0]
    q = k.e.shape[1]
    _, at_b, at_e, _, _, _, _, at_x0, at_c, at_d, at_h, width = places
    at = places[3:7]
    out = np.zeros((records, samples, p, width))
    ybar = np.empty((records, samples, p))
    w = np.empty(q)
    slope = np.empty(q)
    still = np.zeros(q)
    rest = np.empty(q)
    _evaluate_neurons(k, still, np.zeros(n), np.zeros(m), still, rest)
    es = np.empty((n, q))
    hs = np.empty((p, q))
    turn = np.empty((n, n))
    read = np.empty((p, n))
    push = np.empty((n, m))
    through = np.empty((p, m))
    for r in range(records):
        x = x0[r].copy()
        ahead = np.empty(n)
        s = np.zeros((n, at_c))
        moved = np.empty((n, at_c))
        s[:, at_x0:at_c] = np.eye(n)  # dx / dx0 at the first sample
        for t in range(samples):
            _evaluate_neurons(k, still, x, v[r, t], w, slope)
            _apply_matrices(k.c, k.d, k.h, x, v[r, t], w, ybar[r, t])
            _linearise_at_slopes(k.a, k.b, k.e, k.f, k.g, slope, es, turn, push)
            _linearise_at_slopes(k.c, k.d, k.h, k.f, k.g, slope, hs, read, through)
            here = (x, v[r, t], w, slope, rest)
            for o in range(p):
                own = (at_c + o * n, at_d + o * m, at_h + o * q)
                _add_sample_sensitivity(
                    out[r, t, o],
                    read[o],
                    s,
                    k.h[o],
                    hs[o],
                    through[o],
                    here,
                    basis[r, t],
                    channel,
                    own,
                    at,
                )
            moved[:] = 0.0
            for i in range(n):
                own = (i * n, at_b + i * m, at_e + i * q)
                _add_sample_sensitivity(
                    moved[i],
                    turn[i],
                    s,
                    k.e[i],
                    es[i],
                    push[i],
                    here,
                    basis[r, t],
                    channel,
                    own,
                    at,
                )
            s, moved = moved, s  # two buffers, swapped: no allocation in the loop
            _apply_matrices(k.a, k.b, k.e, x, v[r, t], w, ahead)
            x, ahead = ahead, x
    return ybar, out


@compile_with_numba
@no_type_check
def _linearise_at_slopes(state, through, inner, f, g, slope, scaled, by_state, by_input):
    """Linearise the recurrence at given slopes of its neurons, in place. `scaled = inner S,
    by_state = state + inner S f, by_input = through + inner S g`."""
    for i in range(state.shape[0]):
        for u in range(slope.shape[0]):
            scaled[i, u] = inner[i, u] * slope[u]
        for j in range(state.shape[1]):
            by_state[i, j] = state[i, j]
            for u in range(slope.shape[0]):
                by_state[i, j] += scaled[i, u] * f[u, j]
        for j in range(through.shape[1]):
            by_input[i, j] = through[i, j]
            for u in range(slope.shape[0]):
                by_input[i, j] += scaled[i, u] * g[u, j]
