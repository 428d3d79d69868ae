"""The largest gain over all frequencies, to a stated tolerance, without a frequency grid deciding it."""

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from ssm_study.systems import StateSpace

PEAK_TOLERANCE = 1e-8
"""Relative: the returned gain is attained, and no frequency exceeds it by more than this."""
ON_AXIS = 1e-4
"""Relative: how near the imaginary axis an eigenvalue counts as a crossing. Rounding moves them by up to 1e-6 (seen);
a false crossing costs one more frequency to look at, a missed one the peak."""


def frequency_response(system: StateSpace, angles: Float[np.ndarray, "F"]) -> Complex[np.ndarray, "F p m"]:
    """`C (e^{j angle} I - A)^{-1} B + D`, angles in radians per sample."""
    shifted = np.exp(1j * angles)[:, None, None] * np.eye(system.order) - system.a
    return system.c @ np.linalg.solve(shifted, np.broadcast_to(system.b, (len(angles), *system.b.shape))) + system.d


def gains(system: StateSpace, angles: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """The largest singular value of the frequency response at each angle."""
    return np.linalg.norm(frequency_response(system, angles), ord=2, axis=(1, 2))


def hinf_norm(system: StateSpace) -> float:
    """`sup_w sigma_max(C (e^{jw} I - A)^{-1} B + D)`; infinite if `A` is not stable.

    A bilinear map carries the unit circle to the imaginary axis and leaves the norm; there, `gamma` exceeds the norm
    iff the Hamiltonian of `gamma` has no imaginary eigenvalue, and between neighbouring ones lie the peaks to look at
    next: quadratic convergence. Source: Bruinsma & Steinbuch, Systems & Control Letters 14 (1990) 287-293.
    """
    if system.spectral_radius >= 1:
        return float("inf")
    poles = np.linalg.eigvals(system.a)
    angles = np.concatenate([[0.0, np.pi], np.abs(np.angle(poles)), np.geomspace(1e-4, np.pi, 32)])
    best = float(gains(system, angles).max())
    continuous = _bilinear(system)
    for _ in range(40):
        if best == 0.0:
            return 0.0
        crossings = _crossings(continuous, best * (1 + PEAK_TOLERANCE))
        if not len(crossings):
            break
        between = np.concatenate([crossings, (crossings[1:] + crossings[:-1]) / 2])
        found = float(gains(system, 2 * np.arctan(between)).max())
        if found <= best * (1 + PEAK_TOLERANCE):
            break
        best = found
    return best * (1 + PEAK_TOLERANCE)


def _bilinear(system: StateSpace) -> StateSpace:
    """The continuous-time system with the same norm: `z = (1 + s) / (1 - s)`, so `w = tan(angle / 2)`."""
    n = system.order
    shifted = np.linalg.inv(np.eye(n) + system.a)
    return StateSpace(
        a=shifted @ (system.a - np.eye(n)),
        b=np.sqrt(2) * shifted @ system.b,
        c=np.sqrt(2) * system.c @ shifted,
        d=system.d - system.c @ shifted @ system.b,
    )


def _crossings(system: StateSpace, gamma: float) -> Float[np.ndarray, "w"]:
    """Frequencies at which some singular value equals `gamma`, ascending, both signs."""
    a, b, c, d = system.a, system.b, system.c, system.d
    r = gamma**2 * np.eye(d.shape[1]) - d.T @ d
    s = gamma**2 * np.eye(len(d)) - d @ d.T
    f = a + b @ np.linalg.solve(r, d.T @ c)
    top = np.hstack([f, gamma * b @ np.linalg.solve(r, b.T)])
    bottom = np.hstack([-gamma * c.T @ np.linalg.solve(s, c), -f.T])
    eigenvalues = scipy.linalg.eigvals(np.vstack([top, bottom]))
    near = np.abs(eigenvalues.real) <= ON_AXIS * np.maximum(np.abs(eigenvalues), 1.0)
    return np.sort(eigenvalues[near].imag)
