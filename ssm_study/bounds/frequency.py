"""Frequency responses of linear systems, and the largest gain over all frequencies (the H-infinity
norm)."""

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.systems import StateSpace

Angles = Float[np.ndarray, "F"]

PEAK_TOLERANCE = (
    1e-8  # relative: the returned gain is attained, and no frequency exceeds it by more than this
)
# Relative: how near the imaginary axis an eigenvalue counts as a crossing. Rounding moves them by
# up to 1e-6 (seen); a false crossing costs one more frequency to look at, a missed one the peak.
ON_AXIS = 1e-4


def frequency_response(system: StateSpace, angles: Angles) -> Complex[np.ndarray, "F p m"]:
    """Frequency response matrix of a discrete-time linear system at given angles. `C (e^{j angle} I
    - A)^{-1} B + D`, angles in radians per sample."""
    points = np.exp(1j * angles)[:, None, None]
    shifted = points * np.eye(system.order) - system.a
    b_at_each_angle = np.broadcast_to(system.b, (len(angles), *system.b.shape))
    state_response = np.linalg.solve(shifted, b_at_each_angle)
    return system.c @ state_response + system.d


def largest_gains(system: StateSpace, angles: Angles) -> Angles:
    """Largest singular value of a linear system's frequency response at each given angle."""
    response = frequency_response(system, angles)
    return np.linalg.norm(response, ord=2, axis=(1, 2))


def hinf_norm(system: StateSpace) -> float:
    """H-infinity norm of a discrete-time linear system; infinite for an unstable system. `sup_w
    sigma_max(C (e^{jw} I - A)^{-1} B + D)`; infinite also where floats cannot decide stability.

    A bilinear map carries the unit circle to the imaginary axis and leaves the norm; there, `gamma`
    exceeds the norm iff the Hamiltonian of `gamma` has no imaginary eigenvalue, and between
    neighbouring ones lie the peaks to look at next: quadratic convergence. Source: Bruinsma &
    Steinbuch, Systems & Control Letters 14 (1990) 287-293.
    """
    try:
        is_stable = system.spectral_radius < 1
        return _peak_gain(system) if is_stable else float("inf")
    except np.linalg.LinAlgError:
        # an eigenvalue on the circle, to rounding: nothing may be claimed
        return float("inf")


def _peak_gain(system: StateSpace) -> float:
    """H-infinity norm of a stable system, by raising a gain level until the frequency response
    nowhere exceeds it."""
    poles = np.linalg.eigvals(system.a)
    pole_angles = np.abs(np.angle(poles))
    grid = np.geomspace(1e-4, np.pi, 32)
    angles = np.concatenate([[0.0, np.pi], pole_angles, grid])
    best = float(largest_gains(system, angles).max())
    continuous = _continuous_equivalent(system)
    for _ in range(40):  # a bound only: convergence is quadratic
        if best**2 < np.finfo(float).tiny:  # the squares below underflow
            return best
        level = best * (1 + PEAK_TOLERANCE)
        crossings = _crossing_frequencies(continuous, level)
        if not len(crossings):
            break
        # a peak lies between two crossings
        midpoints = (crossings[1:] + crossings[:-1]) / 2
        candidates = np.concatenate([crossings, midpoints])
        candidate_angles = 2 * np.arctan(candidates)
        largest_gain = float(largest_gains(system, candidate_angles).max())
        if largest_gain <= level:
            break
        best = largest_gain
    return best * (1 + PEAK_TOLERANCE)


def _continuous_equivalent(system: StateSpace) -> StateSpace:
    """Continuous-time system with the same H-infinity norm as a given discrete-time one, by the
    bilinear transform."""
    identity = np.eye(system.order)
    root2 = np.sqrt(2)
    shifted = np.linalg.inv(identity + system.a)  # exists: no eigenvalue at -1, A is stable
    a = shifted @ (system.a - identity)
    b = root2 * shifted @ system.b
    c = root2 * system.c @ shifted
    d = system.d - system.c @ shifted @ system.b
    return StateSpace(a=a, b=b, c=c, d=d)


def _crossing_frequencies(system: StateSpace, gain: float) -> Float[np.ndarray, "w"]:
    """Frequencies at which a singular value of a system's frequency response equals a given
    gain."""
    a = system.a
    b = system.b
    c = system.c
    d = system.d
    outputs, inputs = d.shape
    r = gain**2 * np.eye(inputs) - d.T @ d
    s = gain**2 * np.eye(outputs) - d @ d.T
    # blocks of gamma's Hamiltonian matrix
    state_block = a + b @ np.linalg.solve(r, d.T @ c)
    input_block = gain * b @ np.linalg.solve(r, b.T)
    output_block = -gain * c.T @ np.linalg.solve(s, c)
    top = np.hstack([state_block, input_block])
    bottom = np.hstack([output_block, -state_block.T])
    hamiltonian = np.vstack([top, bottom])
    eigenvalues = scipy.linalg.eigvals(hamiltonian)
    size = np.maximum(np.abs(eigenvalues), 1.0)
    is_on_axis = np.abs(eigenvalues.real) <= ON_AXIS * size
    return np.sort(eigenvalues[is_on_axis].imag)
