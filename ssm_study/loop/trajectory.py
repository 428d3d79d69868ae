"""Trajectories the model can follow: given a reference, the states and inputs that realise it or come nearest.

A contracting loop converges to any trajectory of its own model, so `u = u* + K (xh - x*)` needs `(x*, u*)` with
`x*+ = A x* + B S_u(u*)`. The recurrence is linear in `v = S_u(u*)`: `v` is found by linear-quadratic tracking, and
`u* = S_u^{-1}(v)` undoes the input nonlinearity, dead-zone included. (THEORY section 4; [Z26] Theorem 3.)
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.linalg import null_space, solve_discrete_are
from scipy.optimize import elementwise

from ssm_study.models.identified import SSM
from ssm_study.models.scaffold import Scaffold
from ssm_study.refusal import require
from ssm_study.systems import StateSpace

SMOOTHNESS = 1.0
"""Weight on the squared change of `v` per sample against the squared scaled tracking error: a step is taken in a few
samples and not in one violent one."""
IDLE_SHARE = 1e-9
"""Of the largest static gain: a direction of inputs below this moves no output."""
INVERSION_TOLERANCE = 1e-10
"""Residual of `S(v) = w` in scaled units, where one unit is the spread of the signal."""


def equilibrium(model: SSM, y: Float[np.ndarray, "p"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "m"]]:
    """`x* = A x* + B S_u(u*),  y = S_y(C x* + D S_u(u*))`: where the model rests at output `y` (physical unit).

    Returns `x*` and `u*`, both in scaled units. With more inputs than outputs the smallest `S_u(u*)` is taken.
    Raises `BadRequest` when no input holds that output.
    """
    y_bar = inverse(model.scaffold_out, ((y - model.output_equilibrium) / model.output_scale)[None])[0]
    lifted, x = _resting(model.linear, y_bar)
    return x, inverse(model.scaffold_in, lifted[None])[0]


def feasible_trajectory(model: SSM, reference: Float[np.ndarray, "T p"]) -> Float[np.ndarray, "T t"]:
    """The model's own trajectory nearest the reference, one row `(x*[k], u*[k])` per sample, in scaled units.

    Minimises `sum |y_bar[k] - y_bar*[k]|^2 + SMOOTHNESS |v[k] - v[k-1]|^2` from the model's equilibrium, where every
    observer starts; the whole reference is known in advance, so the input moves before a step does. `reference` is in
    the output's unit. A reference at rest gives zeros.
    """
    y_bar = inverse(model.scaffold_out, (reference - model.output_equilibrium) / model.output_scale)
    states, inputs = _track(model.linear, y_bar)
    return np.concatenate([states, inverse(model.scaffold_in, inputs)], axis=1)


def set_points(model: SSM, reference: Float[np.ndarray, "T p"]) -> Float[np.ndarray, "T t"]:
    """The rest point `(x*, u*)` of each reference value: for references that are constant but for steps."""
    values, index = np.unique(reference, axis=0, return_inverse=True)
    points = np.stack([np.concatenate(equilibrium(model, value)) for value in values])
    return points[index.reshape(-1)]


def _resting(system: StateSpace, y: Float[np.ndarray, "p"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "n"]]:
    """`v` and `x` with `x = A x + B v,  y = C x + D v`."""
    to_state = np.linalg.solve(np.eye(system.order) - system.a, system.b)
    gain = system.c @ to_state + system.d
    lifted = np.linalg.lstsq(gain, y, rcond=None)[0]
    require(
        bool(np.allclose(gain @ lifted, y, atol=1e-8 * max(1.0, float(np.abs(y).max())))),
        "loop.reference",
        np.round(y, 4).tolist(),
        "no constant input of the model holds this scaled output",
        "choose a reference within the reach of the inputs",
    )
    return lifted, to_state @ lifted


def _track(
    system: StateSpace, target: Float[np.ndarray, "T p"]
) -> tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T k"]]:
    """Linear-quadratic preview tracking on `z = (x, v[k-1])` driven by `w = v[k] - v[k-1]`.

    `P` solves the Riccati equation of the tracking cost; the reference enters through the backward sum
    `g[k] = (F - G K)^T g[k+1] - (H - D K)^T target[k]`, started where a reference held for ever would keep it.
    """
    (n, m), d = system.b.shape, system.d
    f = np.block([[system.a, system.b], [np.zeros((m, n)), np.eye(m)]])
    idle = _idle(system)
    target = np.concatenate([target, np.zeros((len(target), len(idle)))], axis=1)
    d = np.vstack([d, idle])
    g, h = (
        np.vstack([system.b, np.eye(m)]),
        np.vstack([np.hstack([system.c, system.d]), np.hstack([np.zeros((len(idle), n)), idle])]),
    )
    weight = SMOOTHNESS * np.eye(m) + d.T @ d
    p = solve_discrete_are(f, g, h.T @ h, weight, s=h.T @ d)
    curvature = weight + g.T @ p @ g
    k = np.linalg.solve(curvature, g.T @ p @ f + d.T @ h)
    closed, seen = (f - g @ k).T, (h - d @ k).T
    costate = -np.linalg.solve(np.eye(n + m) - closed, seen @ target[-1])
    preview = np.empty((len(target), m))
    for i in reversed(range(len(target))):
        preview[i] = np.linalg.solve(curvature, d.T @ target[i] - g.T @ costate)
        costate = closed @ costate - seen @ target[i]
    return _roll(f, g, k, preview, n)


def _idle(system: StateSpace) -> Float[np.ndarray, "q k"]:
    """Directions of v that move no output at rest, as rows: without a cost of their own they would drift."""
    gain = system.c @ np.linalg.solve(np.eye(system.order) - system.a, system.b) + system.d
    return null_space(gain, rcond=IDLE_SHARE).T


def _roll(
    f: Float[np.ndarray, "z z"],
    g: Float[np.ndarray, "z m"],
    k: Float[np.ndarray, "m z"],
    preview: Float[np.ndarray, "T m"],
    n: int,
) -> tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T m"]]:
    z = np.zeros(len(f))
    states, inputs = np.empty((len(preview), n)), np.empty((len(preview), len(z) - n))
    for i, extra in enumerate(preview):
        states[i] = z[:n]
        z = f @ z + g @ (extra - k @ z)
        inputs[i] = z[n:]
    return states, inputs


def inverse(scaffold: Scaffold, w: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N m"]:
    """`v` with `S(v) = w`, row by row: scalar maps, which are monotone, in a bracket; others by damped Newton steps.

    Raises `BadRequest` when the map does not reach `w`.
    """
    solve: Callable[[Scaffold, np.ndarray], np.ndarray] = _scalar_root if w.shape[1] == 1 else _newton
    v = np.where((w == 0).all(axis=1, keepdims=True), 0.0, solve(scaffold, w))  # S(0) = 0 holds exactly
    worst = int(np.abs(scaffold(v) - w).max(axis=1).argmax())
    require(
        bool(np.abs(scaffold(v) - w).max() <= INVERSION_TOLERANCE * max(1.0, float(np.abs(w).max()))),
        "loop.reference",
        np.round(w[worst], 4).tolist(),
        "the identified nonlinearity does not reach this scaled value",
        "choose a reference within the reach of the inputs, or raise model.slope_lower",
    )
    return v


def _scalar_root(scaffold: Scaffold, w: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 1"]:
    """Chandrupatla's method from a bracket grown around zero; not a number where none is found."""

    def missing(v: Float[np.ndarray, "N"], w: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        return scaffold(v[:, None])[:, 0] - w

    around = elementwise.bracket_root(missing, -1.0, 1.0, args=(w[:, 0],), maxiter=60)
    return np.asarray(elementwise.find_root(missing, around.bracket, args=(w[:, 0],)).x)[:, None]


def _newton(scaffold: Scaffold, w: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N m"]:
    values, index = np.unique(w, axis=0, return_inverse=True)  # a reference at rest asks the same at every sample
    return np.stack([_newton_row(scaffold, row) for row in values])[index.reshape(-1)]


def _newton_row(scaffold: Scaffold, w: Float[np.ndarray, "k"]) -> Float[np.ndarray, "m"]:
    v, enough = np.zeros(scaffold.jacobian(np.zeros_like(w)).shape[1]), 1e-2 * INVERSION_TOLERANCE
    missing = w - scaffold(v[None])[0]
    for _ in range(100):
        if np.linalg.norm(missing) <= enough:
            break
        step = np.linalg.lstsq(scaffold.jacobian(v), missing, rcond=None)[0]
        trials = ((v + s * step, w - scaffold((v + s * step)[None])[0]) for s in 0.5 ** np.arange(40))
        nearer = next((t for t in trials if np.linalg.norm(t[1]) < np.linalg.norm(missing)), None)
        if nearer is None:
            break
        v, missing = nearer
    return v
