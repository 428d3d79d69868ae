"""Limits and the certificate: inside the stated set no limit ever acts, outside it does; the
saturated loop contracts wherever it is claimed to, for slopes that change at will."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import control
import numpy as np
import pytest

import ssm_study as st
from ssm_study.bounds.slopes import jacobian_ball
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.limited_input import (
    ball_behind_saturation,
    certify_under_limits,
)
from ssm_study.certificates.theorems.unlimited_start import certify_unlimited_start
from ssm_study.loop.certified_bound import count_bound_violations
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant, Loop
from ssm_study.loop.trajectory import scaled_equilibrium
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale
from ssm_study.study.design_claims import check_stored_starts
from ssm_study.synthesis.deployed import (
    WithinLimits,
    certify_input_limits,
    equilibrium_corners,
    nearest_equilibrium_starts,
    output_range,
    prove_within_input_limits,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.metrics import input_limit_columns
from ssm_study.systems import Balls, JacobianBall, StateSpace

LIMIT = np.array([0.6])
SLOPES = (0.8, 1.0, 0.7, 0.9)


@pytest.fixture(scope="module")
def pair() -> tuple[SSM, Design]:
    a = np.array([[0.95, 0.1], [0.0, 0.8]])
    b = np.array([[0.02], [0.3]])
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    state_space = StateSpace(a=a, b=b, c=c, d=d)
    plain = SSM.from_linear(state_space, 0.1)
    breakpoints = np.array([[-1.0, 0.1, 0.8]])
    slopes = np.array([SLOPES])
    lifted = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    model = replace(plain, scaffold_in=lifted)
    balls_input = JacobianBall.from_slopes(min(SLOPES), max(SLOPES))
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = Balls(input=balls_input, output=output)
    wanted = RiccatiSynthesis(rate_controller=0.2, rate_observer=0.4, input_weight=0.5)
    return model, wanted.design(model, balls)


def inputs(model: SSM, design: Design, y0: float) -> np.ndarray:
    """Inputs that the unlimited loop requests from rest at `y0`, noise-free."""
    law = ObserverFeedback.from_design(model, design)
    x = scaled_equilibrium(model, np.array([y0]))[0][None]
    memory = x.copy()
    target = np.zeros(model.order + 2)
    asked = []
    for _ in range(120):
        y = model.output_at(x, np.zeros((1, 1)))
        u = law.input(memory, y, target)
        memory = law.advance(memory, u, y, target)
        x = model.advance(x, model.map_input(u))
        asked.append(u[0, 0])
    return np.array(asked)


def test_inside_no_limit_acts_and_far_outside_one_does(pair: tuple[SSM, Design]) -> None:
    found = prove_within_input_limits(*pair, -LIMIT, LIMIT)
    assert found.lower[0] < 0 < found.upper[0]
    for y0 in np.linspace(found.lower[0], found.upper[0], 9):
        largest = np.abs(inputs(*pair, y0)).max()
        assert largest <= LIMIT[0]
    largest = np.abs(inputs(*pair, 6 * found.upper[0])).max()
    assert largest > LIMIT[0]


def test_the_set_scales_with_the_limits_and_the_tighter_one_decides(
    pair: tuple[SSM, Design],
) -> None:
    one, two, skew = (
        prove_within_input_limits(*pair, low * LIMIT, high * LIMIT)
        for low, high in ((-1, 1), (-2, 2), (-9, 1))
    )
    assert np.allclose(two.upper, 2 * one.upper)
    assert np.allclose(skew.upper, one.upper)


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
    for slope in (0.0, 0.3, 1.0, rng.uniform(0, 1, 4000)):
        after = feedback.a @ x + feedback.b * slope * (feedback.k @ x)
        norm = np.linalg.norm(metric @ after, axis=0)
        shrunk = norm / np.linalg.norm(metric @ x, axis=0)
        largest = shrunk.max()
        upper_limit = np.sqrt(1 - proved.rate) * (1 + 1e-9)
        assert largest <= upper_limit


def test_the_ball_of_limited_inputs_holds_every_cut_jacobian_also_of_inputs_that_meet() -> None:
    rng = np.random.default_rng(0)
    ball = JacobianBall(alpha=-1.0, beta=0.5)
    wide = ball_behind_saturation(ball, input_count=2)
    worst = 0.0
    for _ in range(2000):
        white_noise = rng.standard_normal((2, 2))
        turned = np.linalg.qr(white_noise)[0]  # of norm one: the corners of the ball
        cut = (ball.alpha * np.eye(2) + ball.beta * turned) * rng.choice([0.0, 0.5, 1.0], 2)
        difference = cut - wide.alpha * np.eye(2)
        norm = float(np.linalg.norm(difference, 2))
        worst = max(worst, norm)
    assert 0.9 * wide.beta < worst <= wide.beta * (1 + 1e-12)
    lower = ball_behind_saturation(ball, input_count=1).lower
    assert lower <= ball.lower < ball.upper < 0 == ball_behind_saturation(ball, input_count=1).upper


def test_the_loop_with_its_observer_obeys_the_bound_at_the_limit(pair: tuple[SSM, Design]) -> None:
    """`d+ <= r d + c e` with the rate from everywhere; the full rate, or one a little higher, does
    not hold there."""
    model, design = pair
    saturated = certify_under_limits(design.state_feedback)
    assert saturated is not None
    input_lower = -LIMIT[0]
    loop = Loop(
        horizon_s=8.0, measurement_noise_variance=0.0, input_lower=input_lower, input_upper=LIMIT[0]
    )
    law = ObserverFeedback.from_design(model, design)
    starts = np.array([[-20.0], [-3.0], [0.05], [9.0]])
    identified_plant = IdentifiedPlant.from_model(model)
    run = loop.simulate(identified_plant, law, starts, np.zeros((4, 80, 1)))
    expected = [[True], [True], [False], [True]]
    assert (np.abs(run.u) == LIMIT).any(axis=1).tolist() == expected
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
    found = prove_within_input_limits(model, design, -LIMIT, LIMIT)
    feedback = design.state_feedback
    y = np.array([1.0])
    x = scaled_equilibrium(model, y)[0][:, None]
    asked = []
    for _ in range(40):
        item = (feedback.k @ x).item()
        asked.append(abs(item))
        x = (feedback.a + min(SLOPES) * feedback.b @ feedback.k) @ x
    upper_limit = found.upper[0]
    assert 0.7 * LIMIT[0] / max(asked) < upper_limit <= LIMIT[0] / max(asked)


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
    found = prove_within_input_limits(design.model, design.certificate, -LIMIT, LIMIT)
    assert found.everywhere is None
    upper_limit = found.upper[0]
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
    assert set(certify_input_limits(blind, design, -LIMIT, LIMIT)) == {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        prove_within_input_limits(blind, design, -LIMIT, LIMIT)


def test_where_the_input_moves_the_output_at_once_there_is_no_range() -> None:
    """a=0.9, b=0.1, c=1, D=-0.5: rest at an output of 0.161, the edge of the range without D, asks
    twice the limit."""
    input_scale = np.ones(1)
    output_scale = np.ones(1)
    input_equilibrium = np.zeros(1)
    output_equilibrium = np.zeros(1)
    rest = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    a = np.array([[0.9]])
    b = np.array([[0.1]])
    c = np.eye(1)
    d = np.array([[-0.5]])
    lag = StateSpace(a=a, b=b, c=c, d=d)
    model = SSM.from_linear(lag, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    wanted = RiccatiSynthesis(rate_controller=0.8, rate_observer=0.4, input_weight=1e-3)
    balls = Balls(input=ball, output=ball)
    design = wanted.design(model, balls)
    assert set(certify_input_limits(model, design, -LIMIT, LIMIT)) <= {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        prove_within_input_limits(model, design, -LIMIT, LIMIT)


def test_the_header_says_both(tmp_path: Path, smoke_run: Path) -> None:
    design = st.load(smoke_run)
    header = design.to_c(tmp_path / "controller.h").read_text()
    assert "Within the limits the full rates hold from rest at outputs from" in header
    assert (
        "From everywhere the state feedback, cut at the limits," in header
        or "From everywhere nothing is" in header
    )
    assert isinstance(design.within_limits([-1e3], [1e3]), WithinLimits)


@pytest.mark.parametrize(("apart", "shared"), [(0.0, True), (9.0, False)])
def test_one_range_of_two_outputs_is_what_both_have(apart: float, shared: bool) -> None:
    """Where one rests nine units above the other there is none, though each has its own."""
    a = np.diag([0.9, 0.8])
    b = np.eye(2)
    c = np.eye(2)
    d = np.zeros((2, 2))
    lags = StateSpace(a=a, b=b, c=c, d=d)
    input_scale = np.ones(2)
    output_scale = np.ones(2)
    input_equilibrium = np.zeros(2)
    output_equilibrium = np.array([0.0, apart])
    rest = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    model = SSM.from_linear(lags, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    wanted = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.4, input_weight=0.5)
    balls = Balls(input=ball, output=ball)
    design = wanted.design(model, balls)
    ends = np.full(2, -0.6), np.full(2, 0.6)
    each = prove_within_input_limits(model, design, *ends)
    extra_certificates = certify_input_limits(model, design, *ends)
    changed_design = replace(design, extra_certificates=extra_certificates)
    facts = input_limit_columns(changed_design, model)
    upper_limit = [0.0, apart]
    assert (each.lower < upper_limit).all()
    lower_limit = [0.0, apart]
    assert (each.upper > lower_limit).all()
    assert facts["limit_lower"] == -0.6
    assert facts["limit_upper"] == 0.6
    if shared:
        expected = each.lower.max()
        assert facts["unlimited_from"] == expected < each.upper.min() == facts["unlimited_to"]
    else:
        assert not {"unlimited_from", "unlimited_to"} & facts.keys()


def coupled_pair(gain: np.ndarray) -> tuple[SSM, Design]:
    """Two lags whose outputs a linear S_y mixes."""
    a = np.diag([0.9, 0.8])
    b = np.eye(2)
    c = np.eye(2)
    d = np.zeros((2, 2))
    lags = StateSpace(a=a, b=b, c=c, d=d)
    ssm = SSM.from_linear(lags, 0.1)
    scaffold_out = LinearScaffold(gain=gain)
    model = replace(ssm, scaffold_out=scaffold_out)
    balls_input = JacobianBall(alpha=1.0, beta=0.0)
    output = jacobian_ball(model.scaffold_out).ball
    balls = Balls(input=balls_input, output=output)
    wanted = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.1, input_weight=0.5)
    return model, wanted.design(model, balls)


def largest_request(model: SSM, design: Design, output: np.ndarray) -> float:
    """Largest input that the law asks for from rest at this output, the estimate exact."""
    rest, _, gain = model.linear.equilibrium_basis()
    linear = model.scaffold_out.as_portable().linear
    solution = np.linalg.solve(linear @ gain, output)
    x = rest @ solution
    k = design.state_feedback.k
    largest = 0.0
    for _ in range(80):
        largest = max(largest, float(np.abs(k @ x).max()))
        linear_a = model.linear.a
        linear_b = model.linear.b
        x = (linear_a + linear_b @ k) @ x
    return largest


@pytest.mark.parametrize("coupling", [0.0, 0.8])
def test_no_limit_acts_from_any_corner_of_the_box_also_where_the_outputs_are_mixed(
    coupling: float,
) -> None:
    """The image of the box that S_y maps is no box: of its bounding box a corner asks for 6.45
    times the limit."""
    model, design = coupled_pair(np.array([[1.0, coupling], [coupling, 1.0]]))
    assert design.certified
    ends = np.full(2, -0.6), np.full(2, 0.6)
    found = prove_within_input_limits(model, design, *ends)
    corners = [np.array([s, t]) * found.upper for s, t in product((-1, 1), repeat=2)]
    requests = [largest_request(model, design, corner) for corner in corners]
    assert 0.4 < max(requests) <= 0.6
    np.testing.assert_allclose(found.lower, -found.upper)

    rest, _, gain = model.linear.equilibrium_basis()
    inverse = np.linalg.inv(gain)
    mapped = rest @ inverse @ np.array([[1.0, 1.0], [-1.0, 1.0]])
    limits = np.stack(ends, axis=1)
    parts = [design.state_feedback]
    old = certify_unlimited_start(parts, mapped, limits)
    assert old is not None
    bounding = output_range(model, old.starts)[1] * np.array([1.0, -1.0])
    assert (largest_request(model, design, bounding) / 0.6 > 6) == (coupling > 0)
    part = certify_input_limits(model, design, *ends)["state_feedback_unlimited"]
    starts = nearest_equilibrium_starts(model, part.starts)
    checked = check_stored_starts(part, starts)
    assert checked.holds
    starts = nearest_equilibrium_starts(model, old.starts)
    checked = check_stored_starts(old, starts)
    holds = checked.holds
    assert holds == (coupling == 0)


def test_outputs_that_do_not_tell_the_state_at_rest_have_no_range() -> None:
    """Two inputs and one output: one output rests at many states."""
    a = np.diag([0.9, 0.8])
    b = np.eye(2)
    c = np.ones((1, 2))
    d = np.zeros((1, 2))
    lags = StateSpace(a=a, b=b, c=c, d=d)
    model = SSM.from_linear(lags, 0.1)
    assert equilibrium_corners(model) is None
    breakpoints = np.zeros((1, 1))
    slopes = np.array([[1.0, -1.0]])
    bent = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    a = 0.9 * np.eye(1)
    b = np.eye(1)
    c = np.eye(1)
    d = np.zeros((1, 1))
    state_space = StateSpace(a=a, b=b, c=c, d=d)
    ssm = SSM.from_linear(state_space, 0.1)
    folded = replace(ssm, scaffold_out=bent)
    assert equilibrium_corners(folded) is None
