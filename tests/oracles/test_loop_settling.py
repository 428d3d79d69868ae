"""Settling, overshoot and empirical rate of signals whose answers are known without a computer."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.loop.metrics import (
    COLUMNS,
    measured_noise_gain,
    pooled_run_columns,
    settles_faster_than_open_loop,
)
from ssm_study.loop.motion import (
    classify_motions,
    measured_contraction_rate,
    overshoots,
    residual_oscillations,
    settling_times_s,
)
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import STAYED, Rollouts


def rollouts(
    *signals: list[float], reference: float | list[float] = 0.0, left: tuple[int, ...] | None = None
) -> Rollouts:
    values = np.array(signals, dtype=float)
    y = values[:, :, None]
    still = np.zeros_like(y)
    column = (-1, 1)
    per_sample = np.reshape(reference, column)
    shape = y.shape[1:]
    references = np.broadcast_to(per_sample, shape).astype(float)
    bound = np.array([100.0])
    samples_at_leaving = left or (STAYED,) * len(y)
    left_at_sample = np.array(samples_at_leaving)
    return Rollouts(
        step_s=0.5,
        reference=references,
        u=still,
        y=y,
        measured=still,
        estimate=still,
        states=still,
        bound=bound,
        left_at_sample=left_at_sample,
    )


def test_every_number_of_the_loop_is_printed_with_its_unit():
    """The integral of the squared error had none."""
    numbers = [column for column in COLUMNS if column.kind == "Float64"]
    without_unit = [column.name for column in numbers if not column.unit]
    assert without_unit == []


def test_settled_is_entering_and_staying():
    settled = [0.1, 0, 0, 0]
    never_inside = [3, 3, 3, 3]
    from_above = [3, 1, 0.1, 0.1]
    leaves_again = [3, 0.1, 1, 0.1]
    leaves_at_the_end = [3, 0.1, 0.1, 1]
    run = rollouts(from_above, leaves_again, leaves_at_the_end, settled, never_inside)
    expected = (1.0, 1.5, None, 0.0, None)
    assert settling_times_s(run, 0.2) == expected


def test_the_last_tenth_of_the_horizon_is_the_least_that_counts():
    """A pure oscillation passes through the band; only one that has stayed there counts."""
    outside = [3.0] * 36
    inside = [0.1] * 4
    a_tenth_inside = outside + inside
    outside_longer = [3.0] * 37
    inside_shorter = [0.1] * 3
    less_than_a_tenth_inside = outside_longer + inside_shorter
    run = rollouts(a_tenth_inside, less_than_a_tenth_inside)
    times_s = settling_times_s(run, 0.2)
    expected = (18.0, None)
    assert times_s == expected

    angles = 0.7 * np.arange(150)
    whole_turn = 2 * np.pi
    phases = np.linspace(0, whole_turn, 200, endpoint=False)
    sines = [np.sin(angles + phase).tolist() for phase in phases]
    swinging = rollouts(*sines)
    swinging_times_s = settling_times_s(swinging, 0.2)
    assert swinging_times_s == (None,) * 200
    names_of_motions = classify_motions(swinging, 0.2)
    motions = set(names_of_motions)
    assert motions == {"oscillating"}


def test_what_does_not_settle_is_told_apart():
    k = np.arange(200.0)
    fast = 4 * 0.9**k
    slow = 4 * 0.994**k
    cosine = np.cos(0.9 * k)
    signals = {
        "settled": fast,
        "slow": slow,
        "oscillating": 0.6 * cosine,
        "drifting": 0.01 * k,
        "lost": 0.01 * k,
    }
    stayed = (STAYED,) * 4
    lists = [signal.tolist() for signal in signals.values()]
    run = rollouts(*lists, left=(*stayed, 100))
    motions = classify_motions(run, 0.2)
    assert motions == tuple(signals)


def test_a_motion_that_does_not_end_in_the_band_drifts_or_oscillates():
    k = np.arange(200.0)
    offset = 0.5 + 0 * k
    ringing = 3 + np.cos(k)
    envelope = 0.3 * 1.01**k
    cosine = np.cos(k)
    growing = envelope * cosine
    run = rollouts(offset.tolist(), ringing.tolist(), growing.tolist())
    expected = ("drifting", "oscillating", "oscillating")
    assert classify_motions(run, 0.2) == expected


def test_settled_is_measured_from_the_reference():
    rising = [0, 4, 5.1, 4.9]
    to_the_reference = rollouts(rising, reference=5.0)
    resting = [0, 0.1, 0.1, 0.1]
    near_zero = rollouts(resting, reference=5.0)
    rising_times_s = settling_times_s(to_the_reference, 0.2)
    assert rising_times_s == (1.0,)
    resting_times_s = settling_times_s(near_zero, 0.2)
    assert resting_times_s == (None,)


def test_time_and_overshoot_count_from_the_last_step_of_the_reference():
    reference = [0, 0, 5, 5, 5, 5, 5, 5]
    signal = [0, 0, 0, 4, 6, 5, 5, 5]
    run = rollouts(signal, reference=reference)
    times_s = settling_times_s(run, 0.2)
    assert times_s == (1.5,)
    overshoot = overshoots(run, 0.2)
    np.testing.assert_allclose(overshoot, [0.2])


def test_a_reference_that_keeps_moving_counts_from_the_start():
    reference = [0, 1, 2, 3, 4, 5]
    signal = [1, 1, 2, 3, 4, 5]
    run = rollouts(signal, reference=reference)
    times_s = settling_times_s(run, 0.2)
    assert times_s == (0.5,)


def test_a_case_that_left_the_bound_never_settles():
    signal = [3, 0, 0, 0]
    left = (2, STAYED)
    run = rollouts(signal, signal, left=left)
    times_s = settling_times_s(run, 0.2)
    expected = (None, 0.5)
    assert times_s == expected


def test_overshoot_is_a_share_of_the_start():
    falling = [4, 0, -1, 0]
    climbing = [-4, 0, 2, 0]
    across_zero = [falling, climbing]
    monotone = [4, 1, 0.5, 0]
    small_overshoot = [4, 0, -0.1, 0]
    small_start = [0.1, 5, 0, 0]
    none_or_small = [monotone, small_overshoot, small_start]
    run = rollouts(*across_zero, *none_or_small)

    shares = overshoots(run, 0.2)

    expected = [0.25, 0.5, 0, 0, 0]
    np.testing.assert_allclose(shares, expected)


def test_empirical_rate_of_a_geometric_decay():
    k = np.arange(30.0)
    decay = 0.8**k
    wide = (4 * decay).tolist()
    plain = decay.tolist()
    negative = (-2.0 * decay).tolist()
    run = rollouts(wide, plain, negative)

    rate = measured_contraction_rate(run, 0.2)

    true_rate = 1 - 0.8**2
    expected = pytest.approx(true_rate, rel=0.01)
    assert rate == expected


def test_trajectories_that_part_have_a_negative_rate():
    growing = [1, 2, 4]
    zero = [0, 0, 0]
    parting = rollouts(growing, zero)
    rate = measured_contraction_rate(parting, 0.2)
    assert rate < 0


def test_no_pairs_no_rate():
    signal = [1, 0, 0]
    alone = rollouts(signal)
    first = [1, 0]
    second = [1.1, 0]
    too_close = rollouts(first, second)
    assert measured_contraction_rate(alone, 0.2) is None
    assert measured_contraction_rate(too_close, 0.2) is None


def loop_runs(run: Rollouts, settling_band: float) -> LoopRuns:
    """A loop whose controlled and uncontrolled runs are the same."""
    input_equilibrium = np.zeros(1)
    return LoopRuns(
        controlled=run,
        uncontrolled=run,
        settling_band=settling_band,
        input_equilibrium=input_equilibrium,
    )


def test_the_remaining_error_is_the_mean_over_the_last_tenth():
    """The last tenth of 120 samples is 12: an error in the first of them counts, one before it does
    not."""
    cases = ((108, 2.0), (107, 0.0))
    for first, error in cases:
        impulse = [24.0 * (k == first) for k in range(120)]
        run = rollouts(impulse)
        loop = loop_runs(run, 0.2)
        columns = pooled_run_columns([loop])
        expected = pytest.approx(error)
        assert columns["final_error_worst"] == expected


def test_what_the_noise_leaves_is_read_where_the_loop_has_come_to_rest():
    """The second half alone, of the cases that stayed; noise of deviation 2 there."""
    start = [9.0] * 4
    rest = [1.0, -1.0, 1.0, -1.0]
    three_times = [3 * y for y in rest]
    left = [99.0] * 8
    left_at = (STAYED, STAYED, 3)
    run = rollouts(start + rest, start + three_times, left, left=left_at)
    values = [50.0, 0.0, 0.0, 0.0, 2.0, 2.0, -2.0, -2.0]
    noise = np.array(values)[:, None]
    measured = run.y + noise
    noisy = replace(run, measured=measured)
    noise_free = replace(run, measured=run.y)
    left_at_sample = np.full(3, 3)
    all_left = replace(noisy, left_at_sample=left_at_sample)

    gain = measured_noise_gain(noisy)

    mean_square = (1 + 9) / 2
    root_mean_square = np.sqrt(mean_square)
    expected = pytest.approx(root_mean_square / 2)
    assert gain == expected
    assert measured_noise_gain(noise_free) is None
    assert measured_noise_gain(all_left) is None


FAST = [0.1, 0.2]
FAST_ONCE = [0.1, None]
EQUAL = [0.3, 0.3]
SLOW = [0.4, 0.4]
SETTLES_ONCE = [0.3, None]
NEVER = [None, None]
COMPARED = [
    (FAST, EQUAL, True),
    (EQUAL, EQUAL, False),
    (SLOW, EQUAL, False),
    (FAST_ONCE, EQUAL, False),
    (FAST_ONCE, NEVER, False),
    (SLOW, SETTLES_ONCE, True),
]


@pytest.mark.parametrize(("controlled", "alone", "faster"), COMPARED)
def test_faster_than_the_open_loop_needs_every_case_and_a_smaller_mean(controlled, alone, faster):
    assert settles_faster_than_open_loop(controlled, alone) is faster


def test_a_swing_within_the_band_is_settled_and_not_at_rest():
    time = np.arange(200)
    sine = np.sin(0.9 * time)
    swinging = 0.04 * sine
    sloping = 0.04 - 1e-4 * time
    lost = np.full(200, 5.0)
    swinging_values = swinging.tolist()
    sloping_values = sloping.tolist()
    lost_values = lost.tolist()
    run = rollouts(swinging_values, sloping_values, lost_values)
    expected = (0.0, 0.0, None)
    assert settling_times_s(run, 0.1) == expected
    swings = residual_oscillations(run, 0.1)
    assert swings.shape == (2,)  # the third is not settled
    amplitude = pytest.approx(0.04, rel=0.1)
    assert swings[0] == amplitude
    no_amplitude = pytest.approx(0.0, abs=1e-9)
    assert swings[1] == no_amplitude


def test_the_swing_is_that_of_the_run_without_noise():
    still = rollouts([0.0] * 400)
    angles = 0.9 * np.arange(400)
    cosine = 0.05 * np.cos(angles)
    swinging = rollouts(cosine.tolist())
    gone = rollouts([5.0] * 400)
    at_rest = loop_runs(still, 0.1)
    swinging_without_noise = replace(at_rest, quiet=swinging)
    out_of_the_band = replace(at_rest, controlled=gone, quiet=gone)

    loops = (at_rest, swinging_without_noise, out_of_the_band)
    pooled = [pooled_run_columns([loop]) for loop in loops]
    swings = [columns["swings_at_rest"] for columns in pooled]

    expected_swing = pytest.approx(0.5, rel=0.1)
    assert swings == [0.0, expected_swing, None]
