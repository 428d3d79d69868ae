"""Measures of how simulated closed loops move: settling time, oscillation, overshoot and
contraction.

Judged on the true output alone, never on the noisy measurement.
"""

import numpy as np
from jaxtyping import Float

from ssm_study.loop.rollout import OutputSignal, PerCase, Rollouts

# share of the horizon, at its end, that a settled case spends in the band: a last sample in it is
# no rest
DWELL = 0.1
# a case whose largest error in the last quarter is below this share of the one before is still on
# its way
STEADY = 0.9


def last_step_sample(reference: OutputSignal) -> int:
    """Sample at which a step-like reference reaches its final value.

    0 if the reference still moves in the second half.
    """
    steps = np.diff(reference, axis=0)
    has_changed = np.any(steps != 0, axis=1)
    changes = np.flatnonzero(has_changed)
    if not len(changes):
        return 0
    last = int(changes[-1]) + 1
    middle = len(reference) // 2
    return last if last <= middle else 0


def settling_times_s(rollouts: Rollouts, settling_band: float) -> tuple[float | None, ...]:
    """Settling time of each simulation, in seconds after the last step of the reference; None for
    one that never settles.

    From that time on `|y - reference| <= band` holds to the end. None if there is no such time, or
    if less than `DWELL` of the horizon follows it. `settling_band` in the output's unit. A case
    that left the bound never settles, whatever it did before; one that is in the band throughout
    settles in 0.
    """
    error = rollouts.y - rollouts.reference
    is_far = np.abs(error) > settling_band
    outside = is_far.any(axis=2)
    samples = outside.shape[1]
    backwards = outside[:, ::-1]
    since_last_outside = np.argmax(backwards, axis=1)
    was_outside = outside.any(axis=1)
    first = np.where(was_outside, samples - since_last_outside, 0)
    share_in_samples = np.ceil(DWELL * samples)
    dwell = max(int(share_in_samples), 1)
    dwells = first <= samples - dwell
    is_settled = rollouts.stayed_within_bound & dwells
    last_step = last_step_sample(rollouts.reference)
    after_step = np.maximum(first - last_step, 0)
    times_s: list[float | None] = []
    for k, settles in zip(after_step, is_settled, strict=True):
        time_s = float(k * rollouts.step_s)
        times_s.append(time_s if settles else None)
    return tuple(times_s)


def classify_motions(rollouts: Rollouts, settling_band: float) -> tuple[str, ...]:
    """Class of each simulated motion: `settled`, `lost` (left the bound), `slow`, `oscillating` or
    `drifting`.

    Lost: it left the bound. Slow: the error still shrinks from the third quarter of the horizon to
    the last. Oscillating: over these two, the swing about a straight line exceeds what the line
    itself rises. Drifting: the rest, an error that stays where it is among them.
    """
    times_s = settling_times_s(rollouts, settling_band)
    has_settled = [time_s is not None for time_s in times_s]
    error = rollouts.y - rollouts.reference
    size = np.linalg.norm(error, axis=2)
    samples = size.shape[1]
    quarter = max(samples // 4, 1)
    half = 2 * quarter
    in_third_quarter = size[:, -half:-quarter]
    in_last_quarter = size[:, -quarter:]
    third_quarter = in_third_quarter.max(axis=1)
    last_quarter = in_last_quarter.max(axis=1)
    error_sizes = np.abs(error)
    largest_errors = error_sizes.max(axis=1)
    worst_output = np.argmax(largest_errors, axis=1)
    places = worst_output[:, None, None]
    worst_column = np.take_along_axis(error, places, axis=2)
    worst_error = worst_column[:, :, 0]
    last_half = worst_error[:, -half:]
    rise, swing = trend_and_oscillation(last_half)
    total_rise = np.abs(rise)
    least_swing = np.maximum(total_rise, settling_band)
    oscillates = swing > least_swing
    moving = np.where(oscillates, "oscillating", "drifting")
    still_shrinks = last_quarter < STEADY * third_quarter
    kinds = np.where(still_shrinks, "slow", moving)
    kinds = np.where(rollouts.stayed_within_bound, kinds, "lost")
    kinds = np.where(has_settled, "settled", kinds)
    return tuple(str(kind) for kind in kinds)


def trend_and_oscillation(signals: Float[np.ndarray, "N K"]) -> tuple[PerCase, PerCase]:
    """Rise of each signal's least-squares line (trend), and peak-to-peak oscillation about this
    line."""
    samples = signals.shape[1]
    time = np.linspace(-0.5, 0.5, samples)
    time_power = time @ time
    rise = signals @ time / time_power
    means = signals.mean(axis=1, keepdims=True)
    line = rise[:, None] * time
    deviation = (signals - means) - line
    oscillation = np.ptp(deviation, axis=1)
    return rise, oscillation


def residual_oscillations(rollouts: Rollouts, settling_band: float) -> Float[np.ndarray, "S"]:
    """Amplitude of the output's oscillation in the last tenth of the horizon, for each settled
    simulation.

    The amplitude is about a straight line. A loop that swings for ever inside the band of settling
    is settled by definition, and not at rest. In the output's unit.
    """
    times_s = settling_times_s(rollouts, settling_band)
    has_settled = [time_s is not None for time_s in times_s]
    is_settled = np.array(has_settled)
    error_of_all = rollouts.y - rollouts.reference
    error = error_of_all[is_settled]
    _, samples, outputs = error.shape
    share_in_samples = np.ceil(DWELL * samples)
    last = max(int(share_in_samples), 2)
    tails = error[:, -last:]
    swings = []
    for output in range(outputs):
        tail = tails[:, :, output]
        _, swing = trend_and_oscillation(tail)
        swings.append(swing)
    largest_swings = np.max(swings, axis=0)
    return np.asarray(largest_swings / 2)


def overshoots(rollouts: Rollouts, settling_band: float) -> PerCase:
    """Overshoot of the output beyond the reference, relative to the initial error, for each
    simulation.

    An excursion counts on the far side from the start, which is the last step of the reference; the
    worst channel counts. Only excursions beyond the band count: within it, the measurement noise
    that the controller passes on decides. Zero for cases that start within the band.
    """
    start_sample = last_step_sample(rollouts.reference)
    error_of_all = rollouts.y - rollouts.reference
    error = error_of_all[:, start_sample:]
    start = error[:, :1]
    start_errors = start[:, 0]
    size = np.abs(start_errors)
    on_far_side = -np.sign(start) * error
    excursions = np.maximum(on_far_side, 0.0)
    excursion = excursions.max(axis=1)
    counts = (size > settling_band) & (excursion > settling_band)
    divisors = np.where(counts, size, 1.0)
    shares = excursion / divisors
    counted_shares = np.where(counts, shares, 0.0)
    return counted_shares.max(axis=1)


def measured_contraction_rate(rollouts: Rollouts, settling_band: float) -> float | None:
    """Contraction rate of a simulated closed loop, as the median over pairs of trajectories.

    It is `1 - r^2`, where r is the mean shrink per sample of `|y_i - y_j|` from the start until it
    is within the band. Pairs count that start more than twice the band apart; the rate is in the
    convention of `rate_controller` (distances shrink by `sqrt(1 - rate)`), so the two compare.
    Pairs that never come within the band are taken to the end of the horizon. None without such
    pairs.
    """
    case_count = len(rollouts.y)
    i, j = np.triu_indices(case_count, k=1)  # each pair of cases once
    first_outputs = rollouts.y[i]
    second_outputs = rollouts.y[j]
    differences = first_outputs - second_outputs
    distances = np.linalg.norm(differences, axis=2)
    starts_apart = distances[:, 0] > 2 * settling_band
    if not starts_apart.any():
        return None
    resolution = settling_band / 2  # an exact zero is not a rate
    distances = np.maximum(distances[starts_apart], resolution)
    per_case = mean_squared_contraction(distances, settling_band)
    median = np.median(per_case)
    return float(1.0 - median)


def mean_squared_contraction(
    distances: Float[np.ndarray, "N T"], end_distances: float | Float[np.ndarray, "N 1"]
) -> PerCase:
    """Squared mean contraction factor per sample, for each row of an array of distances over time.

    A row counts until it is at most `end_distances`, else to its end.
    """
    is_small = distances <= end_distances
    last_sample = distances.shape[1] - 1
    becomes_small = is_small.any(axis=1)
    first_small = np.argmax(is_small, axis=1)
    at = np.where(becomes_small, first_small, last_sample)
    rows = np.arange(len(distances))
    final_distances = distances[rows, at]
    initial_distances = distances[:, 0]
    ratios = final_distances / initial_distances
    exponents = 2.0 / np.maximum(at, 1)
    return np.asarray(ratios**exponents)
