"""Simulated data sets: what is noisy, what is not, what repeats; and the way into the store and
back."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from plants_cases import choices, from_yaml

from ssm_study.cli.from_python import compose_configuration
from ssm_study.data.assembly import dataset_from_arrays, dataset_to_arrays
from ssm_study.data.simulated import TrainingAmplitudeWarning, simulate_mismatch_records
from ssm_study.signals import DataSet
from ssm_study.study.line import STUDY

SMALL = ("trajectories=3", "samples=200", "validation_samples=150", "test_samples=100")

TINY = ("trajectories=2", "samples=60", "validation_samples=40", "test_samples=40")


def built(seed: int = 0) -> DataSet:
    return from_yaml("data", "simulated", *SMALL).build(
        from_yaml("plant", "dc_motor"), from_yaml("excitation", "aprbs"), seed
    )


def test_parts_have_the_sizes_asked_for() -> None:
    data = built()
    expected = [200] * 3
    assert [len(r) for r in data.training] == expected
    expected = [150, 100]
    assert [len(r) for r in (*data.validation, *data.test)] == expected


def test_equal_seeds_give_equal_numbers_and_parts_differ() -> None:
    a = built(1)
    b = built(1)
    c = built(2)
    actual = a.training[0].y
    expected = b.training[0].y
    np.testing.assert_array_equal(actual, expected)
    training_y = a.training[0].y
    assert not np.array_equal(training_y, c.training[0].y)
    validation_u = a.validation[0].u
    test_u = a.test[0].u
    assert not np.array_equal(validation_u[:100], test_u)


def test_noise_has_the_variance_asked_for_and_the_test_record_has_none() -> None:
    data = built()
    plant = from_yaml("plant", "dc_motor")
    residuals = [r.y - plant.simulate(r.u[None])[1][0] for r in (*data.training, *data.validation)]
    assert np.var(np.concatenate(residuals)) == pytest.approx(
        0.02, rel=0.2
    )  # 750 samples: six sigma is 0.3
    actual = data.test[0].y
    test_u = data.test[0].u
    response = plant.simulate(test_u[None])
    expected = response[1][0]
    np.testing.assert_array_equal(actual, expected)


def test_scales_are_pure_gains_about_the_equilibrium() -> None:
    data = built()
    u = np.concatenate([r.u for r in data.training])
    scaled = data.scale.scaled_input(u)
    mean = np.mean(scaled**2)
    assert mean == pytest.approx(1.0)
    input_equilibrium = data.scale.input_equilibrium
    difference = input_equilibrium - input_equilibrium
    input_scale = data.scale.input_scale
    assert (difference / input_scale == 0).all()


def test_an_amplitude_of_the_excitation_moves_the_training_records_alone_and_says_so() -> None:
    small = from_yaml("excitation", "aprbs", "amplitude=1.0")
    plant = from_yaml("plant", "dc_motor")
    data = from_yaml("data", "simulated", *SMALL).build(plant, small, 0)
    usual = built()
    largest = max(np.abs(one.u).max() for one in data.training)
    assert largest <= 1.0
    mades = (data, usual)
    for one, other in zip(
        *([*made.validation, *made.test, *made.mismatch_records] for made in mades), strict=True
    ):
        np.testing.assert_array_equal(one.u, other.u)
    asked = compose_configuration(["experiment=smoke", "excitation.amplitude=1.0"])
    with pytest.warns(
        TrainingAmplitudeWarning,
        match="validation, test and trials are at the plant's own amplitude",
    ):
        STUDY.build_request(STUDY.settings(asked))
    with warnings.catch_warnings():
        warnings.simplefilter("error", TrainingAmplitudeWarning)
        dict_config = compose_configuration(["experiment=smoke"])
        STUDY.build_request(STUDY.settings(dict_config))


@pytest.mark.parametrize("plant", choices("plant"))
@pytest.mark.parametrize("excitation", choices("excitation"))
def test_every_plant_takes_every_excitation(plant: str, excitation: str) -> None:
    made = replace(
        from_yaml("data", "simulated", *TINY), trials=excitation == "aprbs"
    )  # they are not excited by it
    data = made.build(from_yaml("plant", plant), from_yaml("excitation", excitation), 0)
    output_scale = data.scale.output_scale
    assert np.isfinite(output_scale).all()
    assert (output_scale > 0).all()


def test_the_trials_reach_as_far_as_the_plant_is_driven() -> None:
    """Named by their shares of the plant's own amplitude, of which each has just so much."""
    plant = from_yaml("plant", "cascaded_tanks")
    rng = np.random.default_rng(0)
    deviation = np.zeros(1)
    mismatch_records = simulate_mismatch_records(plant, rng, deviation)
    driven = {
        t.name: np.abs(t.u - plant.equilibrium().u).max()
        for t in mismatch_records
        if "_at_" in t.name
    }
    shares = np.array([float(name.rpartition("_")[2]) for name in driven])
    assert shares.max() == 1
    whole = driven["trial_at_1"]
    assert 0.9 * plant.input_amplitude[0] < whole <= plant.input_amplitude[0]
    assert np.array([*driven.values()]) == pytest.approx(shares * whole)


def test_fresh_data_sets_are_like_the_first_and_none_of_them() -> None:
    plant = from_yaml("plant", "dc_motor")
    made = from_yaml("data", "simulated", *SMALL, "fresh_sets=2")
    own = made.build(plant, from_yaml("excitation", "aprbs"), 0)
    first, second = made.simulate_held_out_records(plant, 0)
    fresh_sets = made.simulate_held_out_records(plant, 0)
    again = next(fresh_sets)
    names = [record.name for record in own.mismatch_records]
    assert [record.name for record in first.mismatch_records] == names
    expected = len(own.validation[0])
    assert len(first.validation[0]) == expected
    actual = first.mismatch_records[0].y
    expected = again.mismatch_records[0].y
    np.testing.assert_array_equal(actual, expected)
    actual = first.validation[0].y
    expected = again.validation[0].y
    np.testing.assert_array_equal(actual, expected)
    for other in (own, second):
        validation_u = first.validation[0].u
        assert not np.array_equal(validation_u, other.validation[0].u)
        mismatch_records_u = first.mismatch_records[0].u
        assert not np.array_equal(mismatch_records_u, other.mismatch_records[0].u)
        decays = (first.mismatch_records[5], other.mismatch_records[5])
        name = decays[0].name
        assert name.startswith("decay")
        decays_y = decays[0].y
        assert not np.array_equal(decays_y, decays[1].y)  # the sensor's noise is its own


def test_tensors_round_trip_bit_for_bit() -> None:
    data = replace(built(), start_up_samples=3)
    test = tuple(replace(one, log=2)[5:] for one in data.test)
    data = replace(data, test=test)
    arrays, about = dataset_to_arrays(data)
    text = json.dumps(about)
    content = json.loads(text)
    again = dataset_from_arrays(arrays, content)
    for part in ("training", "validation", "test"):
        for a, b in zip(getattr(data, part), getattr(again, part), strict=True):
            assert a.u.tobytes() == b.u.tobytes()
            assert a.y.tobytes() == b.y.tobytes()
            assert a.step_s == b.step_s
            assert a.name == b.name
            assert a.log == b.log
            assert a.first == b.first
    assert again.inputs == data.inputs
    assert again.outputs == data.outputs
    assert again.metadata == data.metadata
    assert again.start_up_samples == 3
    actual = again.scale.output_scale
    expected = data.scale.output_scale
    np.testing.assert_array_equal(actual, expected)
