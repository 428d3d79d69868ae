"""A certificate with room to spare: design for a faster rate than the one that is claimed.

Problem. A gain at the edge of Theorem 1 leaves its inequality no margin.
Hypotheses. Those of Theorem 1 of [Z26]: `x+ = A x + B S_u(u)`, Jacobians of S_u in the ball `alpha
I + beta Delta`.
Statement. If `(P, Y, X, sigma)` satisfies the inequality at rate `rho'`, it satisfies it at every
`rho < rho'`: only
the block `(1 - rho) P - sigma B B^T` depends on rho, and it grows by `(rho' - rho) P > 0`.
When not to use it. Close to the frontier there is no room, and the search falls back to the rate
itself.
Reference. [Z26] Theorem 1; the statement is the monotonicity of its first block.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

from ssm_study.certificates.frontier import Frontier
from ssm_study.certificates.problem import Problem, Solution
from ssm_study.refusal import require
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.guaranteed_cost import guaranteed_cost


@dataclass(frozen=True, kw_only=True)
class Reserved(Synthesis):
    """The gain of least guaranteed cost at `rate + reserve (rate_limit - rate)`, certified at
    `rate`."""

    method: ClassVar[str] = "reserved"
    reserve: float = 0.25

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            0 <= self.reserve < 1,
            "synthesis.reserve",
            self.reserve,
            "is a share below one",
            "use 0.25",
        )

    def solve(self, problem: Problem) -> Solution:
        return guaranteed_cost(problem)

    def solution_attempts(
        self, problem: Problem, frontier: Frontier
    ) -> list[Callable[[], Solution]]:
        faster = problem.rate + self.reserve * (min(frontier.rate_limit, 1.0) - problem.rate)
        return [
            partial(self.solve, replace(problem, rate=faster)),
            *super().solution_attempts(problem, frontier),
        ]
