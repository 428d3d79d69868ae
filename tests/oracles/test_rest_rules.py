"""Rules of returns, rests, offsets and swings, at the edges; margins from loop gains."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import BALLS, flat, motor_model

from ssm_study.certificates.problem import NoSolution
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import BAND, Mismatch, _choose_larger_offsets
from ssm_study.robustness.prediction import Prediction, _group_by_amplitude, margin_from_loop_gain
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.robustness.return_to_rest import (
    AT_REST,
    FAR,
    FEWEST,
    RESPONSES,
    _distances_from_rest,
    is_return_to_rest,
    largest_equilibrium_difference,
    oscillation_amplitude,
    oscillations_and_offsets_after_returns,
    output_after_motion,
    remaining_offset,
)
from ssm_study.signals import Scale, Trajectory
from ssm_study.synthesis.deployed import (
    RangeWithinLimits,
    certificate_or_none,
    equilibrium_corners,
    initial_output_range,
    scaled_equilibrium_states,
)
from ssm_study.systems import JacobianBall

UNIT = Scale(
    input_equilibrium=np.zeros(1),
    input_scale=np.ones(1),
    output_equilibrium=np.zeros(1),
    output_scale=np.ones(1),
)


def record_of(u: Any, y: Any, d: Any = None) -> Trajectory:
    """A record of one input and one output."""
    disturbance = None if d is None else np.asarray(d, dtype=float)[:, None]
    inputs = np.asarray(u, dtype=float)[:, None]
    outputs = np.asarray(y, dtype=float)[:, None]
    return Trajectory(u=inputs, y=outputs, d=disturbance, step_s=0.1)


def returning(level: float, y: Any) -> Trajectory:
    """A record whose input steps to a level at its second sample."""
    inputs = np.full(len(y), level)
    inputs[0] = level + 1.0
    return record_of(inputs, y)


def test_a_return_steps_once_at_the_beginning() -> None:
    zeros = np.zeros(FEWEST + 1)
    assert is_return_to_rest(returning(0.0, zeros))
    assert not is_return_to_rest(returning(0.0, zeros[1:])), "too short"
    assert not is_return_to_rest(record_of(zeros, zeros)), "no step"
    later = zeros.copy()
    later[:2] = 1.0
    assert not is_return_to_rest(record_of(later, zeros)), "a step too late"
    step = zeros.copy()
    step[0] = 1.0
    assert is_return_to_rest(record_of(zeros, zeros, d=step))
    assert not is_return_to_rest(record_of(step, zeros, d=later))


LENGTH = 40
SHORTEST = RESPONSES * LENGTH


def still(offset: float, samples: int = SHORTEST + 1, start: float = 0.0) -> np.ndarray:
    """Output that stays at an offset from its third sample on."""
    y = np.full(samples, offset)
    y[:2] = offset + start
    return y


def offsets_of(*records: Trajectory) -> tuple[list[float], list[float]]:
    """Oscillations and offsets after returns to rest."""
    return oscillations_and_offsets_after_returns(UNIT, list(records), LENGTH)


@pytest.mark.parametrize(("offset", "count"), [(0.019, 0), (0.021, 1), (-0.021, 1)])
def test_an_offset_counts_beyond_two_percent(offset: float, count: int) -> None:
    motions, offsets = offsets_of(returning(0.0, still(offset)))
    expected = pytest.approx([0.0])
    assert motions == expected
    assert len(offsets) == count
    expected = pytest.approx([abs(offset)] * count)
    assert offsets == expected


def test_at_another_input_returns_are_compared_with_the_others() -> None:
    alone = offsets_of(returning(0.5, still(0.4)))
    assert alone == ([], [])
    pair = [returning(0.5, still(offset)) for offset in (0.4, 0.5)]
    _, offsets = offsets_of(*pair)
    expected = pytest.approx([0.1, 0.1])
    assert offsets == expected
    three = [returning(0.5, still(offset)) for offset in (0.4, 0.4, 0.7)]
    _, offsets = offsets_of(*three)
    expected = pytest.approx([0.15, 0.15, 0.3])
    assert offsets == expected
    apart = [returning(level, still(level)) for level in (0.4, 0.5)]
    expected = ([], [])
    assert offsets_of(*apart) == expected, "levels are groups of their own"


def test_a_short_return_counts_from_far_where_it_is_still() -> None:
    samples = SHORTEST
    near = returning(0.0, still(0.0, samples, start=0.99 * FAR))
    expected = ([], [])
    assert offsets_of(near) == expected
    far = returning(0.0, still(0.0, samples, start=1.01 * FAR))
    motions, offsets = offsets_of(far)
    expected = pytest.approx([0.0])
    assert motions == expected
    assert offsets == []
    moved = returning(0.0, still(1.01 * AT_REST, samples, start=1.01 * FAR))
    expected = ([], [])
    assert offsets_of(moved) == expected, "it has not come to rest"
    long = returning(0.0, still(0.0))
    motions, offsets = offsets_of(long, moved)
    expected = pytest.approx([0.0])
    assert motions == expected, "long returns count alone"
    assert offsets == []


def test_equal_inputs_of_six_digits_share_an_equilibrium() -> None:
    pair = [returning(level, still(offset)) for level, offset in ((0.5, 0.1), (0.5 + 1e-8, 0.4))]
    expected = pytest.approx(0.3)
    actual = largest_equilibrium_difference(UNIT, pair)
    assert actual == expected
    apart = [pair[0], returning(0.5001, still(0.4))]
    assert largest_equilibrium_difference(UNIT, apart) == 0.0
    swing = 0.2 * np.sin(np.arange(SHORTEST + 1))
    moving = [pair[0], returning(0.5, swing)]
    assert largest_equilibrium_difference(UNIT, moving) == 0.0
    assert largest_equilibrium_difference(UNIT, []) == 0.0


def test_a_distance_from_the_equilibrium_needs_no_other_record() -> None:
    y = [np.full((40, 1), 0.3)]
    expected = pytest.approx([0.3])
    actual = _distances_from_rest(y, is_centred=True)
    assert actual == expected
    actual = _distances_from_rest(y, is_centred=False)
    assert actual == []


@given(st.floats(0.05, 2.0), st.floats(0.3, 2.8))
def test_a_swing_has_its_amplitude_and_noise_has_none(amplitude: float, angle: float) -> None:
    time = np.arange(2000)
    swing = (amplitude * np.sin(angle * time))[:, None]
    expected = pytest.approx(amplitude, rel=0.05)
    assert oscillation_amplitude(swing) == expected
    offset = swing + 3 * amplitude
    expected = pytest.approx(3 * amplitude, rel=0.05)
    assert remaining_offset(offset) == expected
    expected = pytest.approx(amplitude, rel=0.05)
    assert remaining_offset(swing) == expected
    noise = np.random.default_rng(0).standard_normal((2000, 1))
    assert oscillation_amplitude(amplitude * noise) == 0.0
    assert remaining_offset(amplitude * noise) < 0.1 * amplitude


@pytest.mark.parametrize(("samples", "is_long"), [(SHORTEST - 1, False), (SHORTEST, True)])
def test_a_rest_after_motion_lasts_two_responses(samples: int, is_long: bool) -> None:
    moving = np.ones((5, 1))
    inputs = np.concatenate([moving, np.zeros((samples, 1))])
    output = np.arange(len(inputs), dtype=float)[:, None]
    rest = output_after_motion(inputs, output, LENGTH)
    expected = samples if is_long else 0
    assert len(rest) == expected
    if is_long:
        assert rest[0, 0] == 5
    short = output_after_motion(inputs[: 5 + FEWEST], output[: 5 + FEWEST], 1)
    assert len(short) == FEWEST
    shorter = output_after_motion(inputs[: 4 + FEWEST], output[: 4 + FEWEST], 1)
    assert len(shorter) == 0
    count = len(output_after_motion(0 * inputs, output, 1))
    assert count == 0


# Mismatch and prediction.


def view_of(gain: float) -> ModelErrorAtAmplitude:
    """Model error of one gain, which differs between the bands."""
    by_frequency = gain * np.linspace(0.5, 1.0, len(ANGLES))
    return flat(by_frequency, gain).views[0]


def mismatch_of(**facts: Any) -> Mismatch:
    """Mismatch of one amplitude."""
    view = view_of(0.1)
    return Mismatch(views=(view,), **facts)


def test_what_sticks_is_bounded_with_confidence() -> None:
    assert mismatch_of().largest_offset == 0.0
    one = mismatch_of(stuck=(0.03,)).largest_offset
    expected = pytest.approx(0.03 / 0.05 / BAND)
    assert one == expected
    two = mismatch_of(stuck=(0.01, 0.03), farthest=2.0).largest_offset
    expected = pytest.approx(0.03 / np.sqrt(0.05) / (2 * BAND))
    assert two == expected
    expected = [0.3]
    actual = _choose_larger_offsets([0.1, 0.2], [0.3])
    assert actual == expected
    expected = [0.1]
    actual = _choose_larger_offsets([0.1], [])
    assert actual == expected


@pytest.mark.parametrize(("left", "rests"), [(None, True), (0.0199, True), (0.02, False)])
def test_a_plant_rests_below_two_percent(left: float | None, rests: bool) -> None:
    mismatch = mismatch_of(left_at_rest=left)
    assert mismatch.plant_comes_to_rest is rests
    expected = mismatch.gain if rests else np.inf
    assert mismatch.largest_recorded_gain == expected


def test_the_largest_gain_counts_at_every_frequency() -> None:
    small = view_of(0.1)
    large = view_of(0.4)
    mismatch = mismatch_of(loop=large)
    expected = (mismatch.views[0], large)
    assert mismatch.errors_by_amplitude == expected
    np.testing.assert_allclose(mismatch.gain_by_frequency, large.by_frequency)
    middle = (ANGLES[3] + ANGLES[4]) / 2
    gains = mismatch.gain_at(np.array([middle]))
    neighbours = large.by_frequency[3:5]
    expected = pytest.approx(neighbours.mean())
    assert gains[0] == expected
    without_loop = mismatch_of()
    np.testing.assert_allclose(without_loop.gain_by_frequency, small.by_frequency)


PREDICTIONS: list[tuple[float, float, float, bool]] = []
PREDICTIONS.append((1.01, 0.99, 0.99, True))
PREDICTIONS.append((1.0, 0.99, 0.99, False))
PREDICTIONS.append((1.01, 1.0, 0.99, False))
PREDICTIONS.append((1.01, 0.99, 1.0, False))


@pytest.mark.parametrize(("margin", "radius", "noise", "is_stable"), PREDICTIONS)
def test_every_condition_of_a_prediction_is_needed(
    margin: float, radius: float, noise: float, is_stable: bool
) -> None:
    prediction = Prediction(
        mismatch_margin=0.1, resolved_margin=margin, controller_radius=radius, noise_peak=noise
    )
    assert prediction.predicts_stability() is is_stable
    assert prediction.predicts_stability(0.5) is (radius < 1 and noise < 1)
    assert not prediction.predicts_stability(2.0)


def test_a_margin_is_the_inverse_of_a_gain() -> None:
    assert margin_from_loop_gain(0.5) == 2.0
    assert margin_from_loop_gain(0.0) == np.inf
    assert margin_from_loop_gain(np.inf) == 0.0


def test_small_amplitudes_meet_the_slopes_within_their_swing() -> None:
    model = motor_model()
    view = view_of(0.1)
    views = [replace(view, amplitude=amplitude) for amplitude in (0.01, 0.02, 1.0)]
    wide = JacobianBall(alpha=1.0, beta=5.0)
    balls = replace(BALLS, input=wide)
    three = Mismatch(views=tuple(views), loop=view)
    (_, large), (met, small) = _group_by_amplitude(model, balls, three)
    expected = tuple(views[1:])
    assert large.views == expected
    assert large.loop is view
    expected = tuple(views[:2])
    assert small.views == expected
    assert small.loop is None
    assert met.input.beta < 0.95 * wide.beta
    two = Mismatch(views=tuple(views[1:]))
    expected = [(balls, two)]
    actual = _group_by_amplitude(model, balls, two)
    assert actual == expected
    narrow = replace(BALLS, input=JacobianBall(alpha=met.input.alpha, beta=met.input.beta))
    expected = [(narrow, three)]
    actual = _group_by_amplitude(model, narrow, three)
    assert actual == expected


# Limits.


def test_a_search_without_solution_gives_nothing() -> None:
    def fail(error: type[Exception]) -> Any:
        def find() -> None:
            raise error("no")

        return find

    assert certificate_or_none(fail(NoSolution)) is None
    assert certificate_or_none(fail(np.linalg.LinAlgError)) is None
    with pytest.raises(KeyError):
        certificate_or_none(fail(KeyError))


def test_a_range_within_limits_rounds_its_rate_down() -> None:
    ends = (np.array([-1.0]), np.array([2.0]))
    nowhere = RangeWithinLimits(lower=ends[0], upper=ends[1], everywhere=None)
    assert "globally          at no rate" in repr(nowhere)
    assert "from [-1.] to [2.]" in repr(nowhere)
    proof = object.__new__(RangeWithinLimits)
    vars(proof).update(lower=ends[0], upper=ends[1])
    vars(proof)["everywhere"] = type("Proof", (), {"rate": 0.12349})()
    assert "at rate 0.1234 per sample" in repr(proof)


def test_states_at_the_corners_are_rest_states_with_those_outputs() -> None:
    model = motor_model()
    corners = equilibrium_corners(model)
    assert corners is not None
    stored = np.zeros((len(corners) + 2, corners.shape[1]))
    stored[2, 0] = -3.0
    scaled = scaled_equilibrium_states(model, stored)
    assert scaled is not None
    expected = pytest.approx(3.0)
    actual = np.abs(scaled).max()
    assert actual == expected
    assert not scaled[len(corners) :].any()
    share = 3.0 / np.abs(corners).max()
    actual = scaled[: len(corners)]
    np.testing.assert_allclose(actual, share * corners)
    assert scaled_equilibrium_states(model, stored[: len(corners) - 1]) is None
    low, high = initial_output_range(model, scaled)
    read = (model.linear.c @ scaled[: model.order]).T
    outputs = model.scale.physical_output(model.scaffold_out(np.concatenate([read, -read])))
    expected = outputs.min(axis=0)
    np.testing.assert_allclose(low, expected)
    expected = outputs.max(axis=0)
    np.testing.assert_allclose(high, expected)
