"""The promises of a certificate, measured: contraction in its metric, the separation bound,
Gramians on the way."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssm_study.bounds.gramians import bound_local_controllability, controllability_gramian
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, Observer, StateFeedback
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import dual_system
from ssm_study.loop.certified_bound import count_bound_violations, distance_bound, metric_distances
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.signals import Scale
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall, StateSpace

SEEDS = st.integers(0, 10**6)


def kinked(rng: np.random.Generator, channels: int, lower: float) -> MonotoneScaffold:
    drawn_points = rng.normal(size=(channels, 6))
    breakpoints = np.sort(drawn_points, axis=1)
    slopes = rng.uniform(lower, 1, size=(channels, 7))
    return MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)


def random_ssm(seed: int, channels: int = 1, output_floor: float = 0.6) -> SSM:
    """Order 4, feedthrough D, kinked scaffoldings on both sides, marginally stable."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(4, 4))
    eigenvalues = np.linalg.eigvals(a)
    moduli = np.abs(eigenvalues)
    spectral_radius = moduli.max()
    b = rng.normal(size=(4, channels))
    c = rng.normal(size=(channels, 4))
    d = rng.normal(size=(channels, channels))
    scaled = a / spectral_radius
    linear = StateSpace(a=scaled, b=b, c=c, d=d)
    scaffold_in = kinked(rng, channels, 0.3)
    scaffold_out = kinked(rng, channels, output_floor)
    scale = Scale.identity(channels, channels)
    return SSM(
        linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out, scale=scale, step_s=0.1
    )


def certified_design(model: SSM, method: type = RiccatiSynthesis) -> Design:
    balls = certified_balls(model)
    frontier = controller_frontier(model.linear, balls.input)
    controller = frontier.rate_limit
    system = dual_system(model.linear)
    frontier = controller_frontier(system, balls.output)
    observer = frontier.rate_limit
    synthesis = method(rate_controller=0.5 * controller, rate_observer=0.5 * observer)
    design = synthesis.design(model, balls)
    assert design.certified, design
    return design


def closed_loop(
    model: SSM, design: Design, seed: int, cases: int = 4, steps: int = 60
) -> tuple[np.ndarray, np.ndarray]:
    """States and estimates of the noise-free model under `u = K xh`, as [Z26] eq. (14) writes
    it."""
    rng = np.random.default_rng(seed)
    shape = (cases, 4)
    x = rng.normal(size=shape)
    xh = rng.normal(size=shape)
    states = []
    estimates = []
    for _ in range(steps):
        states.append(x)
        estimates.append(xh)
        state_feedback_k = design.state_feedback.k
        feedback = xh @ state_feedback_k.T
        ubar = model.scaffold_in(feedback)
        scaled = model.scaled_output_at(xh, ubar)
        plant_output = model.scaled_output_at(x, ubar)
        innovation = scaled - plant_output
        x = model.next_state(x, ubar)
        observer_l = design.observer.l
        predicted = model.next_state(xh, ubar)
        correction = innovation @ observer_l.T
        xh = predicted + correction
    all_states = np.stack(states, axis=1)
    all_estimates = np.stack(estimates, axis=1)
    return all_states, all_estimates


METHODS_OF_GAINS = [RiccatiSynthesis, ClosedFormSynthesis]
METHODS = st.sampled_from(METHODS_OF_GAINS)


CHANNELS = st.integers(1, 2)


@settings(max_examples=15)
@given(SEEDS, CHANNELS, METHODS)
def test_the_separation_bound_holds_on_the_model(seed: int, channels: int, method: type) -> None:
    """Nonlinear S_y and D != 0 included; and the observer's error shrinks by its own rate."""
    model = random_ssm(seed, channels)
    design = certified_design(model, method)
    x, xh = closed_loop(model, design, seed)
    assert isinstance(design.state_feedback, StateFeedback)
    assert isinstance(design.observer, Observer)
    violations = count_bound_violations(x, xh, design.state_feedback, design.observer)
    assert violations == 0
    _, error = metric_distances(x, xh, design.state_feedback, design.observer)
    contraction = design.observer.contraction_factor
    earlier = error[:, :-1]
    contracted = contraction * earlier
    first = error[:, :1]
    rounding = 1e-12 * first
    widened = contracted * (1 + 1e-9)
    upper_limit = widened + rounding
    later = error[:, 1:]
    assert (later <= upper_limit).all()


def test_a_rate_that_is_not_certified_breaks_the_bound() -> None:
    """Negative control: the same gains with claimed rates far beyond the certified ones."""
    model = random_ssm(3)
    design = certified_design(model)
    x, xh = closed_loop(model, design, 3)
    assert isinstance(design.state_feedback, StateFeedback)
    assert isinstance(design.observer, Observer)
    controller = replace(design.state_feedback, rate=0.95)
    observer = replace(design.observer, rate=0.999)
    bold = (controller, observer)
    violations = count_bound_violations(x, xh, *bold)
    assert violations > 0


def test_the_bound_starts_at_the_initial_distance_and_is_not_vacuous() -> None:
    model = random_ssm(5)
    design = certified_design(model)
    x, xh = closed_loop(model, design, 5, steps=200)
    assert isinstance(design.state_feedback, StateFeedback)
    assert isinstance(design.observer, Observer)
    d, e = metric_distances(x, xh, design.state_feedback, design.observer)
    d0 = d[:, 0]
    e0 = e[:, 0]
    bound = distance_bound(d0, e0, 200, design.state_feedback, design.observer)
    actual = bound[:, 0]
    expected = d[:, 0]
    np.testing.assert_array_equal(actual, expected)
    largest = bound.max(axis=1)
    upper_limit = 1e-3 * largest
    last = bound[:, -1]
    assert (last < upper_limit).all()


def steps_in(metric: np.ndarray, part: StateFeedback, count: int = 400) -> np.ndarray:
    """`|A_J v| / |v|` in the metric, over random directions and slopes at both ends of the ball."""
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(metric).T
    ratios = []
    for _ in range(count):
        v = rng.normal(size=len(metric))
        signs = [-1, 1]
        sign = rng.choice(signs)
        deviation = part.beta * sign
        slope = part.alpha + deviation
        feedback = part.k @ v
        driven = slope * part.b @ feedback
        free_part = part.a @ v
        step = root @ (free_part + driven)
        norm = np.linalg.norm(step)
        norm_before = np.linalg.norm(root @ v)
        ratios.append(norm / norm_before)
    return np.array(ratios)


@settings(max_examples=15)
@given(SEEDS)
def test_distances_shrink_by_the_root_of_one_minus_the_rate(seed: int) -> None:
    design = certified_design(random_ssm(seed))
    part = design.state_feedback
    assert isinstance(part, StateFeedback)
    metric = np.linalg.inv(part.p)
    ratios = steps_in(metric, part)
    largest = ratios.max()
    upper_limit = part.contraction_factor * (1 + 1e-7)
    assert largest <= upper_limit


def test_the_metric_is_the_inverse_of_p_and_not_p() -> None:
    """The printed proof contracts `delta^T P delta`; for this certificate that grows. The LMI is
    the dual form."""
    ratios = []
    for part in _feedbacks():
        steps = steps_in(part.p, part)
        ratios.append(steps.max() / part.contraction_factor)
    worst = max(ratios)
    assert worst > 1.05


def shrinks_slower_than_the_square(part: StateFeedback) -> bool:
    """Whether a step leaves more of the distance than `1 - rho`."""
    metric = np.linalg.inv(part.p)
    largest = steps_in(metric, part).max()
    return largest > 1.02 * (1 - part.rate)


def test_the_rate_is_of_the_square_and_not_of_the_distance() -> None:
    """[Z26]'s lemma reuses rho as the distance factor; the factor is `sqrt(1 - rho)`, larger than
    `1 - rho`."""
    assert any(map(shrinks_slower_than_the_square, _feedbacks()))


def _feedbacks() -> list[StateFeedback]:
    designs = [certified_design(random_ssm(seed)) for seed in range(6)]
    parts = [design.state_feedback for design in designs]
    return [part for part in parts if isinstance(part, StateFeedback)]


def test_singular_values_are_not_enough() -> None:
    """A falling S_u has singular values in [mu, nu] too; the certificate for the rising ball breaks
    on it."""
    a = np.array([[0.99]])
    shape = (1, 1)
    b = np.ones(shape)
    c = np.ones(shape)
    d = np.zeros(shape)
    linear = StateSpace(a=a, b=b, c=c, d=d)
    rising = JacobianBall.from_slopes(0.5, 1.0)
    falling = JacobianBall.from_slopes(-1.0, -0.5)
    method = ClosedFormSynthesis(rate_controller=0.5, rate_observer=0.5)
    up = method.state_feedback(linear, rising)
    down = method.state_feedback(linear, falling)
    assert isinstance(up, StateFeedback)
    assert isinstance(down, StateFeedback)
    gain = up.k[0, 0]
    change = 0.75 * gain
    difference = abs(0.99 - change)
    assert difference > 1  # the same gain on the falling map: unstable
    np.testing.assert_allclose(down.k, -up.k, rtol=1e-12)  # the ball with sign gives the right gain
    assert down.certified


def assert_between(along: np.ndarray, linear: np.ndarray, ball: JacobianBall) -> None:
    """The Gramian lies between the linear one times the squares of smallest and largest slope."""
    sizes = np.abs(linear)
    slack = 1e-9 * sizes.max()
    lower_bound = ball.lower**2 * linear
    above_lower = np.linalg.eigvalsh(along - lower_bound)
    upper_bound = ball.upper**2 * linear
    below_upper = np.linalg.eigvalsh(upper_bound - along)
    assert above_lower[0] >= -slack
    assert below_upper[0] >= -slack


@given(SEEDS, CHANNELS)
def test_gramians_along_trajectories_stay_between_their_bounds(seed: int, channels: int) -> None:
    """`mu^2 W' <= W <= nu^2 W'` for the variational dynamics along a random trajectory ([Z26]
    Propositions 1, 2)."""
    model = random_ssm(seed, channels)
    rng = np.random.default_rng(seed)
    steps = 4
    balls = certified_balls(model)
    shape = (4, 4)
    w = np.zeros(shape)
    o = np.zeros(shape)
    power = np.eye(4)
    for _ in range(steps):
        input_point = rng.normal(size=channels)
        j_in = model.scaffold_in.jacobian(input_point)
        output_point = rng.normal(size=channels)
        j_out = model.scaffold_out.jacobian(output_point)
        reached = power @ model.linear.b
        into = reached @ j_in
        mapped_output = j_out @ model.linear.c
        out = mapped_output @ power
        w = w + into @ into.T
        o = o + out.T @ out
        power = power @ model.linear.a
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    linear_gramian = controllability_gramian(a, b, steps)
    assert_between(w, linear_gramian, balls.input)
    gramian = controllability_gramian(a.T, c.T, steps)
    assert_between(o, gramian, balls.output)
    local = bound_local_controllability(a, b, balls.input)
    assert local.holds
    eigenvalues = np.linalg.eigvalsh(w)
    upper_limit = eigenvalues[0] + 1e-9
    assert local.lower <= upper_limit
    upper_limit = local.upper * (1 + 1e-9)
    assert eigenvalues[-1] <= upper_limit
    dual_bound = bound_local_controllability(a.T, c.T, balls.output)
    assert dual_bound.holds


WITHOUT_AUTHORITY = [((0.0, 1.0), 1.0), ((-0.5, 1.0), 1.0), ((0.5, 1.0), 0.0)]


@pytest.mark.parametrize(("slopes", "b"), WITHOUT_AUTHORITY)
def test_local_controllability_is_not_claimed_without_authority(
    slopes: tuple[float, float], b: float
) -> None:
    modes = [0.9, 0.5]
    a = np.diag(modes)
    c = np.ones((1, 2))
    d = np.zeros((1, 1))
    rows = [[b], [1.0]]
    gains = np.array(rows)
    linear = StateSpace(a=a, b=gains, c=c, d=d)
    ball = JacobianBall.from_slopes(*slopes)
    local = bound_local_controllability(linear.a, linear.b, ball)
    assert not local.holds
    assert local.lower == 0.0
