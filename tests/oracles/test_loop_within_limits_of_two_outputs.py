"""Limits of loops with two outputs: their range is one that both have, and no limit acts from any
corner of it, also where the outputs are mixed."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from ssm_study.bounds.slopes import jacobian_ball
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.unlimited_start import certify_unlimited_start
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.signals import Scale
from ssm_study.study.design_claims import check_stored_initial_states
from ssm_study.synthesis.deployed import (
    certify_under_input_limits,
    equilibrium_corners,
    initial_output_range,
    prove_within_input_limits,
    scaled_equilibrium_states,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.metrics import input_limit_columns
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

LOWER_LIMITS = np.full(2, -0.6)
UPPER_LIMITS = np.full(2, 0.6)
ENDS = (LOWER_LIMITS, UPPER_LIMITS)


def two_lags() -> StateSpace:
    """Two lags, each with its own input and output."""
    a = np.diag([0.9, 0.8])
    b = np.eye(2)
    c = np.eye(2)
    d = np.zeros((2, 2))
    return StateSpace(a=a, b=b, c=c, d=d)


def unit_scale(output_equilibrium: list[float]) -> Scale:
    """Scale one, the input zero at rest and the outputs at these values."""
    channels = len(output_equilibrium)
    ones = np.ones(channels)
    input_equilibrium = np.zeros(channels)
    return Scale(
        input_scale=ones,
        output_scale=ones,
        input_equilibrium=input_equilibrium,
        output_equilibrium=np.array(output_equilibrium),
    )


DISTANCES = [(0.0, True), (9.0, False)]


@pytest.mark.parametrize(("apart", "shared"), DISTANCES)
def test_one_range_of_two_outputs_is_what_both_have(apart: float, shared: bool) -> None:
    """Where one rests nine units above the other there is none, though each has its own."""
    lags = two_lags()
    rest = unit_scale([0.0, apart])
    model = SSM.from_linear(lags, 0.1, rest)
    ball = JacobianBall(alpha=1.0, beta=0.0)
    synthesis = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.4, input_weight=0.5)
    balls = JacobianBalls(input=ball, output=ball)
    design = synthesis.design(model, balls)
    each = prove_within_input_limits(model, design, *ENDS)
    extra_certificates = certify_under_input_limits(model, design, *ENDS)
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
        highest_lower = expected
        lowest_upper = each.upper.min()
        assert facts["unlimited_from"] == highest_lower < lowest_upper == facts["unlimited_to"]
    else:
        columns_of_the_range = {"unlimited_from", "unlimited_to"}
        assert not columns_of_the_range & facts.keys()


def coupled_pair(gain: np.ndarray) -> tuple[SSM, Design]:
    """Two lags whose outputs a linear S_y mixes."""
    lags = two_lags()
    ssm = SSM.from_linear(lags, 0.1)
    scaffold_out = LinearScaffold(gain=gain)
    model = replace(ssm, scaffold_out=scaffold_out)
    balls_input = JacobianBall(alpha=1.0, beta=0.0)
    output = jacobian_ball(model.scaffold_out).ball
    balls = JacobianBalls(input=balls_input, output=output)
    synthesis = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.1, input_weight=0.5)
    design = synthesis.design(model, balls)
    return model, design


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
    coupling_matrix = np.array([[1.0, coupling], [coupling, 1.0]])
    model, design = coupled_pair(coupling_matrix)
    assert design.certified
    proof = prove_within_input_limits(model, design, *ENDS)
    corners = []
    for signs in product((-1, 1), repeat=2):
        corner = np.array(signs) * proof.upper
        corners.append(corner)
    requests = [largest_request(model, design, corner) for corner in corners]
    assert 0.4 < max(requests) <= 0.6
    np.testing.assert_allclose(proof.lower, -proof.upper)

    rest, _, gain = model.linear.equilibrium_basis()
    inverse = np.linalg.inv(gain)
    directions = np.array([[1.0, 1.0], [-1.0, 1.0]])
    mapped = rest @ inverse @ directions
    limits = np.stack(ENDS, axis=1)
    parts = [design.state_feedback]
    old = certify_unlimited_start(parts, mapped, limits)
    assert old is not None
    output_box = initial_output_range(model, old.starts)
    signs = np.array([1.0, -1.0])
    bounding = output_box[1] * signs
    request_outside = largest_request(model, design, bounding)
    leaves_the_box = request_outside / 0.6 > 6
    assert leaves_the_box == (coupling > 0)
    certificates = certify_under_input_limits(model, design, *ENDS)
    part = certificates["state_feedback_unlimited"]
    starts = scaled_equilibrium_states(model, part.starts)
    checked = check_stored_initial_states(part, starts)
    assert checked.holds
    starts = scaled_equilibrium_states(model, old.starts)
    checked = check_stored_initial_states(old, starts)
    holds = checked.holds
    assert holds == (coupling == 0)


def test_outputs_that_do_not_tell_the_state_at_rest_have_no_range() -> None:
    """Two inputs and one output: one output rests at many states."""
    eigenvalues = [0.9, 0.8]
    a = np.diag(eigenvalues)
    b = np.eye(2)
    c = np.ones((1, 2))
    d = np.zeros((1, 2))
    lags = StateSpace(a=a, b=b, c=c, d=d)
    model = SSM.from_linear(lags, 0.1)
    assert equilibrium_corners(model) is None
    breakpoints = np.zeros((1, 1))
    falling_slopes = [1.0, -1.0]
    slopes = np.array([falling_slopes])
    bent = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    a = 0.9 * np.eye(1)
    b = np.eye(1)
    c = np.eye(1)
    d = np.zeros((1, 1))
    state_space = StateSpace(a=a, b=b, c=c, d=d)
    ssm = SSM.from_linear(state_space, 0.1)
    folded = replace(ssm, scaffold_out=bent)
    assert equilibrium_corners(folded) is None
