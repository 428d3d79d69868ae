"""State feedback of a bilinear model under which any two trajectories inside a stated set of states
approach each other.

Problem. `x+ = sum_i theta_i(v) (A_i x + b_i)` as in `bilinear_loop`, with `v = K x`, the state
known: where do two motions approach each other, and how fast?

Hypotheses. The input acts as computed, the state is measured, and the plant is the model.

Statement. With `D_k`, `B_k` of `bilinear_loop` and `M_k = (A_{k+1} - A_k) / D_k`, let for all i
and k

    (A_i + B_k K)' P (A_i + B_k K) < r_c^2 P,   M_k' P M_k < mu^2 P,   K'K < g^2 P

and `r > r_c + rho g mu`, `r < 1`, `rho g < min(-v_1, v_q)`. Then the distance `|x - x'|_P` of two
motions that start in `|x|_P <= rho` shrinks by r or more in each sample, and both stay there.
Proof: the Jacobian on segment k is `A(v) + B_k K + M_k x K`, and `|M_k x| <= mu rho`, `|K dx| <= g
|dx|_P`; the set is convex and holds the motion at rest.

When not to use it. With an observer, whose error moves the input of one motion and not of the
other: `bilinear_loop` says what holds then. Far from rest nothing contracts: `M_k x` grows with x.

Reference. docs/theory.md, "Products of input and state"; Lohmiller & Slotine (1998),
section 2 (contraction in a ball).

Example. That of `bilinear_loop`, where `M_k = 0.1` and `g = 0.25`: with `r_c = 0.45` the set of
radius 3 contracts at `0.45 + 3 * 0.25 * 0.12 = 0.54`, so at 0.6 and not at 0.5.

>>> print(*(BilinearContraction.holds(**example_numbers(r)) for r in (0.6, 0.5)))
True False
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from ssm_study.certificates.theorem import Blocks
from ssm_study.certificates.theorems import bilinear_loop
from ssm_study.certificates.theorems.bilinear_loop import (
    BilinearTheorem,
    count_nodes,
    feedback_conditions,
    gain_bound_blocks,
    input_bound_block,
    input_level_of_node,
    positivity_conditions,
    segment_width,
    state_matrix_at_node,
)


@dataclass(frozen=True, kw_only=True)
class BilinearContraction(BilinearTheorem):
    """Certificate that any two trajectories of a bilinear model under state feedback approach each
    other, inside a stated set of states. `variation` bounds how fast A follows the input."""

    gain_state: float
    variation: float
    radius: float

    part: ClassVar[str] = "bilinear_contraction"

    @staticmethod
    def conditions(proof: Any) -> dict[str, Blocks]:
        """Matrix inequalities at all input levels and segments of a bilinear model, and conditions
        on the set where it contracts."""
        conditions = feedback_conditions(proof)
        count = count_nodes(proof)
        for segment in range(count - 1):
            before = state_matrix_at_node(proof, segment)
            change = state_matrix_at_node(proof, segment + 1) - before
            bound = segment_width(proof, segment) * proof.variation
            label = f"variation on segment {segment + 1}"
            conditions[label] = gain_bound_blocks(change, proof.p, bound, proof.p)
        reach = proof.radius * proof.gain_state
        conditions["input by state"] = input_bound_block(proof, proof.gain_state, proof.p)
        conditions["metric"] = [[proof.p]]
        slope = proof.factor_controller + reach * proof.variation
        conditions["factor above that of the Jacobian"] = [[proof.factor - slope]]
        conditions["factor below 1"] = [[1 - proof.factor]]
        lowest = -input_level_of_node(proof, 0)
        conditions["lowest input"] = [[lowest - reach]]
        highest = input_level_of_node(proof, count - 1)
        conditions["highest input"] = [[highest - reach]]
        names = ("factor_controller", "variation", "gain_state", "radius")
        return conditions | positivity_conditions(proof, *names)


def example_numbers(factor: float) -> dict[str, Any]:
    """Numbers of a worked example for the contraction theorem: a bilinear model with one state and
    three input levels (nodes)."""
    numbers = bilinear_loop.example_numbers(0.45)
    for name in ("c", "l_nodes", "m", "factor_observer", "coupling", "weight", "gain_error"):
        del numbers[name]
    return numbers | {"factor": factor, "gain_state": 0.25, "variation": 0.12, "radius": 3.0}
