"""Guaranteed costs and their Riccati equations: every slope, every tau, doubling against SciPy."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.riccati import solve_riccati, solve_riccati_by_doubling
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis, guaranteed_cost, solve_at_tau
from ssm_study.synthesis.lmi import CompiledLmi
from ssm_study.systems import JacobianBall

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from cost_cases import cost_problem
from synthesis_instances import random_model

SEEDS = st.integers(0, 10**6)


@given(SEEDS, st.integers(1, 12), st.floats(0.1, 100.0))
def test_doubling_solves_what_scipy_solves(seed: int, order: int, kappa: float) -> None:
    rng = np.random.default_rng(seed)
    linear = random_model(rng, order, "unstable", mixed=True)
    state_weight = 0.1 * np.eye(order)
    q = linear.c.T @ linear.c + state_weight
    s = solve_riccati(linear.a, linear.b, q, kappa)
    input_weight = np.eye(1) / kappa
    expected = scipy.linalg.solve_discrete_are(linear.a, linear.b, q, input_weight)
    largest = np.abs(expected).max()
    atol = 1e-5 * largest
    np.testing.assert_allclose(s, expected, rtol=1e-5, atol=atol)


def test_doubling_gives_up_on_a_mode_out_of_reach() -> None:
    a = np.diag([2.0, 0.5])
    b = np.array([[0.0], [1.0]])
    q = np.eye(2)
    with pytest.raises(NoSolution):
        solve_riccati(a, b, q, 1.0)


def test_what_doubling_leaves_unsolved_is_solved_by_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    linear = random_model(rng, 4, "unstable", mixed=True)
    q = np.eye(4)
    expected = solve_riccati(linear.a, linear.b, q, 2.0)
    largest = np.abs(expected).max()
    shift = 1e-4 * largest * np.eye(4)
    for spoilt in (None, expected + shift):
        monkeypatch.setattr(
            "ssm_study.certificates.riccati.solve_riccati_by_doubling", lambda *_, s=spoilt: s
        )
        actual = solve_riccati(linear.a, linear.b, q, 2.0)
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6)


def test_doubling_gives_up_where_a_step_is_singular() -> None:
    """`I + G H = 0`: no solution by this route, said without an exception."""
    one = np.ones((1, 1))
    riccati_by_doubling = solve_riccati_by_doubling(one, -one, one)
    assert riccati_by_doubling is None
    riccati_by_doubling = solve_riccati_by_doubling(one, 0.5 * one, one)
    assert riccati_by_doubling is not None


def test_the_guaranteed_cost_bounds_the_cost_of_every_slope() -> None:
    """`x0^T S x0 >= sum r^-2k (x^T Q x + u^T R u)` for slopes that jump about in the ball as they
    like."""
    problem = cost_problem()
    solution = guaranteed_cost(problem)
    tau = float(solution.status.split()[1])
    inverse = np.linalg.inv(solution.p)
    s = tau * inverse
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = x0 = rng.normal(size=4)
        cost = 0.0
        discount = 1.0
        for _ in range(300):
            u = solution.k @ x
            state_cost = x @ problem.state_weight @ x
            input_cost = problem.input_weight * u @ u
            cost += discount * float(state_cost + input_cost)
            slope = rng.choice([0.4, 1.0])
            x = problem.a @ x + problem.b @ (slope * u)
            discount /= problem.contraction_factor**2
        upper_limit = float(x0 @ s @ x0) * (1 + 1e-5)
        assert cost <= upper_limit


def test_the_tau_search_finds_the_cheapest_admissible_tau() -> None:
    problem = cost_problem()
    best = np.inf
    for tau in np.geomspace(1e-2, 1e6, 400):
        point = solve_at_tau(problem, tau)
        cost = np.inf if point is None else point.cost
        best = min(best, cost)
    status = guaranteed_cost(problem).status
    tau = float(status.split()[1])
    found = solve_at_tau(problem, tau)
    assert found is not None
    upper_limit = best * (1 + 1e-3)
    assert found.cost <= upper_limit


def test_the_smallest_tau_is_where_the_gain_of_the_equation_changes_sign() -> None:
    """`kappa > 0` iff `tau > R / (alpha^2 - beta^2)`; alpha is not one here."""
    ball = JacobianBall(alpha=2.0, beta=0.5)
    problem = cost_problem(ball=ball)
    difference = 2.0**2 - 0.5**2
    smallest = problem.input_weight / difference
    tau = smallest * (1 - 1e-6)
    assert solve_at_tau(problem, tau) is None
    assert solve_at_tau(problem, smallest * 1e9) is not None


def test_the_cost_is_of_output_state_and_input() -> None:
    """`output_weight |C x|^2 + state_weight |x|^2 + input_weight |u|^2`, with the defaults that
    users rely on."""
    rng = np.random.default_rng(2)
    linear = random_model(rng, 4, "stable", mixed=True)
    ball = JacobianBall(alpha=1.0, beta=0.3)
    rates = {"rate_controller": 0.1, "rate_observer": 0.1}
    riccati_synthesis = RiccatiSynthesis(**rates)
    cost = riccati_synthesis.problem(linear, ball)
    expected = linear.c.T @ linear.c + 1e-4 * np.eye(4)
    np.testing.assert_allclose(cost.state_weight, expected)
    other = RiccatiSynthesis(**rates, output_weight=3.0, state_weight=0.5, input_weight=7.0)
    cost = other.problem(linear, ball)
    expected = 3.0 * linear.c.T @ linear.c + 0.5 * np.eye(4)
    np.testing.assert_allclose(cost.state_weight, expected)
    assert cost.input_weight == 7.0
    riccati_synthesis = RiccatiSynthesis(
        **rates, input_noise=3.0, state_noise=0.5, output_noise=7.0
    )
    told = riccati_synthesis.problem(linear, ball, is_observer=True)
    expected = 3.0 * linear.b @ linear.b.T + 0.5 * np.eye(4)
    np.testing.assert_allclose(told.state_weight, expected)
    assert told.input_weight == 7.0


def test_no_admissible_tau_is_no_solution() -> None:
    ball = JacobianBall.from_slopes(0.01, 1.0)
    problem = cost_problem(rate=0.9, ball=ball)
    with pytest.raises(NoSolution):
        guaranteed_cost(problem)


def test_a_compiled_sweep_gives_what_fresh_problems_give() -> None:
    problem = cost_problem()
    state_weight = np.eye(4)
    shared = CompiledLmi(
        a=problem.a,
        b=problem.b,
        objective="smallest_gain",
        full=False,
        state_weight=state_weight,
        input_weight=1.0,
    )
    for rate in (0.05, 0.1, 0.2):
        case = cost_problem(rate)
        state_weight = np.eye(4)
        fresh = CompiledLmi(
            a=problem.a,
            b=problem.b,
            objective="smallest_gain",
            full=False,
            state_weight=state_weight,
            input_weight=1.0,
        )
        actual = shared.solve(case).k
        expected = fresh.solve(case).k
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("slopes", [(0.4, 1.0), (1.0, 1.0)])
def test_an_input_in_smaller_units_has_the_same_gain(slopes: tuple[float, float]) -> None:
    """`B/c` and `c S_u` are the plant of `B` and `S_u`; powers of two round nothing."""
    problem = cost_problem(ball=JacobianBall.from_slopes(*slopes))
    expected = guaranteed_cost(problem).k
    for scale in (2.0**-6, 2.0**6):
        ball = JacobianBall.from_slopes(scale * slopes[0], scale * slopes[1])
        scaled = replace(problem, b=problem.b / scale, ball=ball)
        actual = guaranteed_cost(scaled).k
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
