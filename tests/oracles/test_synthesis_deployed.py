"""The certificates of the gains that are deployed, each by several routes, and the cases that must
be refused."""

import json
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_cases import BALLS as MOTOR_BALLS
from loop_cases import motor_model
from scipy.linalg import block_diag, solve_discrete_lyapunov

from ssm_study.bounds.frequency import hinf_norm
from ssm_study.certificates.certificate import Design, Observer, StateFeedback
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.deployed_rate import largest_rate
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.robustness.sensitivity import error_to_input_response, noise_gain
from ssm_study.synthesis.deployed import add_gain_certificates, certificate_at_largest_rate
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_search import INPUT_ALONE, certify_largest_radius
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StateSpace

SEEDS = st.integers(0, 10**6)


def loop(seed: int, inputs: int = 1, order: int = 3) -> tuple[StateSpace, JacobianBalls, Design]:
    """A random stable model with a certified pair of gains."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    b = rng.normal(size=(order, inputs))
    c = rng.normal(size=(inputs, order))
    d = np.zeros((inputs, inputs))
    scaled = 0.95 * a / spectral_radius
    linear = StateSpace(a=scaled, b=b, c=c, d=d)
    jacobian_ball = JacobianBall.from_slopes(0.4, 1.0)
    output = JacobianBall(alpha=0.8, beta=0.0)
    balls = JacobianBalls(input=jacobian_ball, output=output)
    synthesis = RiccatiSynthesis(rate_controller=0.15, rate_observer=0.15, input_weight=0.3)
    design = synthesis.design(_Model(linear), balls)
    return linear, balls, design


class _Model:
    def __init__(self, linear: StateSpace) -> None:
        self.linear = linear


def known(linear: StateSpace, balls: JacobianBalls, design: Design) -> VerificationContext:
    return VerificationContext(system=linear, controlled=linear, balls=balls, gains=design.gains)


def feasible(part: StateFeedback, rate: float) -> bool:
    """Theorem 1 for the given gain by a solver: `P` alone is unknown, sigma is one."""
    n, m = part.b.shape
    p = cp.Variable((n, n), symmetric=True)
    t = cp.Variable()
    closed_loop = part.a + part.alpha * part.b @ part.k
    coupling = closed_loop @ p
    zero = np.zeros((n, m))
    difference = (1 - rate) * p - part.b @ part.b.T
    first_row = [difference, coupling, zero]
    second_row = [coupling.T, p, part.beta * p @ part.k.T]
    third_row = [zero.T, part.beta * part.k @ p, np.eye(m)]
    lmi = cp.bmat([first_row, second_row, third_row])
    a = cp.Maximize(t)
    size = 2 * n + m
    identity = np.eye(size)
    b = [lmi >> t * identity, t <= 1]
    problem = cp.Problem(a, b)
    problem.solve(solver="CLARABEL")
    return problem.status in ("optimal", "optimal_inaccurate") and float(t.value) > 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_largest_rate_is_where_the_solver_stops_finding_a_metric(seed: int) -> None:
    design = loop(seed, order=2)[2]
    part = design.state_feedback
    assert isinstance(part, StateFeedback)
    jacobian_ball = JacobianBall(alpha=part.alpha, beta=part.beta)
    limit = largest_rate(part.a, part.b, part.k, jacobian_ball)
    assert limit > part.rate
    difference = limit - 0.01 * (1 - limit)
    assert feasible(part, difference)
    assert not feasible(part, limit + 0.01 * (1 - limit))


@settings(max_examples=15)
@given(SEEDS, st.integers(1, 2))
def test_sampled_slopes_never_contract_slower_than_proved(seed: int, inputs: int) -> None:
    """In the stored metric, over both ends of the slopes (for several inputs over rotations as
    well)."""
    _, _, design = loop(seed, inputs)
    rng = np.random.default_rng(seed)
    for part in (design.state_feedback, design.observer):
        assert isinstance(part, StateFeedback | Observer)
        again = certificate_at_largest_rate(part)
        assert again is not None
        assert again.certified
        np.testing.assert_array_equal(again.gain, part.gain)
        assert part.rate < again.rate < again.rate_limit
        metric = again.q if isinstance(again, Observer) else np.linalg.inv(again.p)
        root = np.linalg.cholesky(metric).T
        worst = 0.0
        for _ in range(60):
            rotation = np.linalg.qr(rng.normal(size=(inputs, inputs)))[0]
            turn = rotation * rng.choice([-1, 1])
            centre = part.alpha * np.eye(inputs)
            jacobian = centre + part.beta * turn
            moved = (
                part.b @ jacobian @ part.k
                if isinstance(part, StateFeedback)
                else part.l @ jacobian @ part.c
            )
            inverse = np.linalg.inv(root)
            step = root @ (part.a + moved) @ inverse
            norm = np.linalg.norm(step, 2)
            worst = max(worst, norm)
        upper_limit = again.contraction_factor * (1 + 1e-9)
        assert worst <= upper_limit


def test_a_rate_beyond_the_largest_is_not_proved_and_a_gain_without_ball_reaches_its_radius() -> (
    None
):
    _, _, design = loop(4)
    part = design.state_feedback
    assert isinstance(part, StateFeedback)
    ball = JacobianBall(alpha=part.alpha, beta=part.beta)
    centre_gain = ball.alpha * part.b @ part.k
    closed = part.a + centre_gain
    jacobian_ball = JacobianBall(alpha=ball.alpha, beta=0.0)
    eigenvalues = np.linalg.eigvals(closed)
    spectral_radius = np.abs(eigenvalues).max()
    expected = 1 - spectral_radius**2
    found_rate = largest_rate(part.a, part.b, part.k, jacobian_ball)
    assert found_rate == pytest.approx(expected, rel=1e-12)
    again = certificate_at_largest_rate(part)
    assert again is not None
    rate = again.rate + 0.01 * (1 - again.rate)
    bold = replace(again, rate=rate)
    assert not type(bold).holds(**bold.variables)


@pytest.mark.parametrize(
    "slow", [0.1, 0.11, 0.18, 0.2, 0.22, 0.5]
)  # some exceed themselves as exp(log(slow))
def test_a_mode_that_the_gain_does_not_reach_does_not_hide_what_the_ball_costs(slow: float) -> None:
    """Beside it `x+ = (slow - 0.1) x`, a gain of 0.5 and slopes 1 -+ 0.3: `0.15 / (r - slow + 0.1)
    = 1`."""
    a = np.diag([slow, slow + 0.4])
    b = np.array([[0.0], [1.0]])
    k = np.array([[0.0, -0.5]])
    jacobian_ball = JacobianBall(alpha=1.0, beta=0.3)
    rate = largest_rate(a, b, k, jacobian_ball)
    expected = 1 - (slow + 0.05) ** 2
    assert rate == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_without_a_ball_the_tolerance_is_small_gain(seed: int) -> None:
    """`1 / ||T_ue||_inf`, to the 0.1 % by which what is stored lies inside."""
    linear, balls, design = loop(seed)
    alpha = balls.input.alpha
    jacobian_ball = JacobianBall(alpha=alpha, beta=0.0)
    sharp = JacobianBalls(input=jacobian_ball, output=balls.output)
    context = known(linear, sharp, design)
    certificate = certify_largest_radius(context)
    slope_in = balls.input.alpha
    slope_out = balls.output.alpha
    system = error_to_input_response(linear, design.gain_pair, slope_in, slope_out)
    peak = hinf_norm(system)
    assert certificate is not None
    assert certificate.certified
    assert certificate.kappa * peak == pytest.approx(0.999, rel=1e-5)
    assert certificate.tolerated_gain == certificate.kappa


@pytest.mark.parametrize(("seed", "order"), [(0, 0), (1, 0), (2, 1)])
def test_a_solver_finds_the_same_tolerance(seed: int, order: int) -> None:
    """The block matrix written out anew, one semidefinite program in coordinates of the loop's
    Gramian."""
    linear, balls, design = loop(seed, order=2)
    first_order = np.array([[0.5, 1.0], [0.2, 1.0]])
    weight = first_order if order else np.eye(1)
    context = known(linear, balls, design)
    certificate = certify_largest_radius(context, replace(INPUT_ALONE, input=weight))
    assert certificate is not None
    expected = tolerance_of_a_solver(linear, certificate, weight)
    assert certificate.kappa == pytest.approx(expected, rel=5e-3)


def loop_with_weight(
    linear: StateSpace, proved: MeasuredDiscs, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """State, observer error and weight as one system, `a, b` and what map and weight see of it."""
    k = proved.k
    l = proved.l  # noqa: E741
    alpha = proved.alpha
    order = len(weight) - 1
    n = 2
    a_w = weight[:order, :order]
    b_w = weight[:order, order:]
    c_w = weight[order:, :order]
    d_w = weight[order:, order:]
    controlled = alpha * linear.b @ k
    observer_loop = linear.a + 0.8 * l @ linear.c
    a = block_diag(linear.a + controlled, observer_loop, a_w)
    a[:n, n : 2 * n] = controlled
    weighted_input = b_w @ k
    a[2 * n :, : 2 * n] = np.hstack([weighted_input, weighted_input])
    plant_rows = [linear.b, np.zeros((n, 1))]
    observer_rows = [np.zeros((n, 1)), -l]
    weight_rows = [np.zeros((order, 2))]
    b = np.block([plant_rows, observer_rows, weight_rows])
    rest = np.zeros((1, order))
    seen_by_map = np.hstack([k, k, rest])
    weighted_output = d_w @ k
    seen_by_weight = np.hstack([weighted_output, weighted_output, c_w])
    return a, b, seen_by_map, seen_by_weight


def tolerance_of_a_solver(linear: StateSpace, proved: MeasuredDiscs, weight: np.ndarray) -> float:
    """Largest tolerance of the proof's gains and ball by one semidefinite program."""
    a, b, c_u, c_w = loop_with_weight(linear, proved, weight)
    gramian = solve_discrete_lyapunov(a, b @ b.T)
    regularised = gramian + 1e-9 * np.eye(len(a))
    t = np.linalg.cholesky(regularised)
    balanced_state = np.linalg.solve(t, a @ t)
    balanced_input = np.linalg.solve(t, b)
    ab = np.hstack([balanced_state, balanced_input])
    p = cp.Variable((len(a), len(a)), symmetric=True)
    mu = cp.Variable(nonneg=True)
    lam = cp.Variable(nonneg=True)
    seen_by_map = c_u @ t
    seen_by_weight = c_w @ t
    of_map = lam * proved.beta**2 * seen_by_map.T @ seen_by_map
    of_weight = mu * seen_by_weight.T @ seen_by_weight
    storage = p - of_map - of_weight
    zero = np.zeros((len(a), 1))
    unit = np.ones((1, 1))
    map_row = [zero.T, cp.reshape(lam, (1, 1), "C"), 0 * unit]
    supply = cp.bmat([[storage, zero, zero], map_row, [zero.T, 0 * unit, unit]])
    dissipated = supply - ab.T @ p @ ab
    problem = cp.Problem(cp.Maximize(mu), [dissipated >> 0, p >> 0])
    problem.solve(solver="CLARABEL")
    return float(np.sqrt(mu.value))


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_slopes_and_mismatch_that_vary_at_will_never_diverge_below_the_tolerance(seed: int) -> None:
    """Worst slopes chosen greedily at every sample, and `e` as large as its gain allows at each:
    energy decays.

    The stored P is the witness: it falls by what the supply leaves, for every slope and every `|e|
    <= s |u|`.
    """
    linear, balls, design = loop(seed)
    context = known(linear, balls, design)
    certificate = certify_largest_radius(context)
    assert certificate is not None
    rng = np.random.default_rng(seed)
    k = certificate.k
    b = certificate.b
    l = certificate.l  # noqa: E741
    xi = rng.normal(size=6)
    energies = []
    for _ in range(100):
        energies.append(xi @ certificate.p @ xi)
        estimate = xi[:3] + xi[3:]
        u = k @ estimate
        options = []
        difference = certificate.alpha - certificate.beta
        for slope in (difference, certificate.alpha, certificate.alpha + certificate.beta):
            for sign in (-1, 0, 1):
                e = sign * certificate.kappa * u
                applied = slope * b @ u
                x = linear.a @ xi[:3] + applied
                output_error = 0.8 * l @ (linear.c @ xi[3:])
                eps = linear.a @ xi[3:] + output_error - l @ e
                options.append(np.concatenate([x, eps]))
        xi = max(options, key=lambda after: after @ certificate.p @ after)
    energies = np.array(energies)
    upper_limit = energies[:-1]
    assert (energies[1:] < upper_limit).all()


def test_far_above_the_tolerance_such_a_mismatch_diverges_and_is_not_proved() -> None:
    """Negative control: the same adversary with a mismatch of the size at which constant slopes
    lose the loop."""
    linear, balls, design = loop(0)
    context = known(linear, balls, design)
    certificate = certify_largest_radius(context)
    assert certificate is not None
    slopes = (0.4, 0.7, 1.0)
    peaks = [
        hinf_norm(error_to_input_response(linear, design.gain_pair, slope, 0.8)) for slope in slopes
    ]
    assert (
        certificate.kappa * max(peaks) <= 1
    )  # what holds for slopes that vary is no more than what holds for constant ones
    kappa = 1.001 / max(peaks)
    changed = certificate.variables | {"kappa": kappa}
    assert not MeasuredDiscs.holds(**changed)


def loop_with_noise(
    linear: StateSpace, pair: Gains, balls: JacobianBalls
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closed loop in `(x, x_hat)`: its matrix, where noise enters, and its output."""
    b = linear.b
    c = 0.8 * linear.c
    k = pair.k
    l = pair.l  # noqa: E741
    driven = balls.input.alpha * b @ k
    closed_rows = [linear.a, driven]
    observer_rows = [-l @ c, linear.a + l @ c + driven]
    closed = np.block([closed_rows, observer_rows])
    no_input = np.zeros_like(l)
    no_output = np.zeros_like(c)
    return closed, np.vstack([no_input, -l]), np.hstack([c, no_output])


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_a_sine_of_the_worst_frequency_moves_the_output_by_the_noise_gain(seed: int) -> None:
    """Against the closed loop in `(x, x_hat)` on a grid of frequencies, and a simulated sine."""
    linear, balls, design = loop(seed)
    alpha = balls.input.alpha
    jacobian_ball = JacobianBall(alpha=alpha, beta=0.0)
    balls = replace(balls, input=jacobian_ball)
    gain = noise_gain(linear, design.gain_pair, balls)
    closed, noise_input, output = loop_with_noise(linear, design.gain_pair, balls)
    angles = np.linspace(0, np.pi, 20001)
    points = np.exp(1j * angles)[:, None, None]
    shifted = points * np.eye(len(closed)) - closed
    repeated_input = np.broadcast_to(noise_input, (20001, *noise_input.shape))
    solution = np.linalg.solve(shifted, repeated_input)
    size = np.abs(output @ solution)[:, 0, 0]
    largest = size.max()
    assert largest <= gain * (1 + 1e-9)
    assert gain <= 1.01 * size.max()
    position_of_largest = size.argmax()
    worst = float(angles[position_of_largest])
    time = np.arange(6000)
    sine = np.cos(worst * time)
    x = np.zeros(len(closed))
    outputs = []
    for noise in sine:
        item = (output @ x).item()
        outputs.append(item)
        x = closed @ x + noise_input[:, 0] * noise
    mean = np.mean(np.square(outputs[3000:]))
    mean_of_sine = np.mean(np.square(sine[3000:]))
    steady = np.sqrt(mean / mean_of_sine)
    assert steady == pytest.approx(gain, rel=0.02)


def test_no_noise_gain_is_finite_where_a_slope_leaves_the_loop_unstable() -> None:
    linear, balls, design = loop(0)
    jacobian_ball = JacobianBall.from_slopes(0.4, 1e3)
    wild = replace(balls, input=jacobian_ball)
    assert np.isfinite(noise_gain(linear, design.gain_pair, balls))
    assert noise_gain(linear, design.gain_pair, wild) == np.inf


def test_with_integrators_and_a_weight_the_motor_has_a_tolerance() -> None:
    model = motor_model()
    synthesis = RiccatiSynthesis(
        rate_controller=0.01, rate_observer=0.2, input_weight=0.1, output_noise=0.1
    )
    changed_synthesis = replace(synthesis, internal_model=["step"], integral_weight=1e-4)
    design = changed_synthesis.design(model, MOTOR_BALLS)
    whole = add_gain_certificates(design, model, MOTOR_BALLS)
    assert "tolerance" in whole.extra_certificates
    parts = whole.extra_certificates.values()
    assert all(part.certified for part in parts)
    text = json.dumps(whole.to_json())
    content = json.loads(text)
    system = controlled_system(model, design.state_feedback)
    assert failed_checks(content, model.linear, MOTOR_BALLS, system) == []
