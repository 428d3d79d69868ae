"""Cuts of a log at their edges: gaps, rests, folds, and settings that contradict each other."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.data.closed_loop import (
    FEWEST,
    LAGS,
    project_inputs_on_set_points,
    reconstruct_pi_set_point,
)
from ssm_study.data.recorded import RecordedData
from ssm_study.data.splits import (
    SHORTEST_REST,
    cut_out_fold,
    is_test_output_different,
    periodic_segments,
    rest_segments,
    split_at_intervals,
    split_by_fold,
    split_by_time,
    split_into_blocks,
    split_log_with_gaps,
)
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory


def record_of(signal: Any, **more: Any) -> Trajectory:
    """A record whose input and output are one signal."""
    column = np.asarray(signal, dtype=float)[:, None]
    return Trajectory(u=column, y=column, step_s=0.1, **more)


def spans(pieces: list[Trajectory]) -> list[tuple[int, int]]:
    """First sample of each piece in its log, and the sample after its last."""
    return [(piece.first, piece.first + len(piece)) for piece in pieces]


def log_with_gap(first: int, second: int, gap: int) -> list[Trajectory]:
    """Two pieces of a log whose samples between them are missing."""
    counts = np.arange(first + gap + second)
    whole = record_of(counts)
    return [whole[:first], whole[first + gap :]]


@given(st.integers(10, 60), st.integers(10, 60), st.integers(1, 30))
def test_a_log_with_a_gap_is_cut_as_if_it_had_none(first: int, second: int, gap: int) -> None:
    log = log_with_gap(first, second, gap)
    parts = split_log_with_gaps(log, lambda record: split_by_time(record, 0.2, 0.3), 1)
    samples = first + second
    edges = [round(0.5 * samples), round(0.7 * samples), samples]
    counted = [sum(map(len, part)) for part in parts]
    values = np.cumsum(counted).tolist()
    assert values == edges
    for part in parts:
        for piece in part:
            expected = piece.u[0, 0]
            assert piece.first == expected
            steps = np.diff(piece.u[:, 0])
            assert (steps == 1).all(), "no piece reaches over the gap"


def test_parts_that_are_too_short_are_left_out_from_one_sample_below() -> None:
    log = log_with_gap(12, 28, 5)
    for shortest, expected in ((12, 2), (13, 1)):
        training, _, _ = split_log_with_gaps(log, lambda record: ([record], [], []), shortest)
        assert len(training) == expected
    (single,) = split_log_with_gaps(log[:1], lambda record: ([record], [], []), 99)[0]
    assert len(single) == 12, "a log without gaps is not cut again"


# Parts.


def test_of_ten_blocks_every_fourth_validates_and_every_fifth_tests() -> None:
    record = record_of(range(100))
    training, validation, test = split_into_blocks(record)
    starts = [piece.first for piece in training]
    expected = [0, 10, 20, 50, 60, 70]
    assert starts == expected
    expected = [(30, 40), (80, 90)]
    assert spans(validation) == expected
    expected = [(40, 50), (90, 100)]
    assert spans(test) == expected


@given(st.integers(2, 6), st.integers(20, 90))
def test_the_fold_before_the_tested_one_validates(folds: int, samples: int) -> None:
    record = record_of(range(samples))
    for fold in range(folds):
        _, (validation,), (test,) = split_by_fold(record, fold, folds)
        first_tested = folds * test.first // samples
        assert first_tested == fold
        expected = (fold - 1) % folds
        assert folds * validation.first // samples == expected


def test_a_fold_at_an_end_leaves_one_piece() -> None:
    record = record_of(range(50))
    kept = [len(cut_out_fold(record, fold, 5)[0]) for fold in range(5)]
    expected = [1, 2, 2, 2, 1]
    assert kept == expected
    remaining, held_out = cut_out_fold(record, 1, 5)
    expected = [(0, 10), (20, 50)]
    assert spans(remaining) == expected
    expected = [(10, 20)]
    actual = spans([held_out])
    assert actual == expected


def test_intervals_may_touch_and_reach_both_ends() -> None:
    record = record_of(range(100))
    named = {"validation": [[0.0, 2.0], [2.0, 3.0]], "test": [[3.0, 10.0]]}
    training, validation, test = split_at_intervals(record, named)
    assert training == []
    expected = [(0, 30)]
    assert spans(validation) == expected
    expected = [(30, 100)]
    assert spans(test) == expected
    without_test = split_at_intervals(record, {"validation": [[9.0, 10.0]]})
    expected = [(0, 90)]
    actual = spans(without_test[0])
    assert actual == expected
    for wrong in ([0.0, 10.1], [-0.1, 1.0], [1.0, 1.0]):
        with pytest.raises(BadRequest, match=r"the log lasts 10 s"):
            split_at_intervals(record, {"test": [wrong]})


# Ends that are unlike.


def parts_of(training: Any, test: Any) -> Any:
    """Parts of which the first trains and the last tests."""
    return [record_of(training)], [], [record_of(test)]


ALTERNATING = np.array([1.0, -1.0] * 20)


ENDS: list[tuple[Any, bool]] = []
ENDS.append((ALTERNATING, False))
ENDS.append((ALTERNATING + 0.99, False))
ENDS.append((ALTERNATING + 1.01, True))
ENDS.append((ALTERNATING - 1.01, True))
ENDS.append((1.99 * ALTERNATING, False))
ENDS.append((2.01 * ALTERNATING, True))
ENDS.append((0.51 * ALTERNATING, False))
ENDS.append((0.49 * ALTERNATING, True))


@pytest.mark.parametrize(("test", "is_different"), ENDS)
def test_an_end_is_unlike_by_its_mean_or_its_deviation(test: Any, is_different: bool) -> None:
    assert is_test_output_different(parts_of(ALTERNATING, test)) is is_different


def test_without_training_or_test_an_end_is_unlike() -> None:
    training, _, test = parts_of(ALTERNATING, ALTERNATING)
    assert is_test_output_different(([], [], test))
    assert is_test_output_different((training, [], []))


# Rests.


def test_a_rest_lasts_longer_than_the_shortest_and_half_the_last() -> None:
    moving = [1.0, 2.0, 3.0]
    for samples, is_rest in ((SHORTEST_REST - 1, False), (SHORTEST_REST, True)):
        record = record_of([*moving, *[0.0] * samples])
        segments = rest_segments(record)
        assert bool(segments) is is_rest
    rests = [0.0] * 9
    for samples, expected in ((8, 1), (9, 2), (10, 2)):
        record = record_of([1.0, *[0.0] * samples, 1.0, *rests, *rests])
        segments = rest_segments(record)
        count = len(segments)
        assert count == expected, samples
    record = record_of([0.0] * 50)
    actual = rest_segments(record)
    assert actual == []


def test_a_rest_begins_at_the_last_moving_sample() -> None:
    record = record_of([1.0] * 5 + [0.0] * 20)
    expected = [(4, 25)]
    segments = rest_segments(record)
    actual = spans(segments)
    assert actual == expected
    disturbed = np.zeros((25, 1))
    disturbed[10] = 1.0
    record = Trajectory(u=record.u, y=record.y, d=disturbed, step_s=0.1)
    expected = [(10, 25)]
    segments = rest_segments(record)
    actual = spans(segments)
    assert actual == expected


def test_periods_count_between_rests_from_the_beginning_on() -> None:
    rng = np.random.default_rng(0)
    period = rng.uniform(1, 2, 40)
    rest = np.zeros(30)
    twice = [period, period, rest]
    record = record_of(np.concatenate([rest, *twice]))
    (piece,) = periodic_segments(record, 0)
    expected = [(15, 140)]
    actual = spans([piece])
    assert actual == expected
    count = len(periodic_segments(record, 15))
    assert count == 1
    assert periodic_segments(record, 40) == [], "the first period is not scored"
    begun = record_of(np.concatenate(twice))
    assert periodic_segments(begun, 0) == []


# Settings.

COLUMNS = {"path": "a.csv", "input": "u", "output": "y"}
CONTRADICTIONS: dict[str, dict[str, Any]] = {}
CONTRADICTIONS["data.validation_fraction = 0"] = {"validation_fraction": 0.0}
CONTRADICTIONS["data.test_fraction = 1"] = {"test_fraction": 1.0}
CONTRADICTIONS["nothing is left to train on"] = {"validation_fraction": 0.5, "test_fraction": 0.5}
CONTRADICTIONS["data.split = random"] = {"split": "random"}
CONTRADICTIONS["one is missing"] = {"validation": [[0.0, 1.0]]}
CONTRADICTIONS["validation and test are stated as well"] = {"fold": 1, "split": "time"}
CONTRADICTIONS["there are 5 folds"] = {"fold": 5}
CONTRADICTIONS["data.folds"] = {"folds": 1}
CONTRADICTIONS["data.fold = -1"] = {"fold": -1}
CONTRADICTIONS["only one of them can be given"] = {"reference": "r", "controller": [1.0, 2.0]}
CONTRADICTIONS["data.controller"] = {"controller": [1.0]}
CONTRADICTIONS["is no PI"] = {"controller": [0.0, 1.0]}
CONTRADICTIONS["integral time"] = {"controller": [1.0, 0.0]}
CONTRADICTIONS["the same column twice"] = {"disturbance": ["d", "d"]}
CONTRADICTIONS["is an input too"] = {"disturbance": ["u"]}
CONTRADICTIONS["is an output too"] = {"disturbance": ["y"]}
CONTRADICTIONS["is the set point too"] = {"disturbance": ["r"], "reference": "r"}
CONTRADICTIONS["is the clock too"] = {"disturbance": ["t"], "time": "t"}
CONTRADICTIONS["names no column"] = {"disturbance": [""]}
CONTRADICTIONS["1 files of outputs, 0 expected"] = {"test_output_path": "b.csv"}
CONTRADICTIONS["start_up_samples"] = {"start_up_samples": -1}
CONTRADICTIONS["data.equilibrium"] = {"equilibrium": "median"}


@pytest.mark.parametrize(("words", "settings"), CONTRADICTIONS.items())
def test_settings_that_contradict_each_other_are_refused(
    words: str, settings: dict[str, Any]
) -> None:
    with pytest.raises(BadRequest) as caught:
        RecordedData(**COLUMNS, **settings)
    assert words in str(caught.value)


ALLOWED: list[dict[str, Any]] = []
ALLOWED.append({"validation_fraction": 0.6, "test_fraction": 0.6, "test_path": "b.csv"})
ALLOWED.append({"validation": [[0.0, 1.0]], "test": [[1.0, 2.0]]})
ALLOWED.append({"validation": [[0.0, 1.0]], "test_path": "b.csv"})
ALLOWED.append({"fold": 0, "folds": 2})
ALLOWED.append({"fold": 4})
ALLOWED.append({"controller": [-1.0, 0.5]})
ALLOWED.append({"disturbance": ["d", "e"], "time": "t"})


@pytest.mark.parametrize("settings", ALLOWED)
def test_settings_at_their_edges_are_taken(settings: dict[str, Any]) -> None:
    source = RecordedData(**COLUMNS, **settings)
    changed = {name: getattr(source, name) for name in settings}
    assert changed == settings


def split_words(settings: dict[str, Any], samples: int, shift: float) -> str:
    """Words on how a log is cut whose last fifth is shifted."""
    rng = np.random.default_rng(0)
    signal = rng.standard_normal(samples)
    signal[-samples // 5 :] += shift
    source = RecordedData(**COLUMNS, **settings)
    record = record_of(signal)
    cuts, words = source._split_logs([[record]])
    assert len(cuts) == 1
    return words


CUTS: list[tuple[dict[str, Any], int, float, str]] = []
CUTS.append(({}, 1000, 0.0, "in the order of time"))
BLOCKS_WORDS = "in 10 interleaved blocks, because its end is unlike its beginning"
CUTS.append(({}, 1000, 9.0, BLOCKS_WORDS))
CUTS.append(({}, 500, 9.0, BLOCKS_WORDS))
CUTS.append(({}, 499, 9.0, "in the order of time"))
CUTS.append(({"start_up_samples": 1}, 500, 9.0, "in the order of time"))
CUTS.append(({"split": "time"}, 1000, 9.0, "in the order of time"))
CUTS.append(({"split": "blocks"}, 1000, 0.0, "in 10 interleaved blocks"))
CUTS.append(({"test_path": "b.csv"}, 1000, 9.0, "in the order of time"))
CUTS.append(({"validation": [[0.0, 1.0]], "test": [[1.0, 2.0]]}, 1000, 0.0, "into named intervals"))


@pytest.mark.parametrize(("settings", "samples", "shift", "words"), CUTS)
def test_a_log_is_cut_in_blocks_where_they_are_long_enough(
    settings: dict[str, Any], samples: int, shift: float, words: str
) -> None:
    actual = split_words(settings, samples, shift)
    assert actual == words


def test_samples_that_are_left_out_are_counted() -> None:
    source = RecordedData(**COLUMNS, split="time", start_up_samples=10)
    _, words = source._split_logs([log_with_gap(95, 5, 3)])
    assert words == "in the order of time; 5 samples in stretches that are too short are left out"


# Logs of a closed loop.


def test_the_set_point_of_a_pi_obeys_its_law() -> None:
    rng = np.random.default_rng(0)
    r = rng.standard_normal(200)
    y = rng.standard_normal(200)
    r[0] = y[0]
    gain = 2.0
    integral_s = 0.5
    step_s = 0.1
    integral = 0.0
    inputs = []
    for error in r - y:
        inputs.append(3.0 + gain * (error + integral))
        integral += step_s / integral_s * error
    u = np.array(inputs)[:, None]
    log = Trajectory(u=u, y=y[:, None], step_s=step_s)
    found = reconstruct_pi_set_point(log, gain, integral_s)
    actual = found[:, 0]
    np.testing.assert_allclose(actual, r, atol=1e-9)


def test_a_pi_at_its_limits_is_refused_from_two_percent_on() -> None:
    for at_limit, is_refused in ((1, False), (2, True)):
        for sign in (1.0, -1.0):
            signal = np.linspace(-1, 1, 100)
            signal[:at_limit] = -2.0
            log = record_of(sign * signal)
            if is_refused:
                with pytest.raises(BadRequest, match="2%: is the share of samples at a limit"):
                    reconstruct_pi_set_point(log, 1.0, 1.0)
            else:
                reconstruct_pi_set_point(log, 1.0, 1.0)
    two = np.zeros((10, 2))
    with pytest.raises(BadRequest, match="of which a PI needs one each"):
        reconstruct_pi_set_point(Trajectory(u=two, y=two, step_s=0.1), 1.0, 1.0)


@pytest.mark.parametrize(("gain", "delay"), [(0.1, 0), (5.0, 7), (1.0, LAGS)])
def test_what_the_set_point_makes_of_an_input_is_found_exactly(gain: float, delay: int) -> None:
    rng = np.random.default_rng(1)
    samples = FEWEST * LAGS
    reference = rng.standard_normal((samples, 1))
    past = np.concatenate([np.repeat(reference[:1], delay, axis=0), reference])
    log = record_of(1.0 + gain * past[:samples, 0])
    (projected,), share = project_inputs_on_set_points([log], [reference])
    assert share == pytest.approx(1.0)
    np.testing.assert_allclose(projected.u, log.u, atol=1e-6 * gain)
    with pytest.raises(BadRequest, match="must be at least 600"):
        project_inputs_on_set_points([log[1:]], [reference[1:]])


def test_a_projected_input_stays_within_what_was_applied() -> None:
    rng = np.random.default_rng(2)
    reference = rng.standard_normal((700, 1))
    log = record_of(np.clip(reference[:, 0], -0.5, 0.5))
    (projected,), share = project_inputs_on_set_points([log], [reference])
    assert projected.u.max() == 0.5
    actual = projected.u.min()
    assert actual == -0.5
    assert 0.5 < share < 1.0
    constant = record_of(np.zeros(700))
    _, share = project_inputs_on_set_points([constant], [reference])
    assert share == 0.0


def test_an_equilibrium_is_stated_zero_or_the_mean() -> None:
    values = np.array([[1.0, 2.0], [3.0, 6.0]])
    source = RecordedData(**COLUMNS)
    mean = source._channel_equilibrium("input", values, None)
    assert mean.tolist() == [2.0, 4.0]
    stated = source._channel_equilibrium("input", values, [7.0, 8.0])
    assert stated.tolist() == [7.0, 8.0]
    about_zero = RecordedData(**COLUMNS, equilibrium="zero")
    zero = about_zero._channel_equilibrium("output", values, None)
    assert zero.tolist() == [0.0, 0.0]
    with pytest.raises(BadRequest, match=r"data\.output_equilibrium.*there are 2 channels"):
        source._channel_equilibrium("output", values, [7.0])
