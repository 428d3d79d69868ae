"""Frequency responses of linear systems, and the largest gain over all frequencies (the H-infinity
norm)."""

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.systems import StateSpace

PEAK_TOLERANCE = (
    1e-8  # relative: the returned gain is attained, and no frequency exceeds it by more than this
)
# Relative: how near the imaginary axis an eigenvalue counts as a crossing. Rounding moves them by
# up to 1e-6 (seen); a false crossing costs one more frequency to look at, a missed one the peak.
ON_AXIS = 1e-4


def frequency_response(
    system: StateSpace, angles: Float[np.ndarray, "F"]
) -> Complex[np.ndarray, "F p m"]:
    """Frequency response matrix of a discrete-time system at the given angles. `C (e^{j angle} I
    - A)^{-1} B + D`, angles in radians per sample."""
    shifted = np.exp(1j * angles)[:, None, None] * np.eye(system.order) - system.a
    return (
        system.c
        @ np.linalg.solve(shifted, np.broadcast_to(system.b, (len(angles), *system.b.shape)))
        + system.d
    )


def largest_gains(system: StateSpace, angles: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """Largest singular value of the frequency response at each angle."""
    return np.linalg.norm(frequency_response(system, angles), ord=2, axis=(1, 2))


def hinf_norm(system: StateSpace) -> float:
    """H-infinity norm of a discrete-time system, infinite for an unstable one. `sup_w sigma_max(C
    (e^{jw} I - A)^{-1} B + D)`; infinite also where floats cannot decide stability.

    A bilinear map carries the unit circle to the imaginary axis and leaves the norm; there, `gamma`
    exceeds the norm iff the Hamiltonian of `gamma` has no imaginary eigenvalue, and between
    neighbouring ones lie the peaks to look at next: quadratic convergence. Source: Bruinsma &
    Steinbuch, Systems & Control Letters 14 (1990) 287-293.
    """
    try:
        return _peak_gain(system) if system.spectral_radius < 1 else float("inf")
    except (
        np.linalg.LinAlgError
    ):  # an eigenvalue on the circle, to rounding: nothing may be claimed
        return float("inf")


def _peak_gain(system: StateSpace) -> float:
    """Largest gain of a stable system over all frequencies (H-infinity norm), by raising a level
    until no frequency response crosses it."""
    poles = np.linalg.eigvals(system.a)
    angles = np.concatenate([[0.0, np.pi], np.abs(np.angle(poles)), np.geomspace(1e-4, np.pi, 32)])
    best = float(largest_gains(system, angles).max())
    continuous = _continuous_equivalent(system)
    for _ in range(40):  # a bound only: convergence is quadratic
        if best**2 < np.finfo(float).tiny:  # the squares below underflow
            return best
        crossings = _crossing_frequencies(continuous, best * (1 + PEAK_TOLERANCE))
        if not len(crossings):
            break
        between = np.concatenate(
            [crossings, (crossings[1:] + crossings[:-1]) / 2]
        )  # a peak lies between two crossings
        largest_gain = float(largest_gains(system, 2 * np.arctan(between)).max())
        if largest_gain <= best * (1 + PEAK_TOLERANCE):
            break
        best = largest_gain
    return best * (1 + PEAK_TOLERANCE)


def _continuous_equivalent(system: StateSpace) -> StateSpace:
    """Continuous-time system with the same H-infinity norm as a discrete-time one, by the bilinear
    transform."""
    identity = np.eye(system.order)
    root2 = np.sqrt(2)
    shifted = np.linalg.inv(identity + system.a)  # exists: no eigenvalue at -1, A is stable
    a = shifted @ (system.a - identity)
    d = system.d - system.c @ shifted @ system.b
    return StateSpace(a=a, b=root2 * shifted @ system.b, c=root2 * system.c @ shifted, d=d)


def _crossing_frequencies(system: StateSpace, gamma: float) -> Float[np.ndarray, "w"]:
    """Frequencies of both signs, in ascending order, at which a singular value of the response
    equals a given gain."""
    a = system.a
    b = system.b
    c = system.c
    d = system.d
    r = gamma**2 * np.eye(d.shape[1]) - d.T @ d
    s = gamma**2 * np.eye(len(d)) - d @ d.T
    f = a + b @ np.linalg.solve(r, d.T @ c)  # the first block of gamma's Hamiltonian matrix
    top = np.hstack([f, gamma * b @ np.linalg.solve(r, b.T)])
    bottom = np.hstack([-gamma * c.T @ np.linalg.solve(s, c), -f.T])
    eigenvalues = scipy.linalg.eigvals(np.vstack([top, bottom]))
    near = np.abs(eigenvalues.real) <= ON_AXIS * np.maximum(np.abs(eigenvalues), 1.0)
    return np.sort(eigenvalues[near].imag)
