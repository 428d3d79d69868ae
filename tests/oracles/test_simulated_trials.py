"""Inputs and starts of the simulated records that measure the model error alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import motor

from ssm_study.data.experiments import find_record_file
from ssm_study.data.simulated import (
    DECAYS,
    FEWEST_SAMPLES,
    LEAD_IN,
    PERIOD,
    REST,
    RETURNS,
    SHARES,
    SINE_SHARES,
    SimulatedData,
    _broadband_input,
    simulate_mismatch_records,
    simulate_sine_records,
)
from ssm_study.refusal import BadRequest

QUIET = np.zeros(1)


def test_amplitudes_are_what_the_documentation_says() -> None:
    expected = (0.05, 0.1, 0.2, 0.5, 1.0)
    assert expected == SHARES
    expected = (0.01, 0.05, 0.2, 1.0)
    assert expected == SINE_SHARES
    expected = (-1.0, -0.5, 0.5, 1.0)
    assert expected == DECAYS
    expected = (-0.5, -0.25, 0.35, 0.7)
    assert expected == RETURNS
    expected = (1024, 256, 512)
    actual = (PERIOD, LEAD_IN, REST)
    assert actual == expected


def test_trials_repeat_then_rest_decays_rest_and_returns_are_lines() -> None:
    plant = motor()
    rng = np.random.default_rng(0)
    records = simulate_mismatch_records(plant, rng, QUIET)
    names = [record.name for record in records]
    driven = [f"trial_at_{share:g}" for share in SHARES]
    decays = [f"decay_from_{share:g}" for share in DECAYS]
    returns = [f"return_from_{share:g}" for share in RETURNS]
    expected = [*driven, *decays, *returns]
    assert names == expected
    rest = plant.equilibrium()
    by_name = {record.name: record for record in records}
    loudest = by_name["trial_at_1"].u - rest.u
    for share in SHARES:
        u = by_name[f"trial_at_{share:g}"].u - rest.u
        np.testing.assert_allclose(u, share * loudest)
        periods = u[LEAD_IN:-REST]
        first, second = periods.reshape(2, PERIOD, -1)
        np.testing.assert_array_equal(first, second)
        expected = first[-LEAD_IN:]
        actual = u[:LEAD_IN]
        np.testing.assert_array_equal(actual, expected)
        assert not u[-REST:].any()
    lowest, highest = plant.initial_range
    for share in DECAYS:
        record = by_name[f"decay_from_{share:g}"]
        assert (record.u == rest.u).all()
        reach = highest if share > 0 else -lowest
        expected = rest.y + share * np.asarray(reach)
        actual = record.y[0]
        np.testing.assert_allclose(actual, expected, atol=1e-6)
    amplitude = np.array(plant.input_amplitude)
    for share in RETURNS:
        u = by_name[f"return_from_{share:g}"].u - rest.u
        expected = np.full((PERIOD // 4, 1), share * amplitude)
        actual = u[: PERIOD // 4]
        np.testing.assert_allclose(actual, expected)
        assert not u[PERIOD // 2 :].any()
        slope = np.diff(u[PERIOD // 4 : PERIOD // 2], axis=0)
        expected = slope[:1] * np.ones_like(slope)
        np.testing.assert_allclose(slope, expected, atol=1e-9)


def test_sines_repeat_three_times_at_every_amplitude() -> None:
    plant = motor()
    rng = np.random.default_rng(0)
    records = simulate_sine_records(plant, rng, QUIET, [3, 8])
    expected = 2 * len(SINE_SHARES)
    assert len(records) == expected
    amplitude = plant.input_amplitude[0]
    for record, share in zip(records[:4], SINE_SHARES, strict=True):
        assert record.name == f"sine_3_at_{share:g}"
        u = record.u - plant.equilibrium().u
        assert len(u) == 3 * PERIOD
        power = np.abs(np.fft.rfft(u[:PERIOD, 0])) * 2 / PERIOD
        actual = int(power.argmax())
        assert actual == 3
        expected = pytest.approx(share * amplitude)
        assert power[3] == expected
    actual = simulate_sine_records(plant, rng, QUIET, [])
    assert actual == ()


@pytest.mark.parametrize("longest", [1, 2, 5])
def test_levels_are_held_no_longer_than_the_longest(longest: int) -> None:
    signal = _broadband_input(np.random.default_rng(1), longest)
    assert len(signal) == PERIOD
    actual = np.abs(signal).max()
    assert actual <= 1.0
    edges = np.flatnonzero(np.diff(signal, prepend=np.nan, append=np.nan))
    holds = np.diff(edges)
    assert holds.max() == longest
    assert holds.min() == 1


COUNTS = {"samples": 1, "validation_samples": 1, "test_samples": 1}
EDGES: list[tuple[str, float]] = []
EDGES.append(("trajectories", 1))
EDGES.append(("samples", FEWEST_SAMPLES))
EDGES.append(("validation_samples", FEWEST_SAMPLES))
EDGES.append(("test_samples", FEWEST_SAMPLES))
EDGES.append(("noise_variance", 0.0))
EDGES.append(("start_up_samples", 0))
EDGES.append(("fresh_sets", 0))


def simulated(**changes: Any) -> SimulatedData:
    """Settings of simulated data with some changed."""
    from ssm_study.data.excitations.multisine import Multisine

    scoring = object.__new__(Multisine)
    settings = {"trajectories": 2, **dict.fromkeys(COUNTS, FEWEST_SAMPLES)}
    return SimulatedData(scoring_excitation=scoring, **(settings | changes))


@pytest.mark.parametrize(("name", "smallest"), EDGES)
def test_settings_are_taken_from_their_smallest_value_on(name: str, smallest: float) -> None:
    taken = simulated(**{name: smallest})
    assert getattr(taken, name) == smallest
    below = type(smallest)(smallest - 1)
    with pytest.raises(BadRequest, match=f"data.{name}"):
        simulated(**{name: below})


def test_a_recording_is_found_by_its_name_or_in_either_format(tmp_path: Path) -> None:
    for name in ("log.MAT", "log.csv", "log.txt", "other.csv", "exact.dat"):
        (tmp_path / name).touch()
    actual = find_record_file(tmp_path, "log.txt").name
    assert actual == "log.txt"
    actual = find_record_file(tmp_path, "log").name
    assert actual == "log.MAT"
    actual = find_record_file(tmp_path, "other.mat").name
    assert actual == "other.csv"
    with pytest.raises(BadRequest, match="has no third"):
        find_record_file(tmp_path, "third")
    with pytest.raises(BadRequest, match="has no exact"):
        find_record_file(tmp_path, "exact")
