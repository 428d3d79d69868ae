"""Settling, overshoot and empirical rate of signals whose answers are known without a computer."""

import numpy as np
import pytest

from ssm_study.loop.rollout import STAYED, Rollouts
from ssm_study.loop.settling import empirical_rate, overshoots, settling_times_s


def rollouts(
    *signals: list[float], reference: float | list[float] = 0.0, left: tuple[int, ...] | None = None
) -> Rollouts:
    y = np.array(signals, dtype=float)[:, :, None]
    still = np.zeros_like(y)
    return Rollouts(
        step_s=0.5,
        reference=np.broadcast_to(np.reshape(reference, (-1, 1)), y.shape[1:]).astype(float),
        u=still,
        y=y,
        measured=still,
        estimate=still,
        states=still,
        bound=np.array([100.0]),
        left_at_sample=np.array(left or (STAYED,) * len(y)),
    )


def test_settled_is_entering_and_staying():
    run = rollouts([3, 1, 0.1, 0.1], [3, 0.1, 1, 0.1], [3, 0.1, 0.1, 1], [0.1, 0, 0, 0], [3, 3, 3, 3])
    assert settling_times_s(run, 0.2) == (1.0, 1.5, None, 0.0, None)


def test_settled_is_measured_from_the_reference():
    assert settling_times_s(rollouts([0, 4, 5.1, 4.9], reference=5.0), 0.2) == (1.0,)
    assert settling_times_s(rollouts([0, 0.1, 0.1, 0.1], reference=5.0), 0.2) == (None,)


def test_time_and_overshoot_count_from_the_last_step_of_the_reference():
    run = rollouts([0, 0, 0, 4, 6, 5, 5, 5], reference=[0, 0, 5, 5, 5, 5, 5, 5])
    assert settling_times_s(run, 0.2) == (1.5,)
    np.testing.assert_allclose(overshoots(run, 0.2), [0.2])


def test_a_reference_that_keeps_moving_counts_from_the_start():
    run = rollouts([1, 1, 2, 3, 4, 5], reference=[0, 1, 2, 3, 4, 5])
    assert settling_times_s(run, 0.2) == (0.5,)


def test_a_case_that_left_the_bound_never_settles():
    assert settling_times_s(rollouts([3, 0, 0, 0], [3, 0, 0, 0], left=(2, STAYED)), 0.2) == (None, 0.5)


def test_overshoot_is_a_share_of_the_start():
    run = rollouts([4, 0, -1, 0], [-4, 0, 2, 0], [4, 1, 0.5, 0], [4, 0, -0.1, 0], [0.1, 5, 0, 0])
    np.testing.assert_allclose(overshoots(run, 0.2), [0.25, 0.5, 0, 0, 0])


def test_empirical_rate_of_a_geometric_decay():
    r = 0.8
    run = rollouts(*[[y0 * r**k for k in range(30)] for y0 in (4.0, 1.0, -2.0)])
    assert empirical_rate(run, 0.2) == pytest.approx(1 - r**2, rel=0.01)


def test_trajectories_that_part_have_a_negative_rate():
    assert empirical_rate(rollouts([1, 2, 4], [0, 0, 0]), 0.2) < 0


def test_no_pairs_no_rate():
    assert empirical_rate(rollouts([1, 0, 0]), 0.2) is None
    assert empirical_rate(rollouts([1, 0], [1.1, 0]), 0.2) is None
