"""Response of a closed loop from the initial states of recorded decays (records without control),
compared with these decays.

A decay is a record at rest input that starts away from rest. Its output is what the plant does
without control; to it is added what the model answers to the loop's input from rest:

    y_k = decay_k + y_model(u)_k,     u = K xh,     xh+ = A xh + B S_u(u) + L (yh - y)

so the plant's own start counts, which the model may never visit. Exact for a linear plant whose
model is right. Source: docs/closed_loop.md, "Rates chosen for you"; docs/theory.md.
"""

import numpy as np
from jaxtyping import Float

from ssm_study.models.metrics import estimate_initial_state
from ssm_study.models.structured import Model
from ssm_study.signals import Ends, Trajectories
from ssm_study.synthesis.integrated_error import LARGEST, SAMPLES, SETTLED
from ssm_study.systems import Gains

Decays = Float[np.ndarray, "N T p"]
Ratios = Float[np.ndarray, "P"]

FITTED = 0.3  # share of a decay's energy that the model may miss: beyond, it says nothing of it

NO_DECAYS = np.zeros((0, 0, 1))
BANDS = (1.0, 2.0)  # bands of settling in which a response is judged


def simulate_decays(
    model: Model, recorded_trials: Trajectories, validation: Trajectories
) -> Decays:
    """Free responses of the model, noise-free and in scaled units, simulated from the initial
    states of the recorded decays (records without control).

    Decays at rest input count that start beyond the band of settling and that the model follows;
    none with measured disturbances, which push an output without a start.
    """
    if model.scale.disturbances:
        return NO_DECAYS
    decays = []
    for trial in recorded_trials:
        if trial.closed_loop or model.scale.scaled_input(trial.u).any():
            continue
        recorded_samples = len(trial)
        samples = min(SAMPLES[1], recorded_samples)
        y = trial.y[:samples]
        measured = model.scale.scaled_output(y)
        start = estimate_initial_state(model, trial, samples, excitation_record=validation[0])
        first_inputs = trial.u[:samples]
        response = model.simulate(first_inputs, start)
        simulated = model.scale.scaled_output(response)
        squared_errors = (measured - simulated) ** 2
        missed_energy = squared_errors.sum()
        energy = (measured**2).sum()
        start_size = np.linalg.norm(simulated[0])
        starts_away = start_size > SETTLED
        if starts_away and missed_energy < FITTED * energy:
            decays.append(simulated)
    if not decays:
        return NO_DECAYS
    decay_lengths = (len(decay) for decay in decays)
    shortest = min(decay_lengths)
    equal_decays = [decay[:shortest] for decay in decays]
    return np.stack(equal_decays)


def largest_settling_time_ratios(
    model: Model,
    gains: Gains,
    decays: Decays,
    settling_band: float,
    input_limits: Ends | None = None,
) -> Ratios:
    """Largest ratio, over two settling bands, of each closed loop's settling time to that of decays
    without control. Zero without decays, and with an internal model, which settles at its own
    pace."""
    if gains.modes.size:
        return np.zeros(len(gains.k))
    ratios = [
        settling_time_ratios(model, gains, decays, size * settling_band, input_limits)
        for size in BANDS
    ]
    return np.asarray(np.max(ratios, axis=0))


def settling_time_ratios(
    model: Model, gains: Gains, decays: Decays, settling_band: float, limits: Ends | None = None
) -> Ratios:
    """Ratio of each closed loop's settling time to that of decays without control, averaged over
    the decays. Zero without decays."""
    pairs = len(gains.k)
    if not len(decays):
        return np.zeros(pairs)
    sizes = np.linalg.norm(decays, axis=2)
    alone = _settling_sample(sizes, settling_band)
    input_limits = limits or (-LARGEST, LARGEST)
    outputs = _closed_loop_outputs(model, gains, decays, input_limits)
    output_sizes = np.linalg.norm(outputs, axis=3)
    settled_samples = _settling_sample(output_sizes, settling_band)
    mean_settled = settled_samples.mean(axis=1)
    mean_sample = alone.mean()
    mean_alone = max(float(mean_sample), 1.0)
    return np.asarray(mean_settled / mean_alone)


def _settling_sample(
    signal_sizes: Float[np.ndarray, "*pairs T"], band: float
) -> Float[np.ndarray, "*pairs"]:
    """First sample after which a signal stays within a band."""
    outside = signal_sizes > band
    sample_count = signal_sizes.shape[-1]
    samples = np.arange(1, sample_count + 1)
    last_outside = (outside * samples).max(axis=-1)
    return np.asarray(last_outside.astype(float))


def _closed_loop_outputs(
    model: Model, gains: Gains, decays: Decays, limits: Ends | tuple[float, float]
) -> Float[np.ndarray, "P N T p"]:
    """Simulate the outputs of the closed loop with each pair of controller and observer, from
    the initial state of each record without control."""
    transposed_gains = gains.k.transpose(0, 2, 1)
    k = transposed_gains[:, : model.order]
    l_ = gains.l.transpose(0, 2, 1)
    l_z = None if gains.l_z is None else gains.l_z.transpose(0, 2, 1)
    count, horizon, _ = decays.shape
    pairs = len(k)
    state_shape = (pairs, count, model.order)
    x = np.zeros(state_shape)
    x_hat = np.zeros_like(x)
    output_shape = (pairs, *decays.shape)
    outputs = np.zeros(output_shape)
    for sample in range(horizon):
        requested = x_hat @ k
        u = np.clip(requested, *limits)
        mapped_input = model.scaffold_in(u)
        scaled = model.scaled_output_at(x, mapped_input)
        y = scaled + decays[:, sample]
        outputs[:, :, sample] = y
        innovation = model.scaled_output_at(x_hat, mapped_input) - y
        into_neurons = () if l_z is None else (innovation @ l_z,)
        x = model.next_state(x, mapped_input)
        predicted = model.next_state(x_hat, mapped_input, *into_neurons)
        estimate = predicted + innovation @ l_
        x_hat = np.clip(estimate, -LARGEST, LARGEST)
        x = np.clip(x, -LARGEST, LARGEST)
    return outputs
