"""Certificate that the loop of a model with neurons comes to rest on every plant with a model error
within a disc measured from records.

Problem. As in `measured_discs`, for the model and the observer of `structured_observer`.

Hypotheses. Those of `measured_discs`; each neuron is one fixed map of slopes in [0, 1], zero at
rest; `L_z = 0` where `H != 0`.

Statement. With the letters of `measured_discs` and `z = F x + G v`, `dz = F eps + L_z inj`, the
neurons of the model against rest `w`, and of the observer against the model `d`,

    x+ = A x + B v + E w + ...,    eps+ = A eps + E d + L inj,    o = C x + D v + H w,    do = C eps
    + H d

its inequality with `lambda > 0` and one more term for each pair,

    + sum over (w, z) in (w, z), (d, dz), (w + d, z + dz)   of He( w' Lambda (w - z) )

proves the same. The third pair is the observer's neuron against rest: one map, so it costs nothing
and counts (`w_i (z_i - w_i) >= 0` for any two points of a curve of slopes in [0, 1]).

When not to use it. As `measured_discs`; where slopes of neurons vary in time at will the third pair
does not hold.

Reference. docs/theory.md, "Measured discs"; Megretski & Rantzer 1997, Theorem 1; `E = 0, H = 0` is
`measured_discs`.

Example. `x+ = 0.2 x + 0.3 phi(x) + u`, `K = -0.25`, `L = -0.5`, `|e| <= kappa |u|`: at slope zero
small gain allows `8 * 0.7 * 0.95 / 1.2`.

>>> import numpy as np
>>> from ssm_study.synthesis.measured_discs_search import certify_largest_radius
>>> from ssm_study.certificates.theorem import VerificationContext
>>> from ssm_study.systems import JacobianBalls, JacobianBall, StructuredSystem
>>> one, unit = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> matrices = dict(a=0.2 * one, b=one, c=one, d=0 * one, e=0.3 * one, f=one, g=0 * one, h=0 * one)
>>> loop = StructuredSystem(**matrices)
>>> gains = {"k": -0.25 * one, "l": -0.5 * one, "l_z": 0 * one}
>>> balls = JacobianBalls(input=unit, output=unit)
>>> context = VerificationContext(system=loop, controlled=loop, balls=balls, gains=gains)
>>> proof = certify_largest_radius(context)
>>> print(f"{proof.tolerated_gain:.2f} <= {8 * 0.7 * 0.95 / 1.2:.2f}: {proof.certified}")
4.43 <= 4.43: True
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.theorem import Blocks, VerificationContext, multiplier_matrix
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs


@dataclass(frozen=True, kw_only=True)
class StructuredMeasuredDiscs(MeasuredDiscs):
    """Certificate that the loop of a model with neurons comes to rest on every plant with a model
    error within a disc measured from records. It has the fields of `measured_discs`, and `e (s, q),
    f (q, s), g (q, m)`, `h (p, q)`, `l_z (q, p)`, `lambda_ (3 q,)`."""

    e: Float[np.ndarray, "s q"]
    f: Float[np.ndarray, "q s"]
    g: Float[np.ndarray, "q m"]
    h: Float[np.ndarray, "p q"]
    l_z: Float[np.ndarray, "q p"]
    lambda_: Float[np.ndarray, "w"]

    @classmethod
    def conditions(cls, proof: Any) -> dict[str, Blocks]:
        """Matrices that must be positive definite for the loop of a model with neurons to come to
        rest on all plants within a disc."""
        matrices = super().conditions(proof)
        return matrices | {"lambda": [[multiplier_matrix(proof.lambda_)]]}

    @classmethod
    def free_signal_sizes(cls, proof: Any) -> dict[str, int]:
        """Number of channels of each free signal of a closed loop with neurons, in column order."""
        q = proof.g.shape[0]
        return super().free_signal_sizes(proof) | {"w": q, "d_w": q}

    @classmethod
    def neuron_contribution(cls, proof: Any, rows: Any, signal_name: str) -> Any:
        """Matrix by which the neurons' outputs contribute to the model's output."""
        return proof.h @ (rows.w if signal_name == "w" else rows.d_w)

    @classmethod
    def add_neurons_to_states(
        cls, proof: Any, rows: Any, next_state: Any, next_error: Any
    ) -> tuple[Any, Any]:
        """Add the contribution of the neurons to the next states of the model and of the
        estimation error."""
        n = proof.c.shape[1]
        next_state = next_state + proof.e @ rows.w
        next_error = next_error + proof.e[:n, :] @ rows.d_w
        return next_state, next_error

    @classmethod
    def neuron_difference_pairs(cls, proof: Any, rows: Any) -> list[tuple[Any, Any]]:
        """Pairs of an output difference and an input difference of the neurons: model against
        equilibrium, observer against model, and observer against equilibrium."""
        n = proof.c.shape[1]
        z = proof.f @ rows.x + proof.g @ rows.drive
        dz = proof.f[:, :n] @ rows.eps + proof.l_z @ rows.injected
        model_pair = (rows.w, z)
        error_pair = (rows.d_w, dz)
        observer_pair = (rows.w + rows.d_w, z + dz)
        return [model_pair, error_pair, observer_pair]

    @classmethod
    def static_map_constraints(cls, proof: Any, signals: Any) -> list[tuple[Any, Any]]:
        """Quadratic constraints on the inputs and outputs of static maps and neurons, each with
        its multiplier."""
        forms = super().static_map_constraints(proof, signals)
        q = proof.g.shape[0]
        for i, (output, argument) in enumerate(cls.neuron_difference_pairs(proof, signals)):
            start = i * q
            multipliers = proof.lambda_[:, start : start + q]
            weighted = multiplier_matrix(multipliers) @ (output - argument)
            neuron_form = output.T @ weighted + weighted.T @ output
            forms.append((1, neuron_form))
        return forms

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of the certificate that follow from the model with neurons and the design's
        gains."""
        matrices = super().model_data(context)
        closes_algebraic_loop = context.system.h.any() and self.l_z.any()
        if closes_algebraic_loop:  # proves nothing
            matrices["alpha_out"] = np.nan
        return matrices
