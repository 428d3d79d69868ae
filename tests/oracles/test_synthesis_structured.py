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
from ssm_study.certificates.problem import NoSolution, dual
from ssm_study.certificates.theorems.integral_action import augmented
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.synthesis.structured_lmi import (
    StructuredLmi,
    fastest_solution,
    is_confirmed,
    largest_rate,
)
from ssm_study.synthesis.structured_riccati import (
    TRIES,
    Game,
    continue_to_rate,
    evaluate_saddle,
    least_cost,
    logs_of,
    minimise_goal,
)
from ssm_study.systems import JacobianBall, StructuredSystem

WIDE = JacobianBall.from_slopes(0.6, 1.0)
SIDES = {"state_feedback": StructuredStateFeedback, "observer": StructuredObserver}


def sampled(system: StructuredSystem, side: str, ball: JacobianBall, found) -> float:
    slopes = slopes_of_all(system, 0, random=100)
    if side == "state_feedback":
        return slowest(np.linalg.inv(found.p), controlled_steps(system, found.k, ball, slopes))
    return slowest(found.p, observing_steps(system, found.k.T, found.k_w.T, ball, slopes))


@given(
    seed=st.integers(0, 10_000),
    side=st.sampled_from(list(SIDES)),
    ball=st.sampled_from([KNOWN, WIDE]),
    h=st.sampled_from([0.0, 0.3]),
    share=st.floats(0.1, 0.9),
)
@settings(max_examples=60, deadline=None)
def test_no_sampled_slope_contracts_slower_than_certified(
    seed: int, side: str, ball, h: float, share: float
) -> None:
    system = drawn(seed, h=h if side == "observer" else 0.0)
    limit = controller_frontier(
        system if side == "state_feedback" else dual(system), ball
    ).rate_limit
    problem = asked(system, side, ball, rate=max(share * limit, 1e-3))
    try:
        found = least_cost(problem)
    except NoSolution:
        return
    assert is_confirmed(problem, found)
    assert sampled(system, side, ball, found) <= problem.contraction * (1 + 1e-9)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("ball", "h"), [(KNOWN, 0.0), (WIDE, 0.0), (WIDE, 0.3)])
def test_the_largest_rate_holds_and_no_more(side: str, ball: JacobianBall, h: float) -> None:
    """The solver's best is certified, sampled slopes agree, the frontier is above, and 0.8 r is
    refused."""
    system = drawn(5, h=h if side == "observer" else 0.0)
    rate = largest_rate(asked(system, side, ball, 0.5))
    problem = asked(system, side, ball, 0.99 * rate)
    found = StructuredLmi(problem=problem, objective="largest_margin").solve(problem.rate)
    limit = controller_frontier(
        system if side == "state_feedback" else dual(system), ball
    ).rate_limit
    assert rate <= limit
    assert sampled(system, side, ball, found) <= problem.contraction
    faster = asked(system, side, ball, 1 - (0.8 * problem.contraction) ** 2)
    assert is_confirmed(problem, found)
    assert not is_confirmed(faster, found)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_neurons_without_effect_leave_the_exact_frontier(side: str, seed: int) -> None:
    still = drawn(seed, radius=1.1)
    still = StructuredSystem(**{**vars(still), "e": 0 * still.e, "h": 0 * still.h})
    exact = controller_frontier(still if side == "state_feedback" else dual(still), WIDE)
    found = np.sqrt(1 - largest_rate(asked(still, side, WIDE, 0.1)))
    assert exact.contraction_limit <= found <= exact.contraction_limit + 2e-3


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("ball", "h"), [(KNOWN, 0.0), (WIDE, 0.0), (KNOWN, 0.3)])
def test_the_game_has_the_cost_of_the_inequality(side: str, ball: JacobianBall, h: float) -> None:
    """The costs come by two routes that share no line: a semidefinite program, and Riccati
    equations with a search."""
    system = drawn(9, h=h if side == "observer" else 0.0)
    problem = asked(system, side, ball, 0.15)
    slow = StructuredLmi(problem=problem, objective="guaranteed_cost").solve(problem.rate)
    fast = least_cost(problem)
    costs = [float(np.trace(np.linalg.inv(found.p))) for found in (slow, fast)]
    if side == "observer":
        costs[1] *= 1 - problem.rate  # its noise enters a step later
    assert costs[0] <= costs[1] * (1 + 1e-3)
    assert costs[1] <= costs[0] * 1.05


@pytest.mark.parametrize("barrier", [0.0, 0.5])
@pytest.mark.parametrize(("side", "ball"), list(product(SIDES, (WIDE, KNOWN))))
def test_the_gradient_is_that_of_the_goal(side: str, ball: JacobianBall, barrier: float) -> None:
    problem = asked(drawn(2, m=2), side, ball, 0.1)
    game = Game(problem=problem, r=problem.contraction)
    logs, reached = continue_to_rate(game, *TRIES[0])
    assert reached == game.r
    logs = logs + 0.1
    step = 1e-5 * np.eye(len(logs))
    ends = [
        (
            evaluate_saddle(game, logs + d, barrier).goal,
            evaluate_saddle(game, logs - d, barrier).goal,
        )
        for d in step
    ]
    np.testing.assert_allclose(
        evaluate_saddle(game, logs, barrier).gradient,
        [(up - down) / 2e-5 for up, down in ends],
        rtol=1e-4,
        atol=1e-7,
    )
    assert (
        evaluate_saddle(game, minimise_goal(game, logs, barrier, 20), barrier).goal
        <= evaluate_saddle(game, logs, barrier).goal
    )


@pytest.mark.parametrize(("side", "ball"), list(product(SIDES, (WIDE, KNOWN))))
def test_the_search_from_known_multipliers_ends_where_the_search_from_nothing_does(
    side: str, ball
) -> None:
    """From the solver's matrices at the largest rate, and from the solution with larger weights;
    none of a slow one."""
    system = drawn(5)
    rate, best = fastest_solution(asked(system, side, ball, 0.5))
    problem = asked(system, side, ball, 0.6 * rate)
    dear = replace(problem, input_weight=10.0)
    cold = least_cost(problem)
    first = least_cost(dear, near=best)
    np.testing.assert_allclose(logs_of(problem, cold), cold.logs, atol=1e-9)
    for found in (least_cost(problem, near=best), least_cost(problem, near=first)):
        assert is_confirmed(problem, found)
        assert np.trace(np.linalg.inv(found.p)) == pytest.approx(
            np.trace(np.linalg.inv(cold.p)), rel=0.02
        )
    near_the_limit = asked(system, side, ball, 0.95 * rate)
    assert is_confirmed(near_the_limit, least_cost(near_the_limit, near=best))


def test_a_negative_multiplier_certifies_nothing() -> None:
    """`A` with an eigenvalue 1.2 and `L = 0` at r = 0.9: with a negative eta the first corner alone
    is positive."""
    one = np.ones((1, 1))
    numbers = {
        "a": 1.2 * one,
        "c": one,
        "e": 0 * one,
        "f": 0 * one,
        "h": 0 * one,
        "q": one,
        "u": one,
        "l": 0 * one,
    }
    numbers |= {
        "alpha": 1.0,
        "beta": 0.0,
        "lambda_": np.ones(1),
        "l_z": 0 * one,
        "rate": 1 - 0.9**2,
    }
    without_row_two = 0.9**2 + 2.0 - 1.2**2
    assert without_row_two > 0
    assert not StructuredObserver.holds(**numbers, eta=-2.0)
    assert not StructuredObserver.holds(**numbers, eta=1e-6)
    assert StructuredObserver.holds(**{**numbers, "a": 0.8 * one}, eta=1e-6)


def test_injection_where_the_output_sees_the_neurons_is_refused() -> None:
    system = drawn(4, h=0.2)
    problem = asked(system, "observer", KNOWN, 0.1)
    numbers = StructuredObserver.numbers_of(problem, least_cost(problem))
    assert StructuredObserver.holds(**numbers)
    assert not StructuredObserver.holds(**{**numbers, "l_z": 1e-9 * np.ones_like(numbers["l_z"])})


def test_integrators_are_states_like_others() -> None:
    """An integrator of the output is certified at a rate that the plant alone, with its mode at
    one, cannot have."""
    system = augmented(drawn(9, h=0.1), np.eye(1), np.eye(1))
    problem = asked(system, "state_feedback", WIDE, 0.02)
    found = least_cost(problem)
    assert is_confirmed(problem, found)
    assert sampled(system, "state_feedback", WIDE, found) <= problem.contraction
    alone = [linear.a for linear in map(system.linearise_at_slopes, system.corners())]
    assert all(np.abs(np.linalg.eigvals(a)).max() > 1 - 1e-12 for a in alone)
