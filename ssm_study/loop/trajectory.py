"""Trajectories the model can follow: given a reference, the states and inputs that realise it or
come nearest.

A contracting loop converges to any trajectory of its own model: `v = S_u(u*)` by linear-quadratic
tracking, then `u* = S_u^{-1}(v)`, dead zone included (docs/closed_loop.md). Source: [Z26] Theorem 3
for the law; Anderson & Moore (1990), Optimal Control: Linear Quadratic Methods, chapter 4, for
tracking with a known reference.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.refusal import require
from ssm_study.systems import StateSpace

Vector = Float[np.ndarray, "_"]
Reference = Float[np.ndarray, "T p"]
Plan = Float[np.ndarray, "T t"]  # what is followed at each sample
# Weight on the squared change of `v` per sample against the squared scaled tracking error: a step
# is taken in a few samples and not in one violent one.
SMOOTHNESS = 1.0
IDLE_SHARE = 1e-9  # of the largest static gain: a direction of inputs below this moves no output
NEWTON_STEPS = 100
INVERSION_TOLERANCE = (
    1e-10  # residual of `S(v) = w` in scaled units, where one unit is the spread of the signal
)
REST_TOLERANCE = 1e-8  # likewise of a rest point, which also has a linear system solved


def equilibrium(
    model: Model, y: Float[np.ndarray, "p"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "m"]]:
    """`x* = f(x*, S_u(u*)),  y = h(x*, S_u(u*))`: where the recurrence f rests at output `y`
    (physical unit).

    Returns `x*` and `u*`, both in scaled units. With more inputs than outputs the smallest
    `S_u(u*)` is taken. Raises `BadRequest` when no input holds that output.
    """
    y_bar = inverse(model.scaffold_out, model.scale.scaled_output(y)[None])[0]
    n = model.order
    size = max(1.0, float(np.abs(y_bar).max()))

    def missing(point: Vector) -> Vector:
        x, v = np.split(point, [n])
        inner = model.h @ model.inner(x, v) if isinstance(model, StructuredSSM) else 0.0
        return np.concatenate(
            [model.advance(x, v) - x, model.linear.c @ x + model.linear.d @ v + inner - y_bar]
        )

    def slope(point: Vector) -> Float[np.ndarray, "_ _"]:
        at = (
            model.linearised(*np.split(point, [n]))
            if isinstance(model, StructuredSSM)
            else model.linear
        )
        return np.block([[at.a - np.eye(n), at.b], [at.c, at.d]])

    if isinstance(model, StructuredSSM):
        point = _newton(missing, slope, np.zeros(n + model.b.shape[1]), INVERSION_TOLERANCE * size)
    else:
        states, inputs, outputs = model.linear.held()
        share = np.linalg.lstsq(outputs, y_bar, rcond=None)[0]
        point = np.concatenate([states @ share, inputs @ share])
    problem = "no constant input of the model holds this scaled output"
    _reached(np.abs(missing(point)).max() <= REST_TOLERANCE * size, y_bar, problem, "")
    return point[:n], inverse(model.scaffold_in, point[None, n:])[0]


def feasible_trajectory(model: SSM, reference: Reference) -> Plan:
    """The model's own trajectory nearest the reference, one row `(x*[k], u*[k])` per sample, in
    scaled units.

    Minimises `sum |y_bar[k] - y_bar*[k]|^2 + SMOOTHNESS |v[k] - v[k-1]|^2` from the model's
    equilibrium; the whole reference (output's unit) is known in advance, so the input moves before
    a step does. At rest it gives zeros.

    Preview tracking on `z = (x, v[k-1])` driven by `w = v[k] - v[k-1]`: `P` solves the Riccati
    equation of that cost; the reference enters through the backward sum `g[k] = (F - G K)^T g[k+1]
    - (H - D K)^T target[k]`, started where a reference held for ever would keep it.
    """
    system, (n, m) = model.linear, model.linear.b.shape
    _, inputs, outputs = system.held()
    idle = (
        inputs @ scipy.linalg.null_space(outputs, rcond=IDLE_SHARE)
    ).T  # at no cost of their own these would drift
    target = inverse(model.scaffold_out, model.scale.scaled_output(reference))
    target = np.pad(target, ((0, 0), (0, len(idle))))
    f = np.block([[system.a, system.b], [np.zeros((m, n)), np.eye(m)]])
    g = np.vstack([system.b, np.eye(m)])
    h = np.block([[system.c, system.d], [np.zeros((len(idle), n)), idle]])
    d = np.vstack([system.d, idle])
    weight = SMOOTHNESS * np.eye(m) + d.T @ d
    p = scipy.linalg.solve_discrete_are(
        f, g, h.T @ h, weight, s=h.T @ d
    )  # with the cross term of a feedthrough
    curvature = weight + g.T @ p @ g
    k = np.linalg.solve(curvature, g.T @ p @ f + d.T @ h)
    closed = f - g @ k
    seen = h - d @ k
    last = -np.linalg.solve(
        np.eye(n + m) - closed.T, seen.T @ target[-1]
    )  # a reference held for ever
    c = -np.linalg.solve(curvature, g.T)
    through = np.linalg.solve(curvature, d.T)
    preview = StateSpace(a=closed.T, b=-seen.T, c=c, d=through).simulate(target[::-1], last)[0][
        ::-1
    ]
    c = np.vstack([np.eye(n, n + m), closed[n:]])
    through = np.vstack([np.zeros((n, m)), g[n:]])
    plan = StateSpace(a=closed, b=g, c=c, d=through).simulate(preview)[0]
    return np.concatenate([plan[:, :n], inverse(model.scaffold_in, plan[:, n:])], axis=1)


def guided_trajectory(
    model: StructuredSSM,
    k: Float[np.ndarray, "m n"],
    reference: Reference,
    law: Callable[..., Vector] = np.add,
) -> Plan:
    """A trajectory `(x*[k], u*[k])` of a model with neurons that its own feedback leads to each set
    point in turn.

    `u* = us + K (x* - xs)` from the model's equilibrium, `(xs, us)` the rest point of the
    reference's value: it gets there at the certified rate; `law(us, K (x* - xs))` is the input
    where it is not the sum. A reference at rest gives zeros.
    """
    points = set_points(model, reference)
    n = model.order
    x = np.zeros(n)
    plan = np.empty_like(points)
    for i, point in enumerate(points):
        u = law(point[n:], k @ (x - point[:n]))
        plan[i] = np.concatenate([x, u])
        x = model.advance(x, model.scaffold_in(u[None])[0])
    return plan


def set_points(model: Model, reference: Reference) -> Plan:
    """The rest point `(x*, u*)` of each reference value: for references that are constant but for
    steps."""
    values, index = np.unique(reference, axis=0, return_inverse=True)
    return np.stack([np.concatenate(equilibrium(model, value)) for value in values])[
        index.reshape(-1)
    ]


def inverse(scaffold: Scaffold, w: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N m"]:
    """`v` with `S(v) = w`, row by row: scalar maps, which are monotone, in a bracket; others by
    damped Newton steps.

    Raises `BadRequest` when the map does not reach `w`.
    """
    from scipy.optimize import elementwise  # slow to load

    def missing(v: Vector, w: Vector) -> Vector:
        return scaffold(v[:, None])[:, 0] - w if scalar else scaffold(v[None])[0] - w

    scalar = w.shape[1] == 1
    if scalar:  # Chandrupatla's method for all rows at once; not a number without a bracket
        with np.errstate(
            invalid="ignore"
        ):  # SciPy takes a square root of rounding where it does not need it
            around = elementwise.bracket_root(missing, -1.0, 1.0, args=(w[:, 0],), maxiter=60)
            v = np.asarray(elementwise.find_root(missing, around.bracket, args=(w[:, 0],)).x)[
                :, None
            ]
    else:  # a reference at rest asks the same at every sample
        values, index = np.unique(w, axis=0, return_inverse=True)
        start = np.zeros(scaffold.inputs)
        enough = 1e-2 * INVERSION_TOLERANCE
        rows = [
            _newton(partial(missing, w=row), scaffold.jacobian, start, enough) for row in values
        ]
        v = np.stack(rows)[index.reshape(-1)]
    v = np.where((w == 0).all(axis=1, keepdims=True), 0.0, v)  # S(0) = 0 holds exactly
    missed = np.abs(scaffold(v) - w).max(axis=1)
    enough = INVERSION_TOLERANCE * max(1.0, float(np.abs(w).max()))
    problem = "the identified nonlinearity does not reach this scaled value"
    _reached(missed.max() <= enough, w[missed.argmax()], problem, ", or raise model.slope_lower")
    return v


def _reached(reached: np.bool_, value: Vector, problem: str, more: str) -> None:
    remedy = f"choose a reference within the reach of the inputs{more}"
    require(bool(reached), "loop.reference", np.round(value, 4).tolist(), problem, remedy)


def _newton(
    missing: Callable[[Vector], Vector],
    slope: Callable[[Vector], np.ndarray],
    point: Vector,
    enough: float,
) -> Vector:
    """Newton steps from `point`, halved until nearer, until `|missing| <= enough` or none comes
    nearer."""
    left = missing(point)
    for _ in range(NEWTON_STEPS):
        if np.linalg.norm(left) <= enough:
            break
        step = np.linalg.lstsq(slope(point), -left, rcond=None)[0]
        trials = (
            (point + share * step, missing(point + share * step)) for share in 0.5 ** np.arange(40)
        )
        nearer = next(
            (trial for trial in trials if np.linalg.norm(trial[1]) < np.linalg.norm(left)), None
        )
        if nearer is None:
            break
        point, left = nearer
    return point
