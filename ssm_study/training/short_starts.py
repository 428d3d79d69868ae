"""Short training runs from many initial parameters, of which the best are trained to their end.

A training ends in one of many local minima. How low is mostly seen after a few steps.
"""

from dataclasses import replace

import numpy as np

from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.structured_fit import StructuredFit

STEPS = 20  # of a short training, inside the contracting set
DRAWS = 3  # of several random neurons for such a training


def short_spec(spec: StructuredSpec) -> StructuredSpec:
    """Model settings with short training starts, each of which tries only few random draws of
    neurons.

    A single neuron is drawn as often as ever: its draws are cheap, and more of them end badly.
    """
    return spec if spec.neurons == 1 else replace(spec, draws=min(DRAWS, spec.draws))


def best_seeds(spec: StructuredSpec, data: DataSet, first: int, count: int, best: int) -> list[int]:
    """Seeds of the initial parameters with the smallest loss after a few steps, the best first.

    Starts whose model has no certified state feedback come behind all that have one, where the
    specification asks for one.
    """
    part = data.shift_out_dead_time(int(spec.dead_time)) if spec.dead_time else data
    fits = {
        seed: StructuredFit(spec, part, seed) for seed in range(first, first + 1000 * count, 1000)
    }
    for fit in fits.values():
        fit.take_steps(STEPS)
    finite = [seed for seed, fit in fits.items() if np.isfinite(float(fit.loss))]
    by_loss = sorted(finite, key=lambda seed: float(fits[seed].loss))
    largest_rate = getattr(spec.among_starts, "largest_rate", None)
    certified: list[int] = []
    for seed in by_loss:
        if len(certified) == best:
            break
        if largest_rate is None or largest_rate(fits[seed].as_model()) > 0.0:
            certified.append(seed)
    others = [seed for seed in by_loss if seed not in certified]
    return [*certified, *others][:best] or [first]
