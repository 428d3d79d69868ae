"""Bilinear closed loop with a limited input that comes to rest from every initial state.

Problem. That of `bilinear_loop`, with `v = sat(K xh)`, cut at `v_1` and `v_q`: does the loop come
to rest from every start?

Hypotheses. The input acts as computed, the observer knows the cut input, and the plant is the
model. Zero is a node.

Statement. With the inequalities of `bilinear_loop` for `r_c`, `r_o` and kappa, let for all i

    A_i' P A_i < r_a^2 P

and `r > r_c`, `r > r_a`, `gamma (r - r_o) > kappa`, `r < 1`. Then `V = |x|_P + gamma |xh - x|_M`
shrinks by r or more in each sample, from every start. Proof: a cut input is `s K xh` with s in [0,
1], so `x+ = (A + s B K) x + s B K e`, a mean of `A x` and `(A + B K) x`.

When not to use it. Where the model does not come to rest without control; `bilinear_loop` then
names a set of starts. Its factor is no smaller than that without control: it says that the loop is
safe, not that it is fast. No set points, as there.

Reference. docs/theory.md, "Products of input and state"; the cut as a mean of none and
all: Hu & Lin (2001), section 3.2.

Example. That of `bilinear_loop`: without control 0.4, 0.5 and 0.6 times x are left, so `r_a = 0.65`
is proved and 0.55 is not.

>>> print(*(BilinearEverywhere.holds(**example_numbers(r_a)) for r_a in (0.65, 0.55)))
True False
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from ssm_study.certificates.theorem import Blocks
from ssm_study.certificates.theorems import bilinear_loop
from ssm_study.certificates.theorems.bilinear_loop import (
    BilinearLoopTheorem,
    cascade_conditions,
    contraction_blocks,
    count_nodes,
    coupling_conditions,
    feedback_conditions,
    observer_conditions,
    positivity_conditions,
    state_matrix_at_node,
)


@dataclass(frozen=True, kw_only=True)
class BilinearEverywhere(BilinearLoopTheorem):
    """Certificate that a bilinear closed loop with a limited input comes to rest from every initial
    state. `V = |x|_P + weight |e|_M` shrinks by `factor`; the model without control shrinks `|x|_P`
    by `factor_uncontrolled`."""

    factor_uncontrolled: float

    part: ClassVar[str] = "bilinear_everywhere"

    @staticmethod
    def conditions(proof: Any) -> dict[str, Blocks]:
        """Matrix inequalities at every input level (node) and segment between levels of a bilinear
        model, with and without control."""
        matrices = (
            feedback_conditions(proof) | observer_conditions(proof) | coupling_conditions(proof)
        )
        for node in range(count_nodes(proof)):
            label = f"without control at node {node + 1}"
            matrices[label] = contraction_blocks(
                state_matrix_at_node(proof, node), proof.p, proof.factor_uncontrolled
            )
        excess = proof.factor - proof.factor_uncontrolled
        matrices["factor above that without control"] = [[excess]]
        return (
            matrices
            | cascade_conditions(proof)
            | positivity_conditions(proof, "factor_uncontrolled")
        )


def example_numbers(factor_uncontrolled: float) -> dict[str, Any]:
    """Numbers of a worked example with an unlimited set of initial states: a bilinear loop with one
    state and three input levels."""
    numbers = bilinear_loop.example_numbers(0.45)
    del numbers["radius"], numbers["gain_error"], numbers["gain_state"]
    return numbers | {"factor": 0.7, "factor_uncontrolled": factor_uncontrolled}
