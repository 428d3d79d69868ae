"""Where a structured model's training starts: linear poles, random neurons, and the nearest model
that contracts."""

import numpy as np
from jaxtyping import Float
from scipy import linalg

from ssm_study.models.contracting import Core, in_metric, parameters, projected
from ssm_study.models.spec import arx, impulse_response, realise
from ssm_study.models.structured import phi, shapes
from ssm_study.training.structured_problem import CORE, Residuals, Theta, loss

ARX_LAGS = 10
SLOWEST = 0.998  # a starting pole outside is pulled inside this radius
SCREENED = 24  # sets of random poles, of which the best is taken
LONGEST = 600.0  # samples: the slowest time constant that is drawn
RESIDUE_RIDGE = 1e-6  # relative: two poles that are nearly the same
SMALL = 0.05  # of E: the neurons start as a perturbation of the linear fit
RESTS_WITHIN = 1.0  # of the bias of a neuron whose argument has unit size


def linear_start(
    problem: Residuals, order: int, feedthrough: bool, rng: np.random.Generator
) -> Theta:
    """ARX by least squares, a balanced realisation of its impulse response, its poles inside the
    unit circle; q = 0."""
    u, y, _ = problem.records
    pairs = [(a[there], b[there]) for a, b, there in zip(u, y, problem.records.scored, strict=True)]
    samples = [np.concatenate(side) for side in zip(*pairs, strict=True)]
    if problem.integrating_output:
        pairs = [(u[:-1], np.diff(y, axis=0)) for u, y in pairs]
    lags = min(ARX_LAGS, min(len(u) for u, _ in pairs) // 4)
    system = realise(impulse_response(*arx(pairs, lags, feedthrough)), order, rng)
    radius = max(float(np.abs(np.linalg.eigvals(system.a)).max()), 1e-9)
    (n, m), p = system.b.shape, len(system.c)
    none = {name: np.zeros(shape) for name, shape in shapes(n, m, p, 0).items()}  # no neurons yet
    start = none | {
        "a": system.a * min(1.0, SLOWEST / radius),
        "b": system.b,
        "c": system.c,
        "d": system.d if feedthrough else none["d"],
        "x0": np.zeros((len(u), n + p * problem.integrating_output)),
        "scaffold_in": problem.lift.start(samples[0]),
        "scaffold_out": problem.read.start(samples[1]),
    }
    return unit_states(problem, start)


def unit_states(problem: Residuals, theta: Theta) -> Theta:
    """The same linear model in coordinates in which each state has a root mean square of one over
    the records.

    Balanced states differ a thousandfold in size, and a step of Levenberg-Marquardt that suits one
    overturns another.
    """
    states = problem.simulated(theta)[2][:, :-1][problem.records.scored]
    size = np.sqrt(np.mean(states**2, axis=0)) + 1e-9
    x0 = theta["x0"].copy()
    x0[:, : len(size)] /= size
    turned = {
        "a": theta["a"] * size / size[:, None],
        "b": theta["b"] / size[:, None],
        "c": theta["c"] * size,
    }
    return theta | turned | {"x0": x0}


def screened_poles(
    problem: Residuals, begun: Theta, estimates: bool, rng: np.random.Generator
) -> Theta:
    """`begun` with the best of random sets of poles in its place: that whose residues explain the
    records best.

    With poles and B given the output is linear in C, and in C times the free decay of a record's
    unknown start: two least-squares problems. ARX weighs the next sample; where that hardly depends
    on the input it misses slow modes.
    """
    order = len(begun["a"])
    found = [
        begun | _residues(problem, begun, _drawn_poles(order, rng), estimates, rng)
        for _ in range(SCREENED)
    ]
    return min(found, key=lambda one: loss(problem, one, ()))


def _drawn_poles(order: int, rng: np.random.Generator) -> Float[np.ndarray, "n n"]:
    """Time constants of 1 to `LONGEST` samples, evenly in their logarithm; one in two begins a
    pair."""
    blocks: list[np.ndarray] = []
    while (left := order - sum(map(len, blocks))) > 0:
        radius = np.exp(-1.0 / np.exp(rng.uniform(0.0, np.log(LONGEST))))
        turn = np.eye(1)
        if left > 1 and rng.uniform() < 0.5:
            angle = rng.uniform(0.0, 0.5 * np.pi) * rng.uniform() ** 2
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        blocks.append(radius * turn)
    return linalg.block_diag(*blocks)


def _residues(
    problem: Residuals,
    begun: Theta,
    a: Float[np.ndarray, "n n"],
    estimates: bool,
    rng: np.random.Generator,
) -> Theta:
    """`a, b, c, d, x0` of these poles, states of unit size."""
    (u, y, weight), n, b = problem.records, len(a), rng.normal(size=begun["b"].shape)
    (count, samples, _), rest = u.shape, begun | {"x0": 0.0 * begun["x0"], "d": 0.0 * begun["d"]}
    x = problem.simulated(rest | {"a": a, "b": b})[2][:, :-1]
    size = np.sqrt(np.mean(x**2, axis=(0, 1))) + 1e-12
    x = x / size
    a = a * size / size[:, None]
    b = b / size[:, None]
    y = y / problem.read.freeze(begun["scaffold_out"])(
        np.ones_like(y)
    )  # all slopes of S_y are equal here
    decay = _powers(a, samples)
    own = linalg.block_diag(*[decay.sum(axis=2)] * count).reshape(
        count, samples, -1
    )  # spans what a start can do
    regressors = weight * (np.concatenate([x, own], axis=-1) if estimates else x)
    c = _least(regressors.reshape(count * samples, -1), (weight * y).reshape(count * samples, -1))[
        :n
    ].T
    x0 = np.zeros((count, n))
    if estimates:
        seen = (weight[..., None] * (c @ decay)).reshape(count, -1, n)
        missing = (weight * (y - x @ c.T)).reshape(count, -1, 1)
        x0 = np.stack([_least(o, left)[:, 0] for o, left in zip(seen, missing, strict=True)])
    return rest | {"a": a, "b": b, "c": c, "x0": x0}


def _powers(a: Float[np.ndarray, "n n"], count: int) -> Float[np.ndarray, "T n n"]:
    """`A^k` for k below `count`, by doubling."""
    powers = np.eye(len(a))[None]
    ahead = a
    while len(powers) < count:
        powers = np.concatenate([powers, powers @ ahead])
        ahead = ahead @ ahead
    return powers[:count]


def _least(x: Float[np.ndarray, "N k"], y: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "k p"]:
    normal = x.T @ x
    return linalg.solve(
        normal + RESIDUE_RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal)), x.T @ y
    )


def with_neurons(problem: Residuals, theta: Theta, count: int, rng: np.random.Generator) -> Theta:
    """States of unit size, then F and the bias random, so that neurons bend within the data, E
    small, G and H zero."""
    theta = unit_states(problem, theta)
    (n, m), p = theta["b"].shape, len(theta["c"])
    f = rng.normal(size=(count, n))
    f *= rng.uniform(0.7, 3.0, (count, 1)) / np.linalg.norm(f, axis=1, keepdims=True)
    e = SMALL * rng.normal(size=(n, count))
    bias = RESTS_WITHIN * rng.uniform(-1.0, 1.0, count)
    e *= np.linalg.norm(theta["b"])
    return theta | {
        "e": e,
        "f": f,
        "g": np.zeros((count, m)),
        "h": np.zeros((p, count)),
        "bias": bias,
    }


def contracting_start(problem: Residuals, theta: Theta, rate: float) -> Theta:
    """The nearest model on the path of `contracting.projected`, in its metric's coordinates and
    free parameters."""
    (v, _, states), scored = problem.simulated(theta), problem.records.scored
    z = states[:, :-1][scored] @ theta["f"].T + v[scored] @ theta["g"].T + theta["bias"]
    found = projected(
        Core(*(theta[name] for name in CORE)), phi(problem.neurons, z, "slope").mean(axis=0), rate
    )
    free = parameters(in_metric(found), rate)
    n = len(theta["a"])
    x0 = theta["x0"].copy()
    x0[:, :n] = x0[:, :n] @ found.t.T
    moved = {"b": found.t @ theta["b"], "c": linalg.solve(found.t.T, theta["c"].T).T, "x0": x0}
    return theta | moved | free._asdict() | {"log_d": np.log(found.d)}
