"""The theorems of models with neurons: sampled slopes, exact frontiers, each other, and what they
must refuse."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structured_cases import (
    KNOWN,
    asked,
    controlled_steps,
    drawn,
    observing_steps,
    slopes_of_all,
    slowest,
)

from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import NoSolution, dual_system
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import augmented_system
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.synthesis.structured_lmi import (
    StructuredLmi,
    fastest_confirmed_solution,
    is_confirmed_exactly,
    largest_rate_with_neurons,
)
from ssm_study.synthesis.structured_riccati import (
    TRIES,
    RiccatiGame,
    continue_to_rate,
    evaluate_saddle_point,
    least_guaranteed_cost,
    log_multipliers,
    minimise_guaranteed_cost,
)
from ssm_study.systems import JacobianBall, JacobianBalls, StructuredSystem

WIDE = JacobianBall.from_slopes(0.6, 1.0)
SIDES = {"state_feedback": StructuredStateFeedback, "observer": StructuredObserver}


def sampled(system: StructuredSystem, side: str, ball: JacobianBall, found) -> float:
    slopes = slopes_of_all(system, 0, random=100)
    if side == "state_feedback":
        metric = np.linalg.inv(found.p)
        steps = controlled_steps(system, found.k, ball, slopes)
        return slowest(metric, steps)
    l_ = found.k.T
    l_z = found.k_w.T
    steps = observing_steps(system, l_, l_z, ball, slopes)
    return slowest(found.p, steps)


@given(
    seed=st.integers(0, 10_000),
    side=st.sampled_from(list(SIDES)),
    ball=st.sampled_from([KNOWN, WIDE]),
    h=st.sampled_from([0.0, 0.3]),
    share=st.floats(0.1, 0.9),
)
@settings(max_examples=20)
def test_no_sampled_slope_contracts_slower_than_certified(
    seed: int, side: str, ball, h: float, share: float
) -> None:
    system = drawn(seed, h=h if side == "observer" else 0.0)
    frontier = controller_frontier(
        system if side == "state_feedback" else dual_system(system), ball
    )
    limit = frontier.rate_limit
    rate = max(share * limit, 1e-3)
    problem = asked(system, side, ball, rate=rate)
    try:
        found = least_guaranteed_cost(problem)
    except NoSolution:
        return
    assert is_confirmed_exactly(problem, found)
    upper_limit = problem.contraction_factor * (1 + 1e-9)
    assert sampled(system, side, ball, found) <= upper_limit


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("ball", "h"), [(KNOWN, 0.0), (WIDE, 0.0), (WIDE, 0.3)])
def test_the_largest_rate_holds_and_no_more(side: str, ball: JacobianBall, h: float) -> None:
    """The solver's best is certified, sampled slopes agree, the frontier is above, and 0.8 r is
    refused."""
    system = drawn(5, h=h if side == "observer" else 0.0)
    rate = largest_rate_with_neurons(asked(system, side, ball, 0.5))
    problem = asked(system, side, ball, 0.99 * rate)
    structured_lmi = StructuredLmi(problem=problem, objective="largest_margin")
    found = structured_lmi.solve(problem.rate)
    frontier = controller_frontier(
        system if side == "state_feedback" else dual_system(system), ball
    )
    limit = frontier.rate_limit
    assert rate <= limit
    assert sampled(system, side, ball, found) <= problem.contraction_factor
    faster = asked(system, side, ball, 1 - (0.8 * problem.contraction_factor) ** 2)
    assert is_confirmed_exactly(problem, found)
    assert not is_confirmed_exactly(faster, found)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_neurons_without_effect_leave_the_exact_frontier(side: str, seed: int) -> None:
    still = drawn(seed, radius=1.1)
    e = 0 * still.e
    h = 0 * still.h
    still = StructuredSystem(**{**vars(still), "e": e, "h": h})
    system = still if side == "state_feedback" else dual_system(still)
    exact = controller_frontier(system, WIDE)
    found = np.sqrt(1 - largest_rate_with_neurons(asked(still, side, WIDE, 0.1)))
    assert exact.contraction_limit <= found <= exact.contraction_limit + 2e-3


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("ball", "h"), [(KNOWN, 0.0), (WIDE, 0.0), (KNOWN, 0.3)])
def test_the_game_has_the_cost_of_the_inequality(side: str, ball: JacobianBall, h: float) -> None:
    """The costs come by two routes that share no line: a semidefinite program, and Riccati
    equations with a search."""
    system = drawn(9, h=h if side == "observer" else 0.0)
    problem = asked(system, side, ball, 0.15)
    structured_lmi = StructuredLmi(problem=problem, objective="guaranteed_cost")
    slow = structured_lmi.solve(problem.rate)
    fast = least_guaranteed_cost(problem)
    costs = [float(np.trace(np.linalg.inv(found.p))) for found in (slow, fast)]
    if side == "observer":
        costs[1] *= 1 - problem.rate  # its noise enters a step later
    upper_limit = costs[1] * (1 + 1e-3)
    assert costs[0] <= upper_limit
    upper_limit = costs[0] * 1.05
    assert costs[1] <= upper_limit


@pytest.mark.parametrize("barrier", [0.0, 0.5])
@pytest.mark.parametrize(("side", "ball"), list(product(SIDES, (WIDE, KNOWN))))
def test_the_gradient_is_that_of_the_goal(side: str, ball: JacobianBall, barrier: float) -> None:
    problem = asked(drawn(2, m=2), side, ball, 0.1)
    game = RiccatiGame(problem=problem, r=problem.contraction_factor)
    logs, reached = continue_to_rate(game, *TRIES[0])
    assert reached == game.r
    logs = logs + 0.1
    step = 1e-5 * np.eye(len(logs))
    ends = [
        (
            evaluate_saddle_point(game, logs + d, barrier).goal,
            evaluate_saddle_point(game, logs - d, barrier).goal,
        )
        for d in step
    ]
    saddle = evaluate_saddle_point(game, logs, barrier)
    actual = saddle.gradient
    expected = [(up - down) / 2e-5 for up, down in ends]
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-7)
    vector = minimise_guaranteed_cost(game, logs, barrier, 20)
    saddle = evaluate_saddle_point(game, vector, barrier)
    goal = saddle.goal
    saddle = evaluate_saddle_point(game, logs, barrier)
    upper_limit = saddle.goal
    assert goal <= upper_limit


@pytest.mark.parametrize(("side", "ball"), list(product(SIDES, (WIDE, KNOWN))))
def test_the_search_from_known_multipliers_ends_where_the_search_from_nothing_does(
    side: str, ball
) -> None:
    """From the solver's matrices at the largest rate, and from the solution with larger weights;
    none of a slow one."""
    system = drawn(5)
    rate, best = fastest_confirmed_solution(asked(system, side, ball, 0.5))
    problem = asked(system, side, ball, 0.6 * rate)
    dear = replace(problem, input_weight=10.0)
    cold = least_guaranteed_cost(problem)
    first = least_guaranteed_cost(dear, start_solution=best)
    actual = log_multipliers(problem, cold)
    np.testing.assert_allclose(actual, cold.logs, atol=1e-9)
    solution = least_guaranteed_cost(problem, start_solution=best)
    for found in (solution, least_guaranteed_cost(problem, start_solution=first)):
        assert is_confirmed_exactly(problem, found)
        inverse = np.linalg.inv(found.p)
        expected = np.trace(np.linalg.inv(cold.p))
        assert np.trace(inverse) == pytest.approx(expected, rel=0.02)
    near_the_limit = asked(system, side, ball, 0.95 * rate)
    solution = least_guaranteed_cost(near_the_limit, start_solution=best)
    assert is_confirmed_exactly(near_the_limit, solution)


def test_injection_where_the_output_sees_the_neurons_is_refused() -> None:
    system = drawn(4, h=0.2)
    problem = asked(system, "observer", KNOWN, 0.1)
    numbers = StructuredObserver.certificate_numbers(problem, least_guaranteed_cost(problem))
    assert StructuredObserver.holds(**numbers)
    l_z = 1e-9 * np.ones_like(numbers["l_z"])
    assert not StructuredObserver.holds(**{**numbers, "l_z": l_z})
    information = {"rate_limit": 1.0, "method": "", "status": ""}
    certificate = StructuredObserver.from_numbers(numbers, **information)
    balls = JacobianBalls(input=KNOWN, output=KNOWN)
    context = VerificationContext(system=system, controlled=system, balls=balls, gains={})
    assert certificate.failed_checks(context) == []
    (sentence,) = replace(certificate, l_z=l_z).failed_checks(context)
    assert sentence.startswith(".l_z: must be zero")


def test_integrators_are_states_like_others() -> None:
    """An integrator of the output is certified at a rate that the plant alone, with its mode at
    one, cannot have."""
    gain = np.eye(1)
    modes = np.eye(1)
    system = augmented_system(drawn(9, h=0.1), gain, modes)
    problem = asked(system, "state_feedback", WIDE, 0.02)
    found = least_guaranteed_cost(problem)
    assert is_confirmed_exactly(problem, found)
    assert sampled(system, "state_feedback", WIDE, found) <= problem.contraction_factor
    linears = map(system.linearise_at_slopes, system.slope_corners())
    alone = [linear.a for linear in linears]
    assert all(np.abs(np.linalg.eigvals(a)).max() > 1 - 1e-12 for a in alone)


def test_known_multipliers_are_scaled_up_to_cover_larger_weights(monkeypatch):
    problem = asked(drawn(4), "state_feedback", WIDE, 0.1)
    found = least_guaranteed_cost(problem)
    state_weight = 1e4 * problem.state_weight
    heavier = replace(problem, state_weight=state_weight)
    module = "ssm_study.synthesis.structured_riccati"
    monkeypatch.setattr(f"{module}.continue_to_rate", None)  # the search from far is not needed
    again = least_guaranteed_cost(heavier, found)
    assert is_confirmed_exactly(heavier, again)
