"""Settling, overshoot and empirical rate of signals whose answers are known without a computer."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.loop.metrics import (
    COLUMNS,
    measured_noise_gain,
    pool_columns,
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
    y = np.array(signals, dtype=float)[:, :, None]
    still = np.zeros_like(y)
    per_sample = np.reshape(reference, (-1, 1))
    references = np.broadcast_to(per_sample, y.shape[1:]).astype(float)
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
    run = rollouts([3, 1, 0.1, 0.1], [3, 0.1, 1, 0.1], [3, 0.1, 0.1, 1], settled, never_inside)
    expected = (1.0, 1.5, None, 0.0, None)
    assert settling_times_s(run, 0.2) == expected


def test_the_last_tenth_of_the_horizon_is_the_least_that_counts():
    """A pure oscillation passes through the band; only one that has stayed there counts."""
    a_tenth_inside = [3.0] * 36 + [0.1] * 4
    less_than_a_tenth_inside = [3.0] * 37 + [0.1] * 3
    run = rollouts(a_tenth_inside, less_than_a_tenth_inside)
    assert settling_times_s(run, 0.2) == (18.0, None)

    angles = 0.7 * np.arange(150)
    phases = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    sines = [np.sin(angles + phase).tolist() for phase in phases]
    swinging = rollouts(*sines)
    assert settling_times_s(swinging, 0.2) == (None,) * 200
    motions = set(classify_motions(swinging, 0.2))
    assert motions == {"oscillating"}


def test_what_does_not_settle_is_told_apart():
    k = np.arange(200.0)
    signals = {
        "settled": 4 * 0.9**k,
        "slow": 4 * 0.994**k,
        "oscillating": 0.6 * np.cos(0.9 * k),
        "drifting": 0.01 * k,
        "lost": 0.01 * k,
    }
    left = (*(STAYED,) * 4, 100)
    run = rollouts(*[signal.tolist() for signal in signals.values()], left=left)
    assert classify_motions(run, 0.2) == tuple(signals)


def test_a_motion_that_does_not_end_in_the_band_drifts_or_oscillates():
    k = np.arange(200.0)
    offset = 0.5 + 0 * k
    ringing = 3 + np.cos(k)
    growing = 0.3 * 1.01**k * np.cos(k)
    run = rollouts(offset.tolist(), ringing.tolist(), growing.tolist())
    expected = ("drifting", "oscillating", "oscillating")
    assert classify_motions(run, 0.2) == expected


def test_settled_is_measured_from_the_reference():
    to_the_reference = rollouts([0, 4, 5.1, 4.9], reference=5.0)
    near_zero = rollouts([0, 0.1, 0.1, 0.1], reference=5.0)
    assert settling_times_s(to_the_reference, 0.2) == (1.0,)
    assert settling_times_s(near_zero, 0.2) == (None,)


def test_time_and_overshoot_count_from_the_last_step_of_the_reference():
    reference = [0, 0, 5, 5, 5, 5, 5, 5]
    signal = [0, 0, 0, 4, 6, 5, 5, 5]
    run = rollouts(signal, reference=reference)
    assert settling_times_s(run, 0.2) == (1.5,)
    overshoot = overshoots(run, 0.2)
    np.testing.assert_allclose(overshoot, [0.2])


def test_a_reference_that_keeps_moving_counts_from_the_start():
    reference = [0, 1, 2, 3, 4, 5]
    signal = [1, 1, 2, 3, 4, 5]
    run = rollouts(signal, reference=reference)
    assert settling_times_s(run, 0.2) == (0.5,)


def test_a_case_that_left_the_bound_never_settles():
    signal = [3, 0, 0, 0]
    run = rollouts(signal, signal, left=(2, STAYED))
    assert settling_times_s(run, 0.2) == (None, 0.5)


def test_overshoot_is_a_share_of_the_start():
    across_zero = [[4, 0, -1, 0], [-4, 0, 2, 0]]
    none_or_small = [[4, 1, 0.5, 0], [4, 0, -0.1, 0], [0.1, 5, 0, 0]]
    run = rollouts(*across_zero, *none_or_small)

    shares = overshoots(run, 0.2)

    np.testing.assert_allclose(shares, [0.25, 0.5, 0, 0, 0])


def test_empirical_rate_of_a_geometric_decay():
    k = np.arange(30.0)
    decay = 0.8**k
    run = rollouts((4 * decay).tolist(), decay.tolist(), (-2.0 * decay).tolist())

    rate = measured_contraction_rate(run, 0.2)

    assert rate == pytest.approx(1 - 0.8**2, rel=0.01)


def test_trajectories_that_part_have_a_negative_rate():
    parting = rollouts([1, 2, 4], [0, 0, 0])
    rate = measured_contraction_rate(parting, 0.2)
    assert rate < 0


def test_no_pairs_no_rate():
    alone = rollouts([1, 0, 0])
    too_close = rollouts([1, 0], [1.1, 0])
    assert measured_contraction_rate(alone, 0.2) is None
    assert measured_contraction_rate(too_close, 0.2) is None


def loop_runs(run: Rollouts, settling_band: float) -> LoopRuns:
    """A loop whose controlled and uncontrolled runs are the same."""
    return LoopRuns(
        controlled=run, uncontrolled=run, settling_band=settling_band, input_equilibrium=np.zeros(1)
    )


def test_the_remaining_error_is_the_mean_over_the_last_tenth():
    """The last tenth of 120 samples is 12: an error in the first of them counts, one before it does
    not."""
    for first, error in ((108, 2.0), (107, 0.0)):
        impulse = [24.0 * (k == first) for k in range(120)]
        run = rollouts(impulse)
        columns = pool_columns([loop_runs(run, 0.2)])
        assert columns["final_error_worst"] == pytest.approx(error)


def test_what_the_noise_leaves_is_read_where_the_loop_has_come_to_rest():
    """The second half alone, of the cases that stayed; noise of deviation 2 there."""
    start = [9.0] * 4
    rest = [1.0, -1.0, 1.0, -1.0]
    three_times = [3 * y for y in rest]
    left = [99.0] * 8
    run = rollouts(start + rest, start + three_times, left, left=(STAYED, STAYED, 3))
    noise = np.array([50.0, 0.0, 0.0, 0.0, 2.0, 2.0, -2.0, -2.0])[:, None]
    noisy = replace(run, measured=run.y + noise)
    noise_free = replace(run, measured=run.y)
    all_left = replace(noisy, left_at_sample=np.full(3, 3))

    gain = measured_noise_gain(noisy)

    root_mean_square = np.sqrt((1 + 9) / 2)
    assert gain == pytest.approx(root_mean_square / 2)
    assert measured_noise_gain(noise_free) is None
    assert measured_noise_gain(all_left) is None


COMPARED = [
    ([0.1, 0.2], [0.3, 0.3], True),
    ([0.3, 0.3], [0.3, 0.3], False),
    ([0.4, 0.4], [0.3, 0.3], False),
    ([0.1, None], [0.3, 0.3], False),
    ([0.1, None], [None, None], False),
    ([0.4, 0.4], [0.3, None], True),
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
    run = rollouts(swinging.tolist(), sloping.tolist(), lost.tolist())
    expected = (0.0, 0.0, None)
    assert settling_times_s(run, 0.1) == expected
    swings = residual_oscillations(run, 0.1)
    assert swings.shape == (2,)  # the third is not settled
    assert swings[0] == pytest.approx(0.04, rel=0.1)
    assert swings[1] == pytest.approx(0.0, abs=1e-9)


def test_the_swing_is_that_of_the_run_without_noise():
    still = rollouts([0.0] * 400)
    cosine = 0.05 * np.cos(0.9 * np.arange(400))
    swinging = rollouts(cosine.tolist())
    gone = rollouts([5.0] * 400)
    at_rest = loop_runs(still, 0.1)
    swinging_without_noise = replace(at_rest, quiet=swinging)
    out_of_the_band = replace(at_rest, controlled=gone, quiet=gone)

    swings = [
        pool_columns([loop])["swings_at_rest"]
        for loop in (at_rest, swinging_without_noise, out_of_the_band)
    ]

    assert swings == [0.0, pytest.approx(0.5, rel=0.1), None]
