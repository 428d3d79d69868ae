"""Offset and oscillation of an output that remain after the input has become constant.

Returns on which the model was trained count too, since no prediction of the model is used here. At
the equilibrium's input an output should rest at the equilibrium; at another, each return is
compared with the mean of the others: a single return shows the motion only. Source: docs/trust.md,
"Neither proved nor measured: the prediction".
"""

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.signals import Scale, Trajectory

AT_REST = 0.02  # share of the output's scale within which a plant at rest input has come to rest
FAINT = AT_REST / 4  # what is left beyond it is a doubt, and from `AT_REST` on nothing is predicted
# a record, or a rest after motion, should last this many times the bulk of the model's response
RESPONSES = 2
# standard errors by which a record must exceed its noise: of more than a hundred bands the largest
# counts
SURE = 3.0
NEIGHBOURS = 15  # lines among which a swing is one; noise does not change much over them
FEWEST = 8  # samples of a rest
FAR = 10 * AT_REST  # from where a return shows a decay
SAME_INPUT = 6  # digits of the scaled input in which two rests agree

InputSignal = Float[np.ndarray, "T m"]
OutputSignal = Float[np.ndarray, "T p"]
FinalOutput = Float[np.ndarray, "K p"]
Variance = Float[np.ndarray, "p"]


def is_return_to_rest(record: Trajectory) -> bool:
    """Whether the input of a record changes only once, at the beginning, and is constant from then
    on. The same holds for measured disturbances (`data.splits.rest_segments`)."""
    if len(record) <= FEWEST:
        return False
    moving = record.inputs_and_disturbances
    first_step = moving[0] != moving[1]
    range_afterwards = np.ptp(moving[1:], axis=0)
    moves_once = bool(first_step.any())
    is_constant_afterwards = not range_afterwards.any()
    return moves_once and is_constant_afterwards


def oscillations_and_offsets_after_returns(
    scale: Scale, records: list[Trajectory], response_length: int
) -> tuple[list[float], list[float]]:
    """Oscillations and offsets that the outputs of several records still have after the input has
    returned to a constant value.

    Returns count that last longer than the model's response. If there are none, all count, provided
    that each came to rest from `FAR` away: the model may have a slow mode that the plant lacks. A
    single return that came to rest at another input than the equilibrium's says nothing.
    """
    motions = list[float]()
    offsets = list[float]()
    shortest = max(RESPONSES * response_length, FEWEST)
    for level, outputs in _group_outputs_by_final_input(scale, records).items():
        is_equilibrium = not np.frombuffer(level).any()
        long_outputs = [y for y in outputs if len(y) >= shortest]
        counted = long_outputs or outputs
        swings = [oscillation_amplitude(y) for y in counted]
        distances = _distances_from_rest(counted, is_centred=is_equilibrium)
        came_to_rest = bool(long_outputs)
        if not came_to_rest:
            is_still = max((*swings, *distances)) < AT_REST
            came_to_rest = is_still and _starts_far_from_rest(outputs)
        if came_to_rest:
            motions += [size for size in swings if size >= AT_REST or distances]
            offsets += [offset for offset in distances if offset > AT_REST]
    return motions, offsets


def largest_equilibrium_difference(scale: Scale, records: list[Trajectory]) -> float:
    """Largest difference between the final outputs of records that end at the same constant input;
    zero if an output still moves."""
    offsets = list[float]()
    for outputs in _group_outputs_by_final_input(scale, records).values():
        largest_swing = max(map(oscillation_amplitude, outputs))
        if largest_swing < AT_REST:
            offsets += _distances_from_rest(outputs, is_centred=False)
    return max(offsets, default=0.0)


def _group_outputs_by_final_input(
    scale: Scale, records: list[Trajectory]
) -> dict[bytes, list[OutputSignal]]:
    """Group the scaled outputs of records that return to a constant input by that input."""
    groups: dict[bytes, list[OutputSignal]] = {}
    input_scale = scale.with_disturbances_as_inputs()
    for record in records:
        final_input = input_scale.scaled_input(record.inputs_and_disturbances[-1])
        level = np.round(final_input, SAME_INPUT) + 0.0  # no negative zero
        output = scale.scaled_output(record.y[1:])
        group = groups.setdefault(level.tobytes(), [])
        group.append(output)
    return groups


def _starts_far_from_rest(outputs: list[OutputSignal]) -> bool:
    """Whether at least one of several outputs begins far from its final value."""
    for output in outputs:
        tail, _ = _last_quarter_and_noise(output)
        final_value = tail.mean(axis=0)
        distance = np.abs(output[0] - final_value)
        if distance.max() >= FAR:
            return True
    return False


def _distances_from_rest(outputs: list[OutputSignal], *, is_centred: bool) -> list[float]:
    """Distance of each record's final output from the equilibrium or from the mean of the other
    records, less its uncertainty."""
    tails = [_last_quarter_and_noise(y) for y in outputs]
    means = np.stack([tail.mean(axis=0) for tail, _ in tails])
    spread = np.stack([noise / len(tail) for tail, noise in tails])
    others = len(means) - 1
    if not is_centred and not others:
        return []
    if not is_centred:
        mean_of_others = (means.sum(axis=0) - means) / others
        means = means - mean_of_others
        spread = spread * (1 + 1 / others)
    standard_errors = np.sqrt(spread)
    offsets = np.abs(means) - SURE * standard_errors
    largest_offsets = offsets.max(axis=1)
    return [float(offset) for offset in largest_offsets]


def output_after_motion(
    inputs: InputSignal, output: OutputSignal, response_length: int
) -> FinalOutput:
    """Last part of an output, in which the response to the last change of the input has died out;
    empty for a shorter record."""
    empty_output = output[:0]
    if not inputs.any():
        return empty_output
    moving_samples = np.flatnonzero(inputs.any(axis=1))
    last_motion = int(moving_samples[-1])
    rest = output[last_motion + 1 :]
    shortest = max(RESPONSES * response_length, FEWEST)
    return rest if len(rest) >= shortest else empty_output


def remaining_offset(output: OutputSignal) -> float:
    """Offset or oscillation amplitude, whichever is larger, of the output at the end of a record
    with constant input. The last quarter counts, with noise removed."""
    tail, noise = _last_quarter_and_noise(output)
    standard_error = np.sqrt(noise / len(tail))
    offset = np.abs(tail.mean(axis=0)) - SURE * standard_error
    offset = np.maximum(offset, 0.0)
    largest_offset = float(offset.max())
    return max(largest_offset, oscillation_amplitude(output))


def oscillation_amplitude(output: OutputSignal) -> float:
    """Amplitude of an output's oscillation in the last quarter of a record at constant input."""
    tail, noise = _last_quarter_and_noise(output)
    relative_error = np.sqrt(8 / len(tail))
    most_noise = (1 + SURE * relative_error) * noise
    total_variance = tail.var(axis=0)
    variance = np.maximum(total_variance - most_noise, 0.0)
    amplitude = np.sqrt(2 * variance)
    return float(amplitude.max())


def _last_quarter_and_noise(output: OutputSignal) -> tuple[FinalOutput, Variance]:
    """Last quarter of an output at constant input, and the variance of the noise in it. The
    variance is the mean of `median(S) / ln 2`, each over `NEIGHBOURS` lines.

    A swing, of any frequency, is a line of the periodogram S, and moves no median; noise that a
    loop has fed back and coloured is broad, and does. The relative variance is about 6/T, that of
    the output's own 2/T.
    """
    samples = max(len(output) // 4, FEWEST)
    tail = output[-samples:]
    _, density = scipy.signal.periodogram(tail, window="hann", detrend=scipy.signal.detrend, axis=0)
    lines = density[1:-1]
    medians = scipy.ndimage.median_filter(lines, (NEIGHBOURS, 1), mode="reflect")
    noise_variance = medians.mean(axis=0) / 2 / np.log(2)
    return tail, noise_variance
