"""Text on whether the closed loop with estimated state, `u = K xh`, is certified, and under which
assumptions.

It follows from both certificates if the observer computes the plant's own maps S_u and S_y: then
its error shrinks by itself and the model comes to rest. Where only a range of slopes is given, the
observer computes another map than the plant has, and neither certificate covers that loop.
"""

from collections.abc import Mapping
from itertools import product

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.certificates.certificate import Observer, StateFeedback

HOLDS = "comes to rest, certified (no rate of its own)"
Pair = tuple[float, float]


def describe_loop_verdict(
    verdicts: Mapping[str, bool], unknown_maps: Mapping[str, str], example: str | None = None
) -> str:
    """Text of the verdict on the closed loop of controller and observer, with the reason where it
    is not certified. `example` is a loop within the slopes that is not stable."""
    if verdicts["loop"]:
        return HOLDS
    failed = [name for name in ("controller", "observer") if not verdicts[name]]
    if failed:
        return f"not certified: the {' and the '.join(failed)} is not"
    maps = maps_text(unknown_maps)
    words = f"not certified: this proof needs an observer that computes the plant's own {maps}"
    return words if example is None else f"{words}; {example}"


def add_loop_verdict(
    gain_verdicts: Mapping[str, bool], unknown_maps: Mapping[str, str]
) -> dict[str, bool]:
    """Verdicts on a controller, an observer and their closed loop; the third follows from the first
    two. It is certified where both are and the observer computes the plant's own maps."""
    holds_for_gains = all(gain_verdicts.values())
    is_certified = holds_for_gains and not unknown_maps
    return {**gain_verdicts, "loop": is_certified}


def maps_text(unknown_maps: Mapping[str, str]) -> str:
    """Text that lists the static maps which an observer would have to compute, each with its range
    of slopes."""
    return " and ".join(unknown_maps.values())


def unstable_example_text(certificates: Certificates) -> str | None:
    """Text on a plant within the certified slopes whose closed loop is unstable; None if none is
    found."""
    feedback = certificates.state_feedback
    observer = certificates.observer
    if not isinstance(feedback, StateFeedback) or not isinstance(observer, Observer):
        return None
    if feedback.a.shape != observer.a.shape:  # an internal model stands beside the states
        return None
    ends = [(part.alpha - part.beta, part.alpha + part.beta) for part in (feedback, observer)]
    driven = feedback.b @ feedback.k
    corrected = observer.l @ observer.c
    return unstable_loop_text(feedback.a, driven, corrected, *ends)


def unstable_loop_text(
    a: Float[np.ndarray, "n n"],
    input_feedback: Float[np.ndarray, "n n"],
    output_correction: Float[np.ndarray, "n n"],
    slopes: Pair,
    output_slopes: Pair,
) -> str | None:
    """Warning that a closed loop is unstable for some extreme slopes of the plant's static maps.

    The observer computes with the mean slopes. The text names the worst loop; None if the loop
    is stable for all extreme slopes.

    `input_feedback` is B K, `output_correction` is L C.
    """
    mean_input_slope = sum(slopes) / 2
    mean_output_slope = sum(output_slopes) / 2
    mean = (mean_input_slope, mean_output_slope)
    radii = {}
    for inner, outer in product(slopes, output_slopes):
        plant_rows = [a, inner * input_feedback]
        plant = np.hstack(plant_rows)
        error_motion = a + mean[0] * input_feedback
        own = error_motion + mean[1] * output_correction
        correction = -outer * output_correction
        observer_rows = [correction, own]
        observer = np.hstack(observer_rows)
        loop_of_both = np.vstack([plant, observer])
        poles = np.linalg.eigvals(loop_of_both)
        moduli = np.abs(poles)
        radii[inner, outer] = float(moduli.max())
    worst = max(radii, key=lambda ends: radii[ends])
    if radii[worst] < 1:
        return None
    gains = []
    for name, end, middle, ends in (
        ("input", worst[0], mean[0], slopes),
        ("output", worst[1], mean[1], output_slopes),
    ):
        if ends[0] < ends[1]:
            gains.append(f"{name} gain {end:.4g} of the plant, {middle:.4g} of the observer")
    return f"not stable with {' and '.join(gains)} (spectral radius {radii[worst]:.4g})"
