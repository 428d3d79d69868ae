"""Oracle: the largest relative radius of the ball at which Theorem 1 is feasible, as a function of
r."""

import numpy as np

from ssm_study.certificates.frontier import largest_control_energy, largest_uncontrollable_modulus


def ratio_limit(a: np.ndarray, b: np.ndarray, contraction: float) -> float:
    """The supremum of `beta/|alpha|` at which Theorem 1 is feasible with `r = contraction`; 0 if no
    ball at all is.

    For one input `prod r/|lambda_i|` over `|lambda_i| > r`; for several `1 / sqrt(1 +
    lambda_max(Bh^T S Bh))`.
    """
    if largest_uncontrollable_modulus(a, b) >= contraction:
        return 0.0
    if b.shape[1] == 1:
        eigenvalues = np.linalg.eigvals(a)
        moduli = np.abs(eigenvalues)
        shares = contraction / np.maximum(moduli, contraction)
        return float(np.prod(shares))
    energy = largest_control_energy(a, b, contraction)
    return float(1 / np.sqrt(1 + energy))
