"""Random systems with neurons, and what their trajectories do: the route that no inequality
enters."""

import numpy as np

from ssm_study.certificates.problem import Neurons, Problem, dual_system
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.structured import StructuredSSM
from ssm_study.signals import Scale
from ssm_study.systems import JacobianBall, StructuredSystem

KNOWN = JacobianBall(alpha=1.0, beta=0.0)


def drawn(
    seed: int,
    n: int = 3,
    q: int = 2,
    size: float = 0.4,
    radius: float = 0.95,
    h: float = 0.0,
    m: int = 1,
):
    """`A` of that radius, neurons of that size, one output that sees them if `h`."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    b = rng.normal(size=(n, m))
    c = rng.normal(size=(1, n))
    d = np.zeros((1, m))
    directions = rng.normal(size=(n, q))
    root = np.sqrt(n)
    e = size * directions / root
    rows = rng.normal(size=(q, n))
    f = size * rows
    input_rows = rng.normal(size=(q, m))
    g = 0.3 * input_rows
    output_row = rng.normal(size=(1, q))
    feedthrough = h * output_row
    scaled_a = a * radius / spectral_radius
    return StructuredSystem(a=scaled_a, b=b, c=c, d=d, e=e, f=f, g=g, h=feedthrough)


def asked(system: StructuredSystem, side: str, ball: JacobianBall, rate: float) -> Problem:
    """The problem of a state feedback or an observer with unit weights and cheap inputs."""
    feeds = side == "state_feedback"
    identity = np.eye(system.order)
    system = system if feeds else dual_system(system)
    neurons = Neurons(e=system.e, f=system.f, g=system.g, observes=not feeds)
    return Problem(
        a=system.a,
        b=system.b,
        neurons=neurons,
        ball=ball,
        rate=rate,
        state_weight=identity,
        input_weight=0.1,
    )


def slopes_of_all(system: StructuredSystem, seed: int, random: int) -> np.ndarray:
    """Every corner of the neurons' slopes, and random ones between."""
    rng = np.random.default_rng(seed)
    inside = rng.uniform(size=(random, system.neurons))
    corners = system.slope_corners()
    parts = [corners, inside]
    return np.concatenate(parts)


def slowest(metric: np.ndarray, steps: list[np.ndarray]) -> float:
    """The largest factor by which any of these matrices stretches, in the metric."""
    factor = np.linalg.cholesky(metric)
    root = factor.T
    inverse = np.linalg.inv(root)
    norms = []
    for step in steps:
        changed = root @ step @ inverse
        norm = float(np.linalg.norm(changed, 2))
        norms.append(norm)
    return max(norms)


def controlled_steps(
    system: StructuredSystem, k: np.ndarray, ball: JacobianBall, slopes: np.ndarray
) -> list:
    """`A + E S F + (B + E S G) J K` at both ends and the centre of the ball."""
    ends = (ball.lower, ball.alpha, ball.upper)
    steps = []
    for row in slopes:
        linear = system.linearise_at_slopes(row)
        steps += [linear.a + slope * linear.b @ k for slope in ends]
    return steps


def observing_steps(
    system: StructuredSystem,
    l_: np.ndarray,
    l_z: np.ndarray,
    ball: JacobianBall,
    slopes: np.ndarray,
) -> list:
    """`A + L J C + E S (F + L_z J C)`, and with H: `A + E S F + L J (C + H S F)`."""
    steps = []
    for row in slopes:
        ends = (ball.lower, ball.alpha, ball.upper)
        for slope in ends:
            linear = system.linearise_at_slopes(row)
            weighted = system.e * row
            neurons_seen = weighted @ l_z @ system.c
            linear_part = l_ @ linear.c
            correction = slope * (linear_part + neurons_seen)
            steps.append(linear.a + correction)
    return steps


def dead_zone() -> MonotoneScaffold:
    """An input map that is flatter about zero."""
    breakpoints = np.array([[-0.2, 0.2]])
    slopes = np.array([[1.0, 0.4, 0.9]])
    return MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)


def physical_units() -> Scale:
    """Scales and equilibria that are neither one nor zero."""
    input_scale = np.array([2.0])
    output_scale = np.array([3.0])
    input_equilibrium = np.array([0.5])
    output_equilibrium = np.array([1.0])
    return Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )


def model(neurons: tuple[str, ...] = ("tanh", "softplus"), seed: int = 0) -> StructuredSSM:
    """Three states, contracting because A and E S F are small; S_u has a dead zone's slopes."""
    rng = np.random.default_rng(seed)
    q = len(neurons)
    a = rng.normal(size=(3, 3))
    norm = np.linalg.norm(a, 2)
    b = rng.normal(size=(3, 1))
    c = rng.normal(size=(1, 3))
    d = np.zeros((1, 1))
    columns = rng.normal(size=(3, q))
    e = 0.2 * columns
    rows = rng.normal(size=(q, 3))
    f = 0.4 * rows
    input_rows = rng.normal(size=(q, 1))
    g = 0.3 * input_rows
    h = np.zeros((1, q))
    bias = rng.normal(size=q)
    scaled_a = 0.6 * a / norm
    identity = np.eye(1)
    scaffold_out = LinearScaffold(gain=identity)
    return StructuredSSM(
        a=scaled_a,
        b=b,
        c=c,
        d=d,
        e=e,
        f=f,
        g=g,
        h=h,
        bias=bias,
        neurons=neurons,
        scaffold_in=dead_zone(),
        scaffold_out=scaffold_out,
        scale=physical_units(),
        step_s=0.01,
    )
