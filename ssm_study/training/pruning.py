"""Removal of neurons that do nothing from a trained structured model."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import StructuredSSM, evaluate_activations
from ssm_study.signals import Trajectories

IDLE = 1e-3  # relative change of the output below which a neuron does nothing


def prune_neurons(model: StructuredSSM, records: Trajectories) -> StructuredSSM:
    """Remove neurons that a linear gain can replace without a noticeable change of any output. `w_i
    = s_i z_i`.

    A metric in which the model contracts is one of the pruned model too: `w_i = s_i z_i` satisfies
    the sector condition that the analysis LMI is about. A neuron between input and output is left
    where D is zero.
    """
    for i in reversed(range(len(model.neurons))):
        reaches_output = model.h[:, i] != 0
        if np.any(reaches_output) and np.any(model.g[i] != 0):
            continue
        candidate = linearise_neuron(model, i, records)
        output = simulate_records_stacked(model, records)
        simulated = simulate_records_stacked(candidate, records)
        change = np.linalg.norm(simulated - output)
        deviation = np.linalg.norm(output - output.mean(axis=0))
        if change / deviation < IDLE:
            model = candidate
    return model


def simulate_records_stacked(
    model: StructuredSSM, records: Trajectories
) -> Float[np.ndarray, "T p"]:
    """Simulated outputs of several records from the equilibrium, stacked in one array."""
    outputs = [model.simulate(record.u, d=record.d) for record in records]
    return np.concatenate(outputs)


def linearise_neuron(model: StructuredSSM, i: int, records: Trajectories) -> StructuredSSM:
    """Copy of a model in which one neuron is replaced by its mean slope over the records."""
    slopes = []
    for record in records:
        driving = model.driving_signals(record.u, record.d)
        _, states = model.simulate_recurrence(driving)
        v = model.map_input(record.u)
        from_state = states[:-1] @ model.f.T
        from_input = v @ model.g.T
        z = from_state + from_input + model.bias
        by_neuron = evaluate_activations(model.neurons, z, "slope")
        slopes.append(by_neuron[:, i])
    all_slopes = np.concatenate(slopes)
    slope = float(all_slopes.mean())
    e = model.e[:, [i]]
    f = model.f[[i]]
    g = model.g[[i]]
    h = model.h[:, [i]]
    through_neuron = slope * e @ f
    parts = {"a": model.a + through_neuron}
    input_change = slope * e @ g
    parts["b"] = model.b + input_change
    output_change = slope * h @ f
    parts["c"] = model.c + output_change
    feedthrough_change = slope * h @ g
    parts["d"] = model.d + feedthrough_change
    parts["e"] = np.delete(model.e, i, 1)
    parts["f"] = np.delete(model.f, i, 0)
    parts["g"] = np.delete(model.g, i, 0)
    parts["h"] = np.delete(model.h, i, 1)
    parts["bias"] = np.delete(model.bias, i, 0)
    earlier_neurons = model.neurons[:i]
    later_neurons = model.neurons[i + 1 :]
    others = earlier_neurons + later_neurons
    return replace(model, neurons=others, **parts)
