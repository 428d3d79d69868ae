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
    e = size * directions / np.sqrt(n)
    f = size * rng.normal(size=(q, n))
    g = 0.3 * rng.normal(size=(q, m))
    feedthrough = h * rng.normal(size=(1, q))
    return StructuredSystem(
        a=a * radius / spectral_radius, b=b, c=c, d=d, e=e, f=f, g=g, h=feedthrough
    )


def asked(system: StructuredSystem, side: str, ball: JacobianBall, rate: float) -> Problem:
    """The problem of a state feedback or an observer with unit weights and cheap inputs."""
    feeds = side == "state_feedback"
    one = np.eye(system.order)
    system = system if feeds else dual_system(system)
    neurons = Neurons(e=system.e, f=system.f, g=system.g, observes=not feeds)
    return Problem(
        a=system.a,
        b=system.b,
        neurons=neurons,
        ball=ball,
        rate=rate,
        state_weight=one,
        input_weight=0.1,
    )


def slopes_of_all(system: StructuredSystem, seed: int, random: int) -> np.ndarray:
    """Every corner of the neurons' slopes, and random ones between."""
    rng = np.random.default_rng(seed)
    inside = rng.uniform(size=(random, system.neurons))
    return np.concatenate([system.slope_corners(), inside])


def slowest(metric: np.ndarray, steps: list[np.ndarray]) -> float:
    """The largest factor by which any of these matrices stretches, in the metric."""
    root = np.linalg.cholesky(metric).T
    inverse = np.linalg.inv(root)
    norms = [float(np.linalg.norm(root @ step @ inverse, 2)) for step in steps]
    return max(norms)


def controlled_steps(
    system: StructuredSystem, k: np.ndarray, ball: JacobianBall, slopes: np.ndarray
) -> list:
    """`A + E S F + (B + E S G) J K` at both ends and the centre of the ball."""
    ends = (ball.lower, ball.alpha, ball.upper)
    at = [system.linearise_at_slopes(row) for row in slopes]
    return [linear.a + slope * linear.b @ k for linear in at for slope in ends]


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
        for slope in (ball.lower, ball.alpha, ball.upper):
            linear = system.linearise_at_slopes(row)
            neurons_seen = (system.e * row) @ l_z @ system.c
            steps.append(linear.a + slope * (l_ @ linear.c + neurons_seen))
    return steps


def model(neurons: tuple[str, ...] = ("tanh", "softplus"), seed: int = 0) -> StructuredSSM:
    """Three states, contracting because A and E S F are small; S_u has a dead zone's slopes."""
    rng = np.random.default_rng(seed)
    q = len(neurons)
    a = rng.normal(size=(3, 3))
    norm = np.linalg.norm(a, 2)
    b = rng.normal(size=(3, 1))
    c = rng.normal(size=(1, 3))
    d = np.zeros((1, 1))
    e = 0.2 * rng.normal(size=(3, q))
    f = 0.4 * rng.normal(size=(q, 3))
    g = 0.3 * rng.normal(size=(q, 1))
    h = np.zeros((1, q))
    bias = rng.normal(size=q)
    breakpoints = np.array([[-0.2, 0.2]])
    slopes = np.array([[1.0, 0.4, 0.9]])
    scaffold_in = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    scaffold_out = LinearScaffold(gain=np.eye(1))
    scale = Scale(
        input_scale=np.array([2.0]),
        output_scale=np.array([3.0]),
        input_equilibrium=np.array([0.5]),
        output_equilibrium=np.array([1.0]),
    )
    return StructuredSSM(
        a=0.6 * a / norm,
        b=b,
        c=c,
        d=d,
        e=e,
        f=f,
        g=g,
        h=h,
        bias=bias,
        neurons=neurons,
        scaffold_in=scaffold_in,
        scaffold_out=scaffold_out,
        scale=scale,
        step_s=0.01,
    )
