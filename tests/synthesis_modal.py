"""Oracles. Theorem 1 on the modes that matter, in the coordinates where a solver can see its
solutions; modal gains.

Restricted to the modes with `|lambda| > r`, scaled by 1/r and balanced by their minimum energy, the
block matrix has condition number about one over the room to the frontier, whatever the model's
order; the slow modes are added by a Lyapunov equation. This keeps the LMI's generality and cures
its false "infeasible" (docs/theory.md).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import scipy
from jaxtyping import Complex

from ssm_study.certificates.frontier import Frontier, inverse_time_gramian_root
from ssm_study.certificates.problem import Problem, Solution
from ssm_study.certificates.semidefinite import SOLVERS
from ssm_study.refusal import require
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.lmi import OBJECTIVES, CompiledLmi
from ssm_study.synthesis.modes import FastGain, split_modes, weighted_block_metric
from ssm_study.systems import JacobianBall

# The inequality is asked for a rate this share of the room faster, so that the slow modes find room
# beside it.
SHARES = (0.3, 0.1, 0.6)
FASTEST = 0.5


def modal_gain(
    eigenvalues: Complex[np.ndarray, "n"],
    b: Complex[np.ndarray, "n"],
    ball: JacobianBall,
    contraction: float,
) -> Complex[np.ndarray, "n"]:
    """`k (n,)` with `u = sum_i k_i z_i`, zero on slow modes; distinct eigenvalues, conjugate pairs
    with conjugate b."""
    fast = np.abs(eigenvalues) > contraction
    modes = eigenvalues[fast]
    reflected = contraction**2 / modes.conj()
    moved = modes[:, None] - reflected
    apart = modes[:, None] - modes
    np.fill_diagonal(apart, 1.0)
    count = len(eigenvalues)
    k = np.zeros(count, dtype=complex)
    # One quotient at a time: the products alone overflow for hundreds of modes.
    outside_ball = 1 - ball.relative_radius**2
    reach = b[fast] * outside_ball
    quotients = moved / apart
    product = np.prod(quotients, axis=1)
    k[fast] = -product / (reach * ball.alpha)
    return k


def modal_energy(
    eigenvalues: Complex[np.ndarray, "k"], b: Complex[np.ndarray, "k"], contraction: float
) -> Complex[np.ndarray, "k k"]:
    """`W` of the fast modes (all `|lambda| > r`): Hermitian; `P = (1/delta^2 - 1) W` with sigma =
    1."""
    outer_product = np.outer(b, b.conj())
    products = np.outer(eigenvalues, eigenvalues.conj())
    difference = products - contraction**2
    return outer_product / difference


def solve_on_fast_modes(problem: Problem, faster: float, objective: str, solver: str) -> Solution:
    """The inequality at a contraction `faster` than asked, on its fast modes; raises `NoSolution`
    like its parts."""
    modes = split_modes(problem.a, problem.b, faster)
    m = problem.b.shape[1]
    if modes.fast_mode_count == 0:
        no_metric = np.zeros((0, 0))
        no_gain = np.zeros((m, len(problem.a)))
        fast = FastGain(k=no_gain, p=no_metric)
        p = weighted_block_metric(problem, modes, fast)
        return Solution(p=p, y=p, k=fast.k, sigma=1.0, status="no fast modes")
    ah = modes.a_fast / faster
    bh = modes.b_fast / faster
    root = inverse_time_gramian_root(ah, bh)
    transformed = ah @ root
    balanced_a = scipy.linalg.solve_triangular(root, transformed, lower=True)
    balanced_b = scipy.linalg.solve_triangular(root, bh, lower=True)
    weights = {"state_weight": np.eye(modes.fast_mode_count), "input_weight": 1.0}
    form = {"objective": objective, "full": False}
    lmi = CompiledLmi(a=balanced_a, b=balanced_b, **form, **weights)
    # Scaled by 1/r, the asked factor is one: a rate just above zero stands for it.
    rate = float(np.finfo(float).eps)
    state_weight = np.eye(modes.fast_mode_count)
    balanced_problem = replace(
        problem, a=balanced_a, b=balanced_b, rate=rate, state_weight=state_weight
    )
    solution = lmi.solve(balanced_problem, solver)
    transposed = solution.k.T
    triangular = scipy.linalg.solve_triangular(root, transposed, lower=True, trans="T")
    fast_coordinates = modes.left[: modes.fast_mode_count]
    k = triangular.T @ fast_coordinates
    metric = solution.p / solution.sigma
    scaled_metric = root @ metric @ root.T
    fast = FastGain(k=k, p=scaled_metric)
    p = weighted_block_metric(problem, modes, fast)
    status = f"{solution.status} on {modes.fast_mode_count} fast modes"
    return Solution(p=p, y=p, k=k, sigma=1.0, status=status)


@dataclass(frozen=True, kw_only=True)
class ModalLmiSynthesis(Synthesis):
    """The paper's inequality where it is well conditioned. `objective`, `solver` as for the plain
    LMI."""

    objective: str = "largest_margin"
    solver: str = "CLARABEL"

    method: ClassVar[str] = "modal_lmi"

    def __post_init__(self) -> None:
        super().__post_init__()
        objectives = tuple(name for name in OBJECTIVES if name != "guaranteed_cost")
        condition = self.objective in objectives
        advice = f"use one of {objectives}"
        require(condition, "synthesis.objective", self.objective, "unknown", advice)
        condition = self.solver in SOLVERS
        advice = f"use one of {tuple(SOLVERS)}"
        require(condition, "synthesis.solver", self.solver, "unknown", advice)

    def solve(self, problem: Problem) -> Solution:
        contraction = problem.contraction_factor
        return solve_on_fast_modes(problem, contraction, self.objective, self.solver)

    def solution_attempts(
        self, problem: Problem, frontier: Frontier
    ) -> list[Callable[[], Solution]]:
        r = problem.contraction_factor
        solve = partial(solve_on_fast_modes, objective=self.objective, solver=self.solver)
        floor = max(frontier.contraction_limit, FASTEST * r)
        ratio = floor / r
        rates = [float(r * ratio**share) for share in SHARES]
        return [partial(solve, problem, rate) for rate in rates]
