"""A lightly damped spring that hardens has no quadratic metric in which it contracts at all of its
stiffnesses (docs/models.md, "A model that need not contract")."""

import cvxpy as cp
import numpy as np
import pytest

SOFT = 0.04
HARD = 0.18  # a spring at 1.2 times the displacement at which its cubic part equals the linear one
LIMIT = np.sqrt(HARD) - np.sqrt(SOFT)


def decays_in_one_metric(damping: float) -> bool:
    """Whether some P > 0 has `A' P + P A < 0` for both stiffnesses."""
    p = cp.Variable((2, 2), symmetric=True)
    constraints = [p >> np.eye(2)]
    for stiffness in (SOFT, HARD):
        a = np.array([[0.0, 1.0], [-stiffness, -damping]])
        constraints.append(a.T @ p + p @ a << -1e-6 * np.eye(2))
    problem = cp.Problem(cp.Minimize(cp.trace(p)), constraints)
    problem.solve(solver=cp.CLARABEL)
    return problem.status == cp.OPTIMAL


def circle_criterion_holds(damping: float) -> bool:
    """Whether `Re (k_2 - w^2 + i c w)(k_1 - w^2 - i c w) > 0` at every frequency w."""
    w = np.linspace(0.0, 1.0, 20001)
    hard = HARD - w**2 + 1j * damping * w
    soft = SOFT - w**2 - 1j * damping * w
    return bool((hard * soft).real.min() > 0.0)


@pytest.mark.parametrize("share", [0.4, 0.95, 1.05, 2.0])
def test_a_common_metric_needs_as_much_damping_as_the_roots_differ(share: float) -> None:
    damping = share * LIMIT
    assert decays_in_one_metric(damping) == (share > 1.0)
    actual = circle_criterion_holds(damping)
    assert actual == (share > 1.0)


def test_feedback_of_the_velocity_adds_the_damping() -> None:
    """The spring of the benchmark (`log_kinds.hardening_spring`) has a third of what it needs."""
    damping = 0.075
    assert not decays_in_one_metric(damping)
    feedback = 0.2
    assert decays_in_one_metric(damping + feedback)
