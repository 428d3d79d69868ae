"""Numbers of an identified model that the recorded data of its run cannot verify."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.study.run_files import RunFiles

CANCELLED = "the neuron bends at no value of a record, so that its bias cancels with that at zero"
UNREACHED = "no record reaches this part of the map, and training is not repeated"


def unverifiable_numbers(run: RunFiles) -> dict[str, str]:
    """Find entries of the file `model.json` that the run's records cannot verify, each with the
    reason.

    A monotone map is written by break points and slopes. Beyond the inputs (or outputs) of all
    records they change no signal; what is proved holds for every break point, and the smallest and
    the largest slope are checked as bounds.
    """
    scale = run.model.scale
    simulated = (run.model_run.validation, run.model_run.test)
    inputs = [*run.recorded_training_inputs, *(record.u for record in run.mismatch_records)]
    outputs: list[np.ndarray] = []
    for part in simulated:
        inputs += [record.u for record in part.records]
        outputs += part.simulated
    places: list[str] = []
    scaffold_in = getattr(run.model, "scaffold_in", None)
    if isinstance(scaffold_in, MonotoneScaffold):
        signal = scale.scaled_input(np.concatenate(inputs))
        places += unreached_range_texts("scaffold_in", scaffold_in.breakpoints, signal)
    scaffold_out = getattr(run.model, "scaffold_out", None)
    if isinstance(scaffold_out, MonotoneScaffold):
        signal = scale.scaled_output(np.concatenate(outputs))
        bends = scaffold_out(scaffold_out.breakpoints.T).T
        places += unreached_range_texts("scaffold_out", bends, signal)
    reasons = dict.fromkeys(places, UNREACHED)
    if isinstance(scaffold_in, MlpScaffold):
        signal = scale.scaled_input(np.concatenate(inputs))
        reasons |= cancelled_biases("scaffold_in", scaffold_in.network, signal)
    if isinstance(scaffold_out, MlpScaffold):
        reasons |= cancelled_biases("scaffold_out", scaffold_out.network, None)
    return reasons


def cancelled_biases(
    name: str, network: Network, signal: Float[np.ndarray, "T m"] | None
) -> dict[str, str]:
    """Find biases of a neural network that have no effect on a recorded signal, each with the
    reason.

    They are those of neurons with one slope on both sides and, where the signal is known, of
    neurons that bend at no value between zero and those of the signal.
    """
    places = {}
    values = None if signal is None else np.vstack([np.zeros((1, signal.shape[1])), signal])
    for layer, bias in enumerate(network.biases):
        negative = network.negative_slopes[layer]
        positive = network.positive_slopes[layer]
        flags = negative == positive
        if values is not None:
            moved = values @ network.weights[layer].T + bias
            flags = flags | (moved > 0).all(axis=0) | (moved < 0).all(axis=0)
            values = leaky_rectifier(moved, negative, positive) - leaky_rectifier(
                bias, negative, positive
            )
        numbers = ", ".join(map(str, np.flatnonzero(flags)))
        if numbers:
            places[f"model.json {name}.biases.{layer}: {numbers}"] = CANCELLED
    return places


def leaky_rectifier(
    z: Float[np.ndarray, "*batch h"],
    negative: Float[np.ndarray, "h"],
    positive: Float[np.ndarray, "h"],
) -> Float[np.ndarray, "*batch h"]:
    """Leaky rectifier (leaky ReLU) of a neural network, with two slopes for each neuron."""
    return np.where(z < 0, negative * z, positive * z)


def unreached_range_texts(
    name: str, breakpoint_rows: Float[np.ndarray, "m h"], signal: Float[np.ndarray, "T m"]
) -> Iterator[str]:
    """Describe which numbers of a piecewise-linear map no recorded signal reaches: breakpoints
    outside the signal's range, and slopes of segments outside it.

    One text for each row of numbers: `model.json scaffold_in.slopes.0: 0, 1, 16`.
    """
    for channel, points in enumerate(breakpoint_rows):
        lowest = float(signal[:, channel].min(initial=0.0))  # the map is summed up from zero
        highest = float(signal[:, channel].max(initial=0.0))
        ends = [-np.inf, *points, np.inf]
        pieces = list(pairwise(ends))
        breakpoints = [not lowest <= point <= highest for point in points]
        slopes = [end <= lowest or begin >= highest for begin, end in pieces]
        unreached = {"breakpoints": breakpoints, "slopes": slopes}
        for field, flags in unreached.items():
            numbers = ", ".join(map(str, np.flatnonzero(flags)))
            if numbers:
                yield f"model.json {name}.{field}.{channel}: {numbers}"
