"""Settling, overshoot and empirical rate of signals whose answers are known without a computer."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.loop.metrics import COLUMNS, measured_noise_gain, pool_columns, settles_faster
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
    rollouts_reference = np.broadcast_to(np.reshape(reference, (-1, 1)), y.shape[1:]).astype(float)
    bound = np.array([100.0])
    left_at_sample = np.array(left or (STAYED,) * len(y))
    return Rollouts(
        step_s=0.5,
        reference=rollouts_reference,
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
    names = [column.name for column in COLUMNS if column.kind == "Float64" and not column.unit]
    assert names == []


def test_settled_is_entering_and_staying():
    run = rollouts(
        [3, 1, 0.1, 0.1], [3, 0.1, 1, 0.1], [3, 0.1, 0.1, 1], [0.1, 0, 0, 0], [3, 3, 3, 3]
    )
    expected = (1.0, 1.5, None, 0.0, None)
    assert settling_times_s(run, 0.2) == expected


def test_the_last_tenth_of_the_horizon_is_the_least_that_counts():
    """A pure oscillation passes through the band; only one that has stayed there counts."""
    run = rollouts([3.0] * 36 + [0.1] * 4, [3.0] * 37 + [0.1] * 3)
    expected = (18.0, None)
    assert settling_times_s(run, 0.2) == expected
    phases = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    sines = [list(np.sin(0.7 * np.arange(150) + phase)) for phase in phases]
    swinging = rollouts(*sines)
    expected = (None,) * 200
    assert settling_times_s(swinging, 0.2) == expected
    assert set(classify_motions(swinging, 0.2)) == {"oscillating"}


def test_what_does_not_settle_is_told_apart():
    k = np.arange(200.0)
    slow = 4 * 0.994**k
    cosine = np.cos(0.9 * k)
    oscillating = 0.6 * cosine
    signals = {
        "settled": 4 * 0.9**k,
        "slow": slow,
        "oscillating": oscillating,
        "drifting": 0.01 * k,
        "lost": 0.01 * k,
    }
    left = (*(STAYED,) * 4, 100)
    assert classify_motions(
        rollouts(*[list(y) for y in signals.values()], left=left), 0.2
    ) == tuple(signals)
    offset = 0.5 + 0 * k
    ringing = 3 + np.cos(k)
    cosine = np.cos(k)
    growing = 0.3 * 1.01**k * cosine
    run = rollouts(list(offset), list(ringing), list(growing))
    expected = ("drifting", "oscillating", "oscillating")
    assert classify_motions(run, 0.2) == expected


def test_settled_is_measured_from_the_reference():
    assert settling_times_s(rollouts([0, 4, 5.1, 4.9], reference=5.0), 0.2) == (1.0,)
    assert settling_times_s(rollouts([0, 0.1, 0.1, 0.1], reference=5.0), 0.2) == (None,)


def test_time_and_overshoot_count_from_the_last_step_of_the_reference():
    reference = [0, 0, 5, 5, 5, 5, 5, 5]
    run = rollouts([0, 0, 0, 4, 6, 5, 5, 5], reference=reference)
    assert settling_times_s(run, 0.2) == (1.5,)
    actual = overshoots(run, 0.2)
    np.testing.assert_allclose(actual, [0.2])


def test_a_reference_that_keeps_moving_counts_from_the_start():
    reference = [0, 1, 2, 3, 4, 5]
    run = rollouts([1, 1, 2, 3, 4, 5], reference=reference)
    assert settling_times_s(run, 0.2) == (0.5,)


def test_a_case_that_left_the_bound_never_settles():
    expected = (None, 0.5)
    assert settling_times_s(rollouts([3, 0, 0, 0], [3, 0, 0, 0], left=(2, STAYED)), 0.2) == expected


def test_overshoot_is_a_share_of_the_start():
    run = rollouts([4, 0, -1, 0], [-4, 0, 2, 0], [4, 1, 0.5, 0], [4, 0, -0.1, 0], [0.1, 5, 0, 0])
    actual = overshoots(run, 0.2)
    expected = [0.25, 0.5, 0, 0, 0]
    np.testing.assert_allclose(actual, expected)


def test_empirical_rate_of_a_geometric_decay():
    r = 0.8
    run = rollouts(*[[y0 * r**k for k in range(30)] for y0 in (4.0, 1.0, -2.0)])
    expected = 1 - r**2
    assert measured_contraction_rate(run, 0.2) == pytest.approx(expected, rel=0.01)


def test_trajectories_that_part_have_a_negative_rate():
    assert measured_contraction_rate(rollouts([1, 2, 4], [0, 0, 0]), 0.2) < 0


def test_no_pairs_no_rate():
    assert measured_contraction_rate(rollouts([1, 0, 0]), 0.2) is None
    assert measured_contraction_rate(rollouts([1, 0], [1.1, 0]), 0.2) is None


def test_the_remaining_error_is_the_mean_over_the_last_tenth():
    """The last tenth of 120 samples is 12: an error in the first of them counts, one before it does
    not."""
    for first, error in ((108, 2.0), (107, 0.0)):
        run = rollouts([24.0 * (k == first) for k in range(120)])
        input_equilibrium = np.zeros(1)
        loop = LoopRuns(
            controlled=run, uncontrolled=run, settling_band=0.2, input_equilibrium=input_equilibrium
        )
        final_error_worst = pool_columns([loop])["final_error_worst"]
        assert final_error_worst == pytest.approx(error)


def test_what_the_noise_leaves_is_read_where_the_loop_has_come_to_rest():
    """The second half alone, of the cases that stayed; noise of deviation 2 there."""
    start = [9.0] * 4
    rest = [1.0, -1.0, 1.0, -1.0]
    run = rollouts(
        start + rest, start + [3 * y for y in rest], [99.0] * 8, left=(STAYED, STAYED, 3)
    )
    noise = np.array([50.0, 0.0, 0.0, 0.0, 2.0, 2.0, -2.0, -2.0])[:, None]
    measured = run.y + noise
    changed_run = replace(run, measured=measured)
    expected = np.sqrt((1 + 9) / 2) / 2
    assert measured_noise_gain(changed_run) == pytest.approx(expected)
    changed_run = replace(run, measured=run.y)
    assert measured_noise_gain(changed_run) is None
    measured = run.y + noise
    left_at_sample = np.full(3, 3)
    changed_run = replace(run, measured=measured, left_at_sample=left_at_sample)
    assert measured_noise_gain(changed_run) is None


@pytest.mark.parametrize(
    ("controlled", "alone", "faster"),
    [
        ([0.1, 0.2], [0.3, 0.3], True),
        ([0.3, 0.3], [0.3, 0.3], False),
        ([0.4, 0.4], [0.3, 0.3], False),
        ([0.1, None], [0.3, 0.3], False),
        ([0.1, None], [None, None], False),
        ([0.4, 0.4], [0.3, None], True),
    ],
)
def test_faster_than_the_open_loop_needs_every_case_and_a_smaller_mean(controlled, alone, faster):
    assert settles_faster(controlled, alone) is faster


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
    cosine = np.cos(0.9 * np.arange(400))
    swinging = rollouts((0.05 * cosine).tolist())
    input_equilibrium = np.zeros(1)
    loop = LoopRuns(
        controlled=still, uncontrolled=still, settling_band=0.1, input_equilibrium=input_equilibrium
    )
    swings_at_rest = pool_columns([loop])["swings_at_rest"]
    assert swings_at_rest == 0.0
    loop = replace(loop, quiet=swinging)
    swings_at_rest = pool_columns([loop])["swings_at_rest"]
    assert swings_at_rest == pytest.approx(0.5, rel=0.1)
    gone = rollouts([5.0] * 400)
    changed_loop = replace(loop, controlled=gone, quiet=gone)
    loops = [changed_loop]
    columns = pool_columns(loops)
    swings_at_rest = columns["swings_at_rest"]
    assert swings_at_rest is None
