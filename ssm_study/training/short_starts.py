"""Short training runs from many initial parameters, of which the best are trained to their end.

A training ends in one of many local minima. How low is mostly seen after a few steps.
"""

from collections.abc import Callable
from dataclasses import replace
from math import ceil

import numpy as np

from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, fit_from_relative_error
from ssm_study.training.structured_fit import StructuredFit
from ssm_study.training.structured_problem import Theta

STEPS = 20  # of a short training, inside the contracting set
DRAWS = 3  # of several random neurons for such a training


def settings_for_short_training(spec: StructuredSpec) -> StructuredSpec:
    """Model settings for short training runs, with fewer random draws of initial neurons.

    A single neuron is drawn as often as ever: its draws are cheap, and more of them end badly.
    """
    has_one_neuron = spec.neurons == 1
    return spec if has_one_neuron else replace(spec, draws=min(DRAWS, spec.draws))


def count_short_and_full_runs(spec: StructuredSpec) -> tuple[int, int]:
    """Number of short training runs, and number of those that are continued to the end.

    A model that need not contract has twice as many: fewer of its trainings end where a state
    feedback can be certified, and each takes less time.
    """
    more = 2 if spec.rate is None else 1
    half_of_starts = more * spec.starts / 2
    rounded_half = ceil(half_of_starts)
    ended = max(rounded_half, spec.members)
    short_runs = more * 2 * spec.starts
    all_runs = max(short_runs, ended)
    return all_runs, ended


def best_starts(
    spec: StructuredSpec,
    data: DataSet,
    first: int,
    count: int,
    kept_count: int,
    print_line: Callable[[str], object] = str,
) -> dict[int, Theta]:
    """Initial parameters, by random seed, of the training runs with the smallest loss after a few
    steps, the best first. If every run diverges: the first seed, without parameters.

    Starts whose model has no certified state feedback and observer come behind all that have, where
    the specification asks for them. Each start is announced when it is done.
    """
    part = data.shift_out_dead_time(int(spec.dead_time)) if spec.dead_time else data
    fits: dict[int, StructuredFit] = {}
    for done in range(1, count + 1):
        seed = first + 1000 * (done - 1)
        fits[seed] = StructuredFit(spec, part, seed)
        fits[seed].start_training(STEPS)
        print_line(f"{done} of {count}, {training_fit_as_text(float(fits[seed].loss))}")
    finite = [seed for seed, fit in fits.items() if np.isfinite(float(fit.loss))]
    by_loss = sorted(finite, key=lambda seed: float(fits[seed].loss))
    finite_fits = {seed: fits[seed] for seed in by_loss}
    certified = first_certifiable_seeds(spec, finite_fits, kept_count)
    others = [seed for seed in by_loss if seed not in certified]
    ordered_seeds = [*certified, *others]
    kept = ordered_seeds[:kept_count]
    return {seed: fits[seed].initial_parameters for seed in kept} or {first: {}}


def first_certifiable_seeds(
    spec: StructuredSpec, fits: dict[int, StructuredFit], max_count: int
) -> list[int]:
    """Random seeds of the first training runs for whose models a state feedback and an observer can
    be certified. All count if the settings do not ask for certificates."""
    has_certificates = getattr(spec.among_starts, "has_certificates", None)
    certified: list[int] = []
    for seed, fit in fits.items():
        if len(certified) == max_count:
            break
        if has_certificates is None or has_certificates(fit.as_model()):
            certified.append(seed)
    return certified


def training_fit_as_text(loss: float) -> str:
    """Text that states the fit to the training records in percent for a given loss."""
    if not np.isfinite(loss):
        return "the simulation diverges"
    return f"fit to the training records {fit_from_relative_error(np.sqrt(loss)):.1f} %"
