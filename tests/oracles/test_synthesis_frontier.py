"""The frontier by two routes, and every method on both sides of it: models of all kinds, one and
several inputs."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from synthesis_modal import ModalLmiSynthesis, modal_energy, modal_gain, solve_on_fast_modes
from synthesis_ratio import ratio_limit

from ssm_study.certificates.certificate import Infeasible, StateFeedback
from ssm_study.certificates.frontier import contraction_frontier, inverse_time_gramian_root
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.certificates.theorem import scaled_condition_number
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis import modes
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis, certificate_from_paper_lmi
from ssm_study.synthesis.minimum_energy import (
    SHARES,
    ClosedFormSynthesis,
    minimum_energy_gain,
    minimum_energy_solution,
    solution_with_full_metric,
)
from ssm_study.synthesis.modes import split_modes
from ssm_study.systems import JacobianBall, StateSpace

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from cost_cases import cost_problem
from synthesis_certified import trained
from synthesis_instances import KINDS, Instance, random_instance, random_model

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))


SEEDS = st.integers(0, 10**6)
# Of the examples of the other laws, where each costs a large part of a second.
A_THIRD = settings(max_examples=max(1, settings.default.max_examples // 3))


def instance(
    seed: int, gap: float, orders: tuple[int, int] = (1, 8), inputs: int = 1, mixed: bool = True
) -> Instance:
    rng = np.random.default_rng(seed)
    found = None
    while found is None:
        found = random_instance(rng, orders, gap, mixed, inputs)
    return found


def design(method: type, case: Instance, **options) -> StateFeedback | Infeasible:
    return method(rate_controller=case.rate, rate_observer=0.5, **options).state_feedback(
        case.linear, case.ball
    )


@A_THIRD
@given(
    SEEDS,
    st.sampled_from([RiccatiSynthesis, ClosedFormSynthesis, ModalLmiSynthesis]),
    st.integers(1, 2),
)
def test_one_percent_inside_every_method_certifies(seed: int, method: type, inputs: int) -> None:
    part = design(method, instance(seed, 0.01, inputs=inputs), state_weight=1e-4)
    assert part.certified, part
    assert isinstance(part, StateFeedback)
    assert part.margin > 0


def holds(problem: Problem, found: Solution) -> bool:
    state_feedback_of_ball = StateFeedbackOfBall.certificate_numbers(problem, found)
    return StateFeedbackOfBall.holds(**state_feedback_of_ball)


def asked(case: Instance) -> Problem:
    closed_form_synthesis = ClosedFormSynthesis(rate_controller=case.rate, rate_observer=0.5)
    return closed_form_synthesis.problem(case.linear, case.ball)


@A_THIRD
@given(SEEDS, st.integers(1, 2))
def test_the_metric_of_the_whole_model_holds_at_one_percent(seed: int, inputs: int) -> None:
    problem = asked(instance(seed, 0.01, inputs=inputs))
    solution = solution_with_full_metric(problem, 0.5, 1.0)
    assert holds(problem, solution)


@pytest.mark.parametrize("seed", [1, 10, 17, 60])
def test_the_slow_modes_join_with_a_metric_that_holds(seed: int) -> None:
    """Ten percent inside: of the weights tried, a heavier one than the best just fails; one that
    holds is chosen."""
    orders = (2, 5)
    problem = asked(instance(seed, 0.1, orders))
    assert holds(problem, minimum_energy_solution(problem))


@pytest.mark.parametrize("radius", [0.0, 0.3])
def test_the_gain_is_built_between_the_asked_rate_and_the_frontier(radius: float) -> None:
    """And its status says where; without a radius there is no frontier below one, and it stays
    finite all the same."""
    ball = JacobianBall(alpha=2.0, beta=radius)
    problem = cost_problem(ball=ball)
    limit = contraction_frontier(problem.a, problem.b, problem.ball).rate_limit
    said = []
    for found in (minimum_energy_solution(problem), solution_with_full_metric(problem, 0.5, 1.0)):
        assert holds(problem, found)
        said.append(found.status.split("at rate ")[1].split(",")[0])
    assert said[0] == said[1]
    assert problem.rate < float(said[0]) < limit


def test_the_metric_of_the_whole_model_needs_fewer_digits_than_the_block_diagonal_one() -> None:
    """The identified model that no block-diagonal metric certifies 0.01 % inside the frontier."""
    cases = [case for case in trained(1e-4, 54) if case.linear.order == 8]
    hard = [asked(case) for case in cases]
    missed = [
        p for p in hard if not any(holds(p, minimum_energy_solution(p, share)) for share in SHARES)
    ]
    assert missed, "every model is easy: this test has nothing to show"
    for problem in missed:
        whole = solution_with_full_metric(problem, 0.5, 1.0)
        apart = minimum_energy_solution(problem)
        assert scaled_condition_number(whole.p) < scaled_condition_number(apart.p) / 100
        method = ClosedFormSynthesis(rate_controller=problem.rate, rate_observer=0.5)
        c = np.ones((1, 8))
        d = np.zeros((1, 1))
        linear = StateSpace(a=problem.a, b=problem.b, c=c, d=d)
        assert method.state_feedback(linear, problem.ball).certified


def test_a_slow_mode_out_of_reach_joins_the_metric_and_one_on_the_circle_does_not() -> None:
    ball = JacobianBall(alpha=1.0, beta=0.3)
    a = np.diag([1.1, 0.5])
    b = np.array([[1.0], [0.0]])
    state_weight = np.eye(2)
    problem = Problem(a=a, b=b, ball=ball, rate=0.2, state_weight=state_weight, input_weight=1.0)
    solution = solution_with_full_metric(problem, 0.5, 1.0)
    assert holds(problem, solution)
    a = np.diag([1.1, problem.contraction_factor])
    on = replace(problem, a=a)
    contraction = on.contraction_factor * (1 + 1e-12)
    apart = split_modes(on.a, on.b, contraction)
    fast = minimum_energy_gain(apart, ball, on.contraction_factor)
    with pytest.raises(NoSolution, match="on the circle"):
        modes.full_metric(on, apart, fast, 0.9)


def test_without_fast_modes_there_is_nothing_to_couple() -> None:
    problem = replace(cost_problem(), a=0.1 * np.eye(len(cost_problem().a)))
    with pytest.raises(NoSolution, match="no fast modes"):
        solution_with_full_metric(problem, 0.5, 1.0)
    for found in (
        minimum_energy_solution(problem),
        solve_on_fast_modes(problem, 0.5, "feasibility", "SCS"),
    ):
        assert not found.k.any()  # the model contracts by itself
        assert holds(problem, found)


@A_THIRD
@given(SEEDS, st.integers(1, 2))
def test_one_percent_beyond_nothing_is_certified_and_the_lmi_never_contradicts(
    seed: int, inputs: int
) -> None:
    orders = (1, 6)
    case = instance(seed, -0.01, orders, inputs)
    refused = design(RiccatiSynthesis, case)
    assert isinstance(refused, Infeasible)
    assert refused.proved
    assert refused.rate > refused.rate_limit
    opinion = certificate_from_paper_lmi(case.linear, case.ball, case.rate)
    assert not opinion.certified


@A_THIRD
@given(SEEDS)
def test_wherever_the_solver_certifies_the_rate_lies_inside(seed: int) -> None:
    """The verdict of the LMI, where it is one, against the closed form: ten percent inside and
    beyond."""
    for gap in (0.1, -0.1):
        orders = (1, 5)
        case = instance(seed, gap, orders)
        opinion = certificate_from_paper_lmi(case.linear, case.ball, case.rate)
        assert not (opinion.certified and gap < 0)
        if (
            gap > 0 and not opinion.certified
        ):  # false "infeasible" happens; the closed form shows that it is false
            assert design(ClosedFormSynthesis, case).certified


@given(SEEDS, st.integers(1, 3), st.floats(0.3, 0.95))
def test_the_ratio_limit_by_product_and_by_riccati(
    seed: int, inputs: int, contraction: float
) -> None:
    rng = np.random.default_rng(seed)
    linear = random_model(rng, 5, "marginal", mixed=True, inputs=inputs)
    eigenvalues = np.linalg.eigvals(linear.a)
    moduli = np.abs(eigenvalues)
    ah = linear.a / contraction
    bh = linear.b / contraction
    largest = moduli.max()
    if largest <= contraction or np.abs(moduli - contraction).min() < 0.02:
        return
    s = scipy.linalg.solve_discrete_are(ah, bh, 1e-13 * np.eye(5), np.eye(inputs))
    eigenvalues = np.linalg.eigvalsh(bh.T @ s @ bh)
    expected = 1 / np.sqrt(1 + eigenvalues[-1])
    actual = ratio_limit(linear.a, linear.b, contraction)
    assert actual == pytest.approx(expected, rel=1e-3)


@A_THIRD
@given(SEEDS, st.sampled_from(list(KINDS)), st.integers(1, 3), st.floats(0.05, 0.95))
def test_the_frontier_is_where_the_ratio_limit_crosses(
    seed: int, kind: str, inputs: int, ratio: float
) -> None:
    rng = np.random.default_rng(seed)
    linear = random_model(rng, 6, kind, mixed=True, inputs=inputs)
    ball = JacobianBall(alpha=1.0, beta=ratio)
    limit = contraction_frontier(linear.a, linear.b, ball).contraction_limit
    contraction = limit * (1 + 1e-6)
    lower_limit = ratio * (1 - 1e-9)
    actual = ratio_limit(linear.a, linear.b, contraction)
    assert actual >= lower_limit
    contraction = limit * (1 - 1e-6)
    upper_limit = ratio * (1 + 1e-9)
    actual = ratio_limit(linear.a, linear.b, contraction)
    assert actual <= upper_limit


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_without_fast_modes_every_ball_is_allowed(inputs: int) -> None:
    """`1 / sqrt(1 + 0)`: slower than the model contracts by itself, the input is not needed."""
    rng = np.random.default_rng(0)
    linear = random_model(rng, 5, "stable", mixed=True, inputs=inputs)
    contraction = linear.spectral_radius * 1.01
    actual = ratio_limit(linear.a, linear.b, contraction)
    assert actual == 1.0
    contraction = linear.spectral_radius * 0.99
    assert ratio_limit(linear.a, linear.b, contraction) < 1.0


def test_two_decoupled_inputs_are_two_frontiers() -> None:
    """Each input has its own mode: the limit is the worse of two scalar ones, `r = ratio
    |lambda|`."""
    for ratio in (0.3, 0.7):
        a = np.diag([0.9, 0.5])
        b = np.eye(2)
        ball = JacobianBall(alpha=-2.0, beta=2 * ratio)
        limit = contraction_frontier(a, b, ball).contraction_limit
        expected = pytest.approx(ratio * 0.9, rel=1e-9)
        assert limit == expected


def test_the_scalar_frontier_by_hand() -> None:
    """`x+ = 0.8 x + u`: contraction 0.4 is reachable iff the slopes lie within a factor (1 +
    1/2)/(1 - 1/2) = 3."""
    one = np.ones((1, 1))
    ball = JacobianBall.from_slopes(1.0, 3.0)
    contraction_limit = contraction_frontier(0.8 * one, one, ball).contraction_limit
    assert contraction_limit == pytest.approx(0.4)
    ball = JacobianBall.from_slopes(-3.0, -1.0)
    contraction_limit = contraction_frontier(0.8 * one, one, ball).contraction_limit
    assert contraction_limit == pytest.approx(0.4)


@given(SEEDS)
def test_the_gain_explicit_in_modes_is_the_gain_from_schur_coordinates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    linear = random_model(rng, 6, "stable", mixed=True)
    ball = JacobianBall.from_slopes(0.3, 1.0)
    r = 0.7
    values, vectors = np.linalg.eig(linear.a.astype(complex))
    difference = np.abs(values[:, None] - values)
    apart = difference + np.eye(6)
    difference = np.abs(np.abs(values) - r)
    largest_difference = difference.min()
    smallest = min(apart.min(), largest_difference)
    if smallest < 1e-2:
        return
    solution = np.linalg.solve(vectors, linear.b.astype(complex))
    b = solution[:, 0]
    inverse = np.linalg.inv(vectors)
    k = modal_gain(values, b, ball, r) @ inverse
    schur = minimum_energy_gain(split_modes(linear.a, linear.b, r), ball, r, widens_ball=False).k[0]
    atol = 1e-8 * np.abs(schur).max(initial=1e-9)
    np.testing.assert_allclose(k.real, schur, rtol=1e-6, atol=atol)
    atol = 1e-8 * np.abs(schur).max(initial=1e-9)
    np.testing.assert_allclose(k.imag, 0, atol=atol)
    fast = np.abs(values) > r
    w = modal_energy(values[fast], b[fast], r)
    inverse = np.linalg.inv(vectors)
    left = inverse[fast]
    modes = split_modes(linear.a, linear.b, r)
    pseudo_inverse = np.linalg.pinv(modes.left[: modes.fast_mode_count])
    into = left @ pseudo_inverse  # both are left invariant coordinates of the same space
    expected = w
    if modes.fast_mode_count:
        a = modes.a_fast / r
        root = into @ inverse_time_gramian_root(a, modes.b_fast / r)
        expected = root @ root.conj().T
    atol = 1e-8 * np.abs(w).max(initial=1e-9)
    np.testing.assert_allclose(w, expected, rtol=1e-5, atol=atol)


def test_the_gain_mirrors_the_fast_modes_at_the_circle() -> None:
    rng = np.random.default_rng(5)
    linear = random_model(rng, 6, "unstable", mixed=True)
    ball = JacobianBall(alpha=2.0, beta=0.0)
    gain = minimum_energy_gain(split_modes(linear.a, linear.b, 0.8), ball, 0.8, widens_ball=False).k
    before = np.linalg.eigvals(linear.a)
    after = np.linalg.eigvals(linear.a + 2.0 * linear.b @ gain)
    mirrored = np.where(
        np.abs(before) > 0.8, 0.64 / np.maximum(np.abs(before), 1e-9), np.abs(before)
    )
    actual = np.sort(np.abs(after))
    expected = np.sort(mirrored)
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


OBJECTIVES = ["feasibility", "largest_margin", "smallest_gain", "guaranteed_cost"]


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(
    ("objective", "solver"), [(name, "CLARABEL") for name in OBJECTIVES] + [("feasibility", "SCS")]
)
def test_every_objective_form_and_solver_is_certified(
    objective: str, solver: str, full: bool
) -> None:
    orders = (3, 3)
    case = instance(4, 0.5, orders)
    part = design(
        LmiSynthesis, case, objective=objective, full=full, solver=solver, state_weight=0.1
    )
    assert part.certified, part


@pytest.mark.parametrize("inputs", [1, 2])
def test_smallest_gain_is_no_larger_than_the_others(inputs: int) -> None:
    orders = (4, 4)
    case = instance(7, 0.3, orders, inputs)
    smallest = design(LmiSynthesis, case, objective="smallest_gain")
    other = design(ClosedFormSynthesis, case)
    assert isinstance(smallest, StateFeedback)
    assert isinstance(other, StateFeedback)
    assert smallest.certified
    upper_limit = other.gain_norm * (1 + 1e-3)
    assert smallest.gain_norm <= upper_limit


def test_theorem_two_is_theorem_one_transposed() -> None:
    rng = np.random.default_rng(3)
    linear = random_model(rng, 4, "stable", mixed=True)
    a = linear.a.T.copy()
    b = linear.c.T.copy()
    c = linear.b.T.copy()
    d = np.zeros((1, 1))
    dual = StateSpace(a=a, b=b, c=c, d=d)
    ball = JacobianBall.from_slopes(0.5, 1.0)
    method = ClosedFormSynthesis(rate_controller=0.3, rate_observer=0.3)
    observer = method.observer(linear, ball)
    feedback = method.state_feedback(dual, ball)
    assert not isinstance(observer, Infeasible)
    assert not isinstance(feedback, Infeasible)
    actual = observer.l.T
    np.testing.assert_array_equal(actual, feedback.k)
    np.testing.assert_array_equal(observer.q, feedback.p)
