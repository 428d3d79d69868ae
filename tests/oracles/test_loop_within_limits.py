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
from ssm_study.certificates.theorems.limited_input import ball_behind_limits, certify_under_limits
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
from ssm_study.study.design_claims import stored_starts
from ssm_study.synthesis.deployed import (
    WithinLimits,
    outputs_of,
    rest_corners,
    starts_at_rest,
    with_limits,
    within_limits,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.metrics import limit_facts
from ssm_study.systems import Balls, JacobianBall, StateSpace

LIMIT = np.array([0.6])
SLOPES = (0.8, 1.0, 0.7, 0.9)


@pytest.fixture(scope="module")
def pair() -> tuple[SSM, Design]:
    plain = SSM.of(
        StateSpace(
            a=np.array([[0.95, 0.1], [0.0, 0.8]]),
            b=np.array([[0.02], [0.3]]),
            c=np.array([[1.0, 0.0]]),
            d=np.zeros((1, 1)),
        ),
        0.1,
    )
    lifted = MonotoneScaffold(breakpoints=np.array([[-1.0, 0.1, 0.8]]), slopes=np.array([SLOPES]))
    model = replace(plain, scaffold_in=lifted)
    balls = Balls(
        input=JacobianBall.from_slopes(min(SLOPES), max(SLOPES)),
        output=JacobianBall(alpha=1.0, beta=0.0),
    )
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
        y = model.read(x, np.zeros((1, 1)))
        u = law.input(memory, y, target)
        memory = law.advance(memory, u, y, target)
        x = model.advance(x, model.lift(u))
        asked.append(u[0, 0])
    return np.array(asked)


def test_inside_no_limit_acts_and_far_outside_one_does(pair: tuple[SSM, Design]) -> None:
    found = within_limits(*pair, -LIMIT, LIMIT)
    assert found.lower[0] < 0 < found.upper[0]
    for y0 in np.linspace(found.lower[0], found.upper[0], 9):
        assert np.abs(inputs(*pair, y0)).max() <= LIMIT[0]
    assert np.abs(inputs(*pair, 6 * found.upper[0])).max() > LIMIT[0]


def test_the_set_scales_with_the_limits_and_the_tighter_one_decides(
    pair: tuple[SSM, Design],
) -> None:
    one, two, skew = (
        within_limits(*pair, low * LIMIT, high * LIMIT) for low, high in ((-1, 1), (-2, 2), (-9, 1))
    )
    assert np.allclose(two.upper, 2 * one.upper)
    assert np.allclose(skew.upper, one.upper)


def test_everywhere_is_no_faster_than_the_open_loop_and_holds_for_changing_slopes(
    pair: tuple[SSM, Design],
) -> None:
    feedback = pair[1].state_feedback
    proved = certify_under_limits(feedback)
    assert proved is not None
    own = 1 - np.abs(np.linalg.eigvals(feedback.a)).max() ** 2
    assert 0.5 * own < proved.rate <= own < feedback.rate
    metric = np.linalg.cholesky(np.linalg.inv(proved.p)).T
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 4000))
    for slope in (0.0, 0.3, 1.0, rng.uniform(0, 1, 4000)):
        after = feedback.a @ x + feedback.b * slope * (feedback.k @ x)
        shrunk = np.linalg.norm(metric @ after, axis=0) / np.linalg.norm(metric @ x, axis=0)
        assert shrunk.max() <= np.sqrt(1 - proved.rate) * (1 + 1e-9)


def test_the_ball_of_limited_inputs_holds_every_cut_jacobian_also_of_inputs_that_meet() -> None:
    rng = np.random.default_rng(0)
    ball = JacobianBall(alpha=-1.0, beta=0.5)
    wide = ball_behind_limits(ball, inputs=2)
    worst = 0.0
    for _ in range(2000):
        turned = np.linalg.qr(rng.standard_normal((2, 2)))[
            0
        ]  # of norm one: the corners of the ball
        cut = (ball.alpha * np.eye(2) + ball.beta * turned) * rng.choice([0.0, 0.5, 1.0], 2)
        worst = max(worst, float(np.linalg.norm(cut - wide.alpha * np.eye(2), 2)))
    assert 0.9 * wide.beta < worst <= wide.beta * (1 + 1e-12)
    assert (
        ball_behind_limits(ball, inputs=1).lower
        <= ball.lower
        < ball.upper
        < 0
        == ball_behind_limits(ball, inputs=1).upper
    )


def test_the_loop_with_its_observer_obeys_the_bound_at_the_limit(pair: tuple[SSM, Design]) -> None:
    """`d+ <= r d + c e` with the rate from everywhere; the full rate, or one a little higher, does
    not hold there."""
    model, design = pair
    saturated = certify_under_limits(design.state_feedback)
    assert saturated is not None
    loop = Loop(
        horizon_s=8.0, measurement_noise_variance=0.0, input_lower=-LIMIT[0], input_upper=LIMIT[0]
    )
    law = ObserverFeedback.from_design(model, design)
    starts = np.array([[-20.0], [-3.0], [0.05], [9.0]])
    run = loop.simulate(IdentifiedPlant.from_model(model), law, starts, np.zeros((4, 80, 1)))
    assert (np.abs(run.u) == LIMIT).any(axis=1).tolist() == [[True], [True], [False], [True]]
    assert count_bound_violations(run.states, run.estimate, saturated, design.observer) == 0
    assert (
        count_bound_violations(run.states, run.estimate, design.state_feedback, design.observer) > 0
    )


def test_the_range_is_nearly_the_largest_there_is(pair: tuple[SSM, Design]) -> None:
    """No range can be larger than the one whose end asks for the limit at once, or for some slope
    later."""
    model, design = pair
    found = within_limits(model, design, -LIMIT, LIMIT)
    feedback = design.state_feedback
    x = scaled_equilibrium(model, np.array([1.0]))[0][:, None]
    asked = []
    for _ in range(40):
        asked.append(abs((feedback.k @ x).item()))
        x = (feedback.a + min(SLOPES) * feedback.b @ feedback.k) @ x
    assert 0.7 * LIMIT[0] / max(asked) < found.upper[0] <= LIMIT[0] / max(asked)


def test_a_gain_that_needs_its_input_has_no_global_certificate() -> None:
    """An unstable model is certified near rest only: no limited input can hold it everywhere."""
    plant = control.StateSpace([[1.05]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    rates = ("synthesis=riccati", "synthesis.rate_controller=0.2", "synthesis.rate_observer=0.4")
    design = st.control(plant, *rates)
    assert design.certificate.certified
    found = within_limits(design.model, design.certificate, -LIMIT, LIMIT)
    assert found.everywhere is None
    assert 0 < found.upper[0] < 10


def test_refusals(pair: tuple[SSM, Design]) -> None:
    with pytest.raises(BadRequest, match="do not enclose the input at rest"):
        within_limits(*pair, LIMIT, 2 * LIMIT)
    model, design = pair
    feedback = replace(design.state_feedback, certified=False)
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        within_limits(model, replace(design, state_feedback=feedback), -LIMIT, LIMIT)


def test_where_no_input_holds_an_output_there_is_no_range(pair: tuple[SSM, Design]) -> None:
    """An output that is zero at every rest: the design stands, from everywhere it contracts, and no
    range is named."""
    model, design = pair
    blind = model.with_linear(replace(model.linear, c=0 * model.linear.c))
    assert set(with_limits(blind, design, -LIMIT, LIMIT)) == {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        within_limits(blind, design, -LIMIT, LIMIT)


def test_where_the_input_moves_the_output_at_once_there_is_no_range() -> None:
    """a=0.9, b=0.1, c=1, D=-0.5: rest at an output of 0.161, the edge of the range without D, asks
    twice the limit."""
    rest = Scale(input_scale=np.ones(1), output_scale=np.ones(1), input_equilibrium=np.zeros(1),
                 output_equilibrium=np.zeros(1))  # fmt: skip
    lag = StateSpace(a=np.array([[0.9]]), b=np.array([[0.1]]), c=np.eye(1), d=np.array([[-0.5]]))
    model = SSM.of(lag, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    wanted = RiccatiSynthesis(rate_controller=0.8, rate_observer=0.4, input_weight=1e-3)
    design = wanted.design(model, Balls(input=ball, output=ball))
    assert set(with_limits(model, design, -LIMIT, LIMIT)) <= {"state_feedback_limited"}
    with pytest.raises(BadRequest, match="nothing is proved within them"):
        within_limits(model, design, -LIMIT, LIMIT)


def test_the_header_says_both(tmp_path: Path, smoke_run: Path) -> None:
    design = st.load(smoke_run)
    header = design.to_c(tmp_path / "controller.h").read_text()
    assert "Within the limits the full rates hold from rest at outputs from" in header
    assert (
        "From everywhere the state feedback, cut at the limits," in header
        or "From everywhere nothing is" in header
    )
    assert isinstance(design.within([-1e3], [1e3]), WithinLimits)


@pytest.mark.parametrize(("apart", "shared"), [(0.0, True), (9.0, False)])
def test_one_range_of_two_outputs_is_what_both_have(apart: float, shared: bool) -> None:
    """Where one rests nine units above the other there is none, though each has its own."""
    lags = StateSpace(a=np.diag([0.9, 0.8]), b=np.eye(2), c=np.eye(2), d=np.zeros((2, 2)))
    rest = Scale(input_scale=np.ones(2), output_scale=np.ones(2), input_equilibrium=np.zeros(2),
                 output_equilibrium=np.array([0.0, apart]))  # fmt: skip
    model = SSM.of(lags, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    wanted = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.4, input_weight=0.5)
    design = wanted.design(model, Balls(input=ball, output=ball))
    ends = np.full(2, -0.6), np.full(2, 0.6)
    each = within_limits(model, design, *ends)
    facts = limit_facts(
        replace(design, extra_certificates=with_limits(model, design, *ends)), model
    )
    assert (each.lower < [0.0, apart]).all()
    assert (each.upper > [0.0, apart]).all()
    assert (facts["limit_lower"], facts["limit_upper"]) == (-0.6, 0.6)
    if shared:
        assert (
            facts["unlimited_from"] == each.lower.max() < each.upper.min() == facts["unlimited_to"]
        )
    else:
        assert not {"unlimited_from", "unlimited_to"} & facts.keys()


def coupled_pair(gain: np.ndarray) -> tuple[SSM, Design]:
    """Two lags whose outputs a linear S_y mixes."""
    lags = StateSpace(a=np.diag([0.9, 0.8]), b=np.eye(2), c=np.eye(2), d=np.zeros((2, 2)))
    model = replace(SSM.of(lags, 0.1), scaffold_out=LinearScaffold(gain=gain))
    balls = Balls(
        input=JacobianBall(alpha=1.0, beta=0.0), output=jacobian_ball(model.scaffold_out).ball
    )
    wanted = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.1, input_weight=0.5)
    return model, wanted.design(model, balls)


def largest_request(model: SSM, design: Design, output: np.ndarray) -> float:
    """Largest input that the law asks for from rest at this output, the estimate exact."""
    rest, _, gain = model.linear.steady_states()
    x = rest @ np.linalg.solve(model.scaffold_out.portable().linear @ gain, output)
    k = design.state_feedback.k
    largest = 0.0
    for _ in range(80):
        largest = max(largest, float(np.abs(k @ x).max()))
        x = (model.linear.a + model.linear.b @ k) @ x
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
    found = within_limits(model, design, *ends)
    corners = [np.array([s, t]) * found.upper for s, t in product((-1, 1), repeat=2)]
    requests = [largest_request(model, design, corner) for corner in corners]
    assert 0.4 < max(requests) <= 0.6
    np.testing.assert_allclose(found.lower, -found.upper)

    rest, _, gain = model.linear.steady_states()
    mapped = rest @ np.linalg.inv(gain) @ np.array([[1.0, 1.0], [-1.0, 1.0]])
    limits = np.stack(ends, axis=1)
    old = certify_unlimited_start([design.state_feedback], mapped, limits)
    assert old is not None
    bounding = outputs_of(model, old.starts)[1] * np.array([1.0, -1.0])
    assert (largest_request(model, design, bounding) / 0.6 > 6) == (coupling > 0)
    part = with_limits(model, design, *ends)["state_feedback_unlimited"]
    assert stored_starts(part, starts_at_rest(model, part.starts)).holds
    assert stored_starts(old, starts_at_rest(model, old.starts)).holds == (coupling == 0)


def test_outputs_that_do_not_tell_the_state_at_rest_have_no_range() -> None:
    """Two inputs and one output: one output rests at many states."""
    lags = StateSpace(a=np.diag([0.9, 0.8]), b=np.eye(2), c=np.ones((1, 2)), d=np.zeros((1, 2)))
    assert rest_corners(SSM.of(lags, 0.1)) is None
    bent = MonotoneScaffold(breakpoints=np.zeros((1, 1)), slopes=np.array([[1.0, -1.0]]))
    folded = replace(
        SSM.of(StateSpace(a=0.9 * np.eye(1), b=np.eye(1), c=np.eye(1), d=np.zeros((1, 1))), 0.1),
        scaffold_out=bent,
    )
    assert rest_corners(folded) is None
