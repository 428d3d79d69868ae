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
    """Matrices of a recurrence with neurons in the memory layout that compiled code requires. `a
    (n, n), b (n, m), c (p, n), d (p, m), e (n, q), f (q, n), g (q, m), h (p, q)`, `bias (q,)`,
    `kinds (q,)`."""

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
        """Convert named matrices of a recurrence with neurons to the memory layout that compiled
        code requires. For any other layout, numba would compile everything once more."""
        arrays = (np.array(parts[name], dtype=np.float64, order="C") for name in cls._fields[:-1])
        return cls._make((*arrays, kinds))


@compile_with_numba
@no_type_check
def activation_and_slope(code, z):
    """Value and derivative of the activation function with a given integer code. `(phi(z),
    phi'(z))`."""
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
def _evaluate_neurons(k, still, x, v, w, slope):
    """Compute the outputs and slopes of all neurons at one sample, in place. `still` is
    `phi(b)`."""
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
def _apply_matrices(state, through, inner, x, v, w, out):
    """Compute the next state or the output of a recurrence from state, input and neuron outputs, in
    place. `out = state x + through v + inner w`."""
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
    """Simulate a recurrence with neurons on a batch of input sequences, in compiled code. `(ybar
    (N, T, p), states (N, T + 1, n))`: the states include the one after the last sample."""
    records = v.shape[0]
    samples = v.shape[1]
    ybar = np.empty((records, samples, k.c.shape[0]))
    states = np.empty((records, samples + 1, k.a.shape[0]))
    q = k.e.shape[1]
    w = np.empty(q)
    slope = np.empty(q)
    still = np.zeros(q)
    at_rest = np.zeros(k.a.shape[0])
    _evaluate_neurons(k, still, at_rest, np.zeros(v.shape[2]), still, slope)  # phi(b)
    for r in range(records):
        states[r, 0] = x0[r]
        for t in range(samples):
            x = states[r, t]
            _evaluate_neurons(k, still, x, v[r, t], w, slope)
            _apply_matrices(k.c, k.d, k.h, x, v[r, t], w, ybar[r, t])
            _apply_matrices(k.a, k.b, k.e, x, v[r, t], w, states[r, t + 1])
    return ybar, states


def split_blocks(
    sizes: dict[str, tuple[int, ...]], j: Float[np.ndarray, "*batch P"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Cut the last axis of an array into consecutive blocks with given shapes."""
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


# What moves the states comes first.
BLOCKS = ("a", "b", "e", "f", "g", "bias", "scaffold_in", "x0", "c", "d", "h")
# Where in the tuple of first columns those of a block stand.
AT_B = BLOCKS.index("b")
AT_E = BLOCKS.index("e")
AT_F = BLOCKS.index("f")
AT_X0 = BLOCKS.index("x0")
AT_C = BLOCKS.index("c")
AT_D = BLOCKS.index("d")
AT_H = BLOCKS.index("h")


def simulate_with_sensitivities(
    k: KernelMatrices,
    v: Float[np.ndarray, "N T m"],
    x0: Float[np.ndarray, "N n"],
    map_derivatives: Float[np.ndarray, "N T K"],
    parameter_channels: Int[np.ndarray, "K"],
) -> tuple[Float[np.ndarray, "N T p"], dict[str, Float[np.ndarray, "N T p _"]]]:
    """Simulate a recurrence with neurons, together with the derivatives of its output with respect
    to all parameters. The derivatives are in the order of `BLOCKS`, flattened by rows.

    Parameter j of `scaffold_in` moves the lifted input of `parameter_channels[j]` by
    `map_derivatives[., ., j]` per unit; `x0` is the own record's.
    """
    n, m = k.b.shape
    shapes = matrix_shapes(n, m, len(k.c), len(k.bias))
    shapes |= {"scaffold_in": parameter_channels.shape, "x0": (n,)}
    sizes = {name: shapes[name] for name in BLOCKS}
    places = tuple(accumulate(map(prod, sizes.values()), initial=0))
    inputs = np.ascontiguousarray(v)
    basis = np.ascontiguousarray(map_derivatives)
    ybar, j = _sensitivity_loop(k, inputs, x0, basis, parameter_channels, places)
    return ybar, split_blocks(sizes, j)


@compile_with_numba
@no_type_check
def _sensitivity_loop(k, v, x0, basis, channel, places):
    """Compiled loop over records that computes the output's derivatives with respect to the
    parameters."""
    records, samples, m = v.shape
    n = k.a.shape[0]
    p = k.c.shape[0]
    q = k.e.shape[1]
    out = np.zeros((records, samples, p, places[-1]))
    ybar = np.empty((records, samples, p))
    still = np.zeros(q)
    rest = np.empty(q)
    _evaluate_neurons(k, still, np.zeros(n), np.zeros(m), still, rest)
    for r in range(records):
        moved = (basis[r], channel)
        _differentiate_record(k, (still, rest), v[r], x0[r], moved, places, ybar[r], out[r])
    return ybar, out


@compile_with_numba
@no_type_check
def _differentiate_record(k, at_rest, v, x0, moved, places, ybar, out):
    """Compute the output on one record and its derivatives with respect to the parameters, in
    place. A state parameter keeps `dx` in one row of `s`; what drives it is sparse and is added by
    its place."""
    still, rest = at_rest
    basis, channel = moved
    samples, m = v.shape
    n = k.a.shape[0]
    p = k.c.shape[0]
    q = len(still)
    w = np.empty(q)
    slope = np.empty(q)
    es, turn, push = _allocate_linearisations(n, n, m, q)
    hs, read, through = _allocate_linearisations(p, n, m, q)
    x = x0.copy()
    ahead = np.empty(n)
    at = places[AT_F:AT_X0]
    states = places[AT_C]
    s = np.zeros((n, states))
    s_ahead = np.empty((n, states))
    s[:, places[AT_X0] : states] = np.eye(n)  # dx / dx0 at the first sample
    for t in range(samples):
        _evaluate_neurons(k, still, x, v[t], w, slope)
        _apply_matrices(k.c, k.d, k.h, x, v[t], w, ybar[t])
        _linearise_at_slopes(k.a, k.b, k.e, k.f, k.g, slope, es, turn, push)
        _linearise_at_slopes(k.c, k.d, k.h, k.f, k.g, slope, hs, read, through)
        here = (x, v[t], w, slope, rest)
        for o in range(p):
            own = (places[AT_C] + o * n, places[AT_D] + o * m, places[AT_H] + o * q)
            _add_sample_sensitivity(
                out[t, o], read[o], s, k.h[o], hs[o], through[o], here, basis[t], channel, own, at
            )
        s_ahead[:] = 0.0
        for i in range(n):
            own = (i * n, places[AT_B] + i * m, places[AT_E] + i * q)
            _add_sample_sensitivity(
                s_ahead[i], turn[i], s, k.e[i], es[i], push[i], here, basis[t], channel, own, at
            )
        s, s_ahead = s_ahead, s  # two buffers, swapped: no allocation in the loop
        _apply_matrices(k.a, k.b, k.e, x, v[t], w, ahead)
        x, ahead = ahead, x


@compile_with_numba
@no_type_check
def _allocate_linearisations(rows, n, m, q):
    """Allocate arrays for the linearisations of a recurrence at several samples."""
    return np.empty((rows, q)), np.empty((rows, n)), np.empty((rows, m))


@compile_with_numba
@no_type_check
def _linearise_at_slopes(state, through, inner, f, g, slope, scaled, by_state, by_input):
    """Linearise a recurrence with neurons at given slopes of the neurons, in place. `scaled = inner
    S, by_state = state + inner S f, by_input = through + inner S g`."""
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
