"""Limits and the certificate: inside the stated set no limit ever acts, outside it does; the
saturated loop contracts wherever it is claimed to, for slopes that change at will."""

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from recorded import assert_as_recorded

import ssm_study as st
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.limited_input import (
    ball_of_saturated_map,
    certify_under_limits,
)
from ssm_study.loop.certified_bound import count_bound_violations
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.trajectory import scaled_equilibrium
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale
from ssm_study.synthesis.deployed import (
    RangeWithinLimits,
    certify_under_input_limits,
    prove_within_input_limits,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

LIMIT = np.array([0.6])
SLOPES = (0.8, 1.0, 0.7, 0.9)


@pytest.fixture(scope="module")
def pair() -> tuple[SSM, Design]:
    rows_of_a = [[0.95, 0.1], [0.0, 0.8]]
    a = np.array(rows_of_a)
    column_of_b = [[0.02], [0.3]]
    b = np.array(column_of_b)
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    state_space = StateSpace(a=a, b=b, c=c, d=d)
    plain = SSM.from_linear(state_space, 0.1)
    row_of_breakpoints = [[-1.0, 0.1, 0.8]]
    breakpoints = np.array(row_of_breakpoints)
    slopes = np.array([SLOPES])
    lifted = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    model = replace(plain, scaffold_in=lifted)
    balls_input = JacobianBall.from_slopes(min(SLOPES), max(SLOPES))
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=balls_input, output=output)
    synthesis = RiccatiSynthesis(rate_controller=0.2, rate_observer=0.4, input_weight=0.5)
    return model, synthesis.design(model, balls)


def inputs(model: SSM, design: Design, y0: float) -> np.ndarray:
    """Inputs that the unlimited loop requests from rest at `y0`, noise-free."""
    law = ObserverFeedback.from_design(model, design)
    start_output = np.array([y0])
    start_states = scaled_equilibrium(model, start_output)[0]
    x = start_states[None]
    memory = x.copy()
    target = np.zeros(model.order + 2)
    requests = []
    for _ in range(120):
        no_input = np.zeros((1, 1))
        y = model.output_at(x, no_input)
        u = law.input(memory, y, target)
        memory = law.next_memory(memory, u, y, target)
        mapped = model.map_input(u)
        x = model.next_state(x, mapped)
        input_now = u[0, 0]
        requests.append(input_now)
    return np.array(requests)


def test_inside_no_limit_acts_and_far_outside_one_does(pair: tuple[SSM, Design]) -> None:
    proof = prove_within_input_limits(*pair, -LIMIT, LIMIT)
    assert proof.lower[0] < 0 < proof.upper[0]
    outputs = np.linspace(proof.lower[0], proof.upper[0], 9)
    for y0 in outputs:
        largest = np.abs(inputs(*pair, y0)).max()
        assert largest <= LIMIT[0]
    upper_end = proof.upper[0]
    far_outside = 6 * upper_end
    requests = inputs(*pair, far_outside)
    largest = np.abs(requests).max()
    assert largest > LIMIT[0]


def test_the_set_scales_with_the_limits_and_the_tighter_one_decides(
    pair: tuple[SSM, Design],
) -> None:
    wide_limit = 2 * LIMIT
    skew_limit = -9 * LIMIT
    plain = prove_within_input_limits(*pair, -LIMIT, LIMIT)
    doubled = prove_within_input_limits(*pair, -wide_limit, wide_limit)
    skew = prove_within_input_limits(*pair, skew_limit, LIMIT)
    doubled_upper = 2 * plain.upper
    assert np.allclose(doubled.upper, doubled_upper)
    assert np.allclose(skew.upper, plain.upper)


def test_everywhere_is_no_faster_than_the_open_loop_and_holds_for_changing_slopes(
    pair: tuple[SSM, Design],
) -> None:
    feedback = pair[1].state_feedback
    proved = certify_under_limits(feedback)
    assert proved is not None
    eigenvalues = np.linalg.eigvals(feedback.a)
    spectral_radius = np.abs(eigenvalues).max()
    own = 1 - spectral_radius**2
    assert 0.5 * own < proved.rate <= own < feedback.rate
    inverse = np.linalg.inv(proved.p)
    metric = np.linalg.cholesky(inverse).T
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 4000))
    changing_slopes = rng.uniform(0, 1, 4000)
    slopes = (0.0, 0.3, 1.0, changing_slopes)
    for slope in slopes:
        free_part = feedback.a @ x
        feedback_part = feedback.k @ x
        after = free_part + feedback.b * slope * feedback_part
        norm = np.linalg.norm(metric @ after, axis=0)
        norm_before = np.linalg.norm(metric @ x, axis=0)
        shrunk = norm / norm_before
        largest = shrunk.max()
        contraction = np.sqrt(1 - proved.rate)
        upper_limit = contraction * (1 + 1e-9)
        assert largest <= upper_limit


def test_the_ball_of_limited_inputs_holds_every_cut_jacobian_also_of_inputs_that_meet() -> None:
    rng = np.random.default_rng(0)
    ball = JacobianBall(alpha=-1.0, beta=0.5)
    wide = ball_of_saturated_map(ball, input_count=2)
    worst = 0.0
    for _ in range(2000):
        white_noise = rng.standard_normal((2, 2))
        # Of norm one: the corners of the ball.
        turned, _ = np.linalg.qr(white_noise)
        corner = ball.alpha * np.eye(2) + ball.beta * turned
        cuts = rng.choice([0.0, 0.5, 1.0], 2)
        cut = corner * cuts
        centre = wide.alpha * np.eye(2)
        norm = float(np.linalg.norm(cut - centre, 2))
        worst = max(worst, norm)
    assert 0.9 * wide.beta < worst <= wide.beta * (1 + 1e-12)
    single = ball_of_saturated_map(ball, input_count=1)
    assert single.lower <= ball.lower < ball.upper < 0 == single.upper


def test_the_loop_with_its_observer_obeys_the_bound_at_the_limit(pair: tuple[SSM, Design]) -> None:
    """`d+ <= r d + c e` with the rate from everywhere; the full rate, or one a little higher, does
    not hold there."""
    model, design = pair
    saturated = certify_under_limits(design.state_feedback)
    assert saturated is not None
    input_lower = -LIMIT[0]
    loop = LoopExperiment(
        horizon_s=8.0, measurement_noise_variance=0.0, input_lower=input_lower, input_upper=LIMIT[0]
    )
    law = ObserverFeedback.from_design(model, design)
    start_outputs = [[-20.0], [-3.0], [0.05], [9.0]]
    starts = np.array(start_outputs)
    identified_plant = IdentifiedPlant.from_model(model)
    no_noise = np.zeros((4, 80, 1))
    run = loop.simulate(identified_plant, law, starts, no_noise)
    expected = [[True], [True], [False], [True]]
    touches = np.abs(run.u) == LIMIT
    touches_once = touches.any(axis=1)
    assert touches_once.tolist() == expected
    bound_violations = count_bound_violations(run.states, run.estimate, saturated, design.observer)
    assert bound_violations == 0
    bound_violations = count_bound_violations(
        run.states, run.estimate, design.state_feedback, design.observer
    )
    assert bound_violations > 0


def test_the_range_is_nearly_the_largest_there_is(pair: tuple[SSM, Design]) -> None:
    """No range can be larger than the one whose end asks for the limit at once, or for some slope
    later."""
    model, design = pair
    proof = prove_within_input_limits(model, design, -LIMIT, LIMIT)
    feedback = design.state_feedback
    y = np.array([1.0])
    equilibrium = scaled_equilibrium(model, y)
    x = equilibrium[0][:, None]
    requests = []
    for _ in range(40):
        item = (feedback.k @ x).item()
        requests.append(abs(item))
        x = (feedback.a + min(SLOPES) * feedback.b @ feedback.k) @ x
    upper_limit = proof.upper[0]
    largest_request = max(requests)
    quotient = LIMIT[0] / largest_request
    assert 0.7 * LIMIT[0] / largest_request < upper_limit <= quotient


def test_a_gain_that_needs_its_input_has_no_global_certificate() -> None:
    """An unstable model is certified near rest only: no limited input can hold it everywhere."""
    a = [[1.05]]
    b = [[1.0]]
    c = [[1.0]]
    d = [[0.0]]
    plant = control.StateSpace(a, b, c, d, 0.1)
    rates = ("synthesis=riccati", "synthesis.rate_controller=0.2", "synthesis.rate_observer=0.4")
    design = st.control(plant, *rates)
    assert design.certificate.certified
    proof = prove_within_input_limits(design.model, design.certificate, -LIMIT, LIMIT)
    assert proof.everywhere is None
    upper_limit = proof.upper[0]
    assert 0 < upper_limit < 10


def test_refusals(pair: tuple[SSM, Design]) -> None:
    with pytest.raises(BadRequest, match="do not enclose the input at rest"):
        prove_within_input_limits(*pair, LIMIT, 2 * LIMIT)
    model, design = pair
    feedback = replace(design.state_feedback, certified=False)
    changed_design = replace(design, state_feedback=feedback)
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        prove_within_input_limits(model, changed_design, -LIMIT, LIMIT)


def test_where_no_input_holds_an_output_there_is_no_range(pair: tuple[SSM, Design]) -> None:
    """An output that is zero at every rest: the design stands, from everywhere it contracts, and no
    range is named."""
    model, design = pair
    c = 0 * model.linear.c
    linear = replace(model.linear, c=c)
    blind = model.with_linear_part(linear)
    certificates = set(certify_under_input_limits(blind, design, -LIMIT, LIMIT))
    assert certificates == {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        prove_within_input_limits(blind, design, -LIMIT, LIMIT)


def test_where_the_input_moves_the_output_at_once_there_is_no_range() -> None:
    """a=0.9, b=0.1, c=1, D=-0.5: rest at an output of 0.161, the edge of the range without D, asks
    twice the limit."""
    ones = np.ones(1)
    zero = np.zeros(1)
    rest = Scale(
        input_scale=ones, output_scale=ones, input_equilibrium=zero, output_equilibrium=zero
    )
    a = np.array([[0.9]])
    b = np.array([[0.1]])
    c = np.eye(1)
    d = np.array([[-0.5]])
    lag = StateSpace(a=a, b=b, c=c, d=d)
    model = SSM.from_linear(lag, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    synthesis = RiccatiSynthesis(rate_controller=0.8, rate_observer=0.4, input_weight=1e-3)
    balls = JacobianBalls(input=ball, output=ball)
    design = synthesis.design(model, balls)
    certificates = set(certify_under_input_limits(model, design, -LIMIT, LIMIT))
    assert certificates <= {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        prove_within_input_limits(model, design, -LIMIT, LIMIT)


def test_the_header_says_both(tmp_path: Path, smoke_run: Path) -> None:
    design = st.load(smoke_run)
    header_file = design.to_c(tmp_path / "controller.h")
    header = header_file.read_text()
    assert "Within the limits the full rates hold from rest at outputs from" in header
    assert (
        "From everywhere the state feedback, cut at the limits," in header
        or "From everywhere nothing is" in header
    )
    within_limits = design.within_limits([-1e3], [1e3])
    assert isinstance(within_limits, RangeWithinLimits)


def test_the_design_has_the_recorded_numbers(pair: tuple[SSM, Design]) -> None:
    assert_as_recorded("loop_within_limits", pair[1], 1e-3)
