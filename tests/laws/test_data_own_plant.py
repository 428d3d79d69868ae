"""`ssm-study excite`: what it promises of the input holds of the file, for any limits."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.cli.main import main
from ssm_study.data.excitations.user_excitation import (
    AMPLITUDES,
    PERIOD_IN_SETTLINGS,
    PERIODS,
    SINE_AMPLITUDES,
    IdentificationExperiment,
)
from ssm_study.data.recorded import RecordedData
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest
from ssm_study.robustness.coverage import measure_error_spectra
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.return_to_rest import is_return_to_rest
from ssm_study.signals import DataSet, Scale
from ssm_study.study.run_files import RunFiles
from ssm_study.systems import StateSpace

LEVEL = st.floats(-1e3, 1e3)
WIDTH = st.floats(0.1, 1e3)
SHARE = st.floats(0.05, 0.95)
STEP_S = st.floats(0.001, 10.0)
SETTLING = st.integers(20, 200)
SEED = st.integers(0, 9)


@given(LEVEL, WIDTH, SHARE, STEP_S, SETTLING, SEED)
def test_the_signal(
    lower: float, width: float, share: float, step_s: float, samples: int, seed: int
) -> None:
    upper = lower + width
    rest = lower + share * width
    settle_s = samples * step_s * (1 + 1e-9)
    limits = {"lower": lower, "upper": upper, "rest": rest}
    times = {"step_s": step_s, "settle_s": settle_s}
    record = IdentificationExperiment(**limits, **times, seed=seed)
    u = record.input_signal()
    smallest = u.min()
    assert lower <= smallest < u.max() <= upper
    last_samples = u[-2 * samples :]
    assert (last_samples == rest).all()
    first_samples = u[: 2 * samples]
    assert (first_samples == rest).all()
    parts = len(AMPLITUDES)
    at_rest = 2 * samples * (parts + 1)
    signal_samples = len(u) - at_rest
    period = signal_samples // (PERIODS * parts)
    reaches = []
    for part in range(parts):
        samples_at_rest = 2 * samples * (part + 1)
        start = samples_at_rest + part * PERIODS * period
        middle = start + period
        first = u[start:middle]
        again = u[middle : middle + period]
        assert np.array_equal(first, again)
        values = np.unique(first)
        assert len(values) > 30
        difference = np.abs(first - rest)
        largest_difference = difference.max()
        reaches.append(largest_difference)
    expected = sorted(reaches, reverse=True)
    assert reaches == expected


SIGNAL = {"lower": -1.0, "upper": 3.0, "rest": 1.0}
TIMES = {"step_s": 0.1, "settle_s": 3.0}
EQUILIBRIA = {"input_equilibrium": [1.0], "output_equilibrium": [0.0]}
READING = {"input": "u", "output": "y", "step_s": 0.1}


def read_log(path: Path, u: np.ndarray, y: np.ndarray) -> DataSet:
    """Write a log of the record and read it with its equilibrium."""
    table = pd.DataFrame({"u": u, "y": y})
    table.to_csv(path, index=False)
    options = READING | EQUILIBRIA
    recorded_data = RecordedData(path=str(path), start_up_samples=20, **options)
    return recorded_data.build(0)


def lag_model(gain: float) -> SSM:
    """The lag of pole 0.8 with this input gain, at rest at input one."""
    a = np.array([[0.8]])
    b = np.array([[gain]])
    c = np.eye(1)
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    unit_scale = Scale.identity(1, 1)
    input_equilibrium = np.ones(1)
    scale = replace(unit_scale, input_equilibrium=input_equilibrium)
    return SSM.from_linear(linear, 0.1, scale)


def log_of(folder: Path, *more: float) -> DataSet:
    """The log of a lag driven by the record, with noise; `more` inputs follow before the last
    rest."""
    own = IdentificationExperiment(**SIGNAL, **TIMES)
    added_levels = np.repeat(more, 10)
    rest_samples = 60 * bool(more)
    added_rest = np.full(rest_samples, 1.0)
    u = np.concatenate([own.input_signal(), added_levels, added_rest])
    deviation = u - 1
    filtered_signal = scipy.signal.lfilter([0, 0.2], [1, -0.8], deviation)
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(len(u))
    y = filtered_signal + 0.05 * white_noise
    return read_log(folder / "log.csv", u, y)


def test_its_log_shows_the_mismatch_at_each_amplitude_with_the_noise_told_apart(
    tmp_path: Path,
) -> None:
    """A model with three quarters of the gain misses a third of its own output, whatever the
    noise."""
    data = log_of(tmp_path)
    model = lag_model(0.15)
    records = (data.validation, data.start_up_samples, data.mismatch_records)
    mismatch = measure_model_error(model, *records)
    assert len(mismatch.views) == len(AMPLITUDES)
    amplitudes = [view.amplitude for view in mismatch.views]
    relative = np.divide(amplitudes, amplitudes[-1])
    expected = sorted(AMPLITUDES)
    np.testing.assert_allclose(relative, expected, rtol=0.25)
    for view in mismatch.views:
        gains = np.abs(view.linear[1:5])
        np.testing.assert_allclose(gains, 1 / 3, rtol=0.15)
    assert mismatch.plant_comes_to_rest


HIDDEN = (0.3, 0.9)  # rad/sample


def log_with_sines(folder: Path, hidden: float) -> DataSet:
    """The log of a lag behind a filter of gain `1 + hidden` at the first of two frequencies, driven
    by the record with sines at both."""
    own = IdentificationExperiment(**SIGNAL, **TIMES, sines=HIDDEN)
    u = own.input_signal()
    moved = u - 1
    frequency = HIDDEN[0] / np.pi
    resonant = scipy.signal.iirpeak(frequency, 30)
    resonance = scipy.signal.lfilter(*resonant, moved)
    moved = moved + hidden * resonance
    y = scipy.signal.lfilter([0, 0.2], [1, -0.8], moved)
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(len(y))
    y += 0.002 * white_noise
    return read_log(folder / "log.csv", u, y)


@pytest.mark.parametrize("hidden", [0.0, 1.0])
def test_its_sines_raise_the_mismatch_at_their_frequency_alone(
    tmp_path: Path, hidden: float
) -> None:
    """A narrow resonance that random levels average over: the sine there meets all of it, in the
    mismatch and in the premise of the coverage."""
    data = log_with_sines(tmp_path, hidden)
    model = lag_model(0.2)
    records = (data.validation, data.start_up_samples, data.mismatch_records)
    mismatch = measure_model_error(model, *records)
    views = mismatch.views
    point = np.exp(1j * HIDDEN[0])
    lag = np.abs(0.2 / (point - 0.8))
    last_line = len(views[0].by_frequency) - 1
    near = round(HIDDEN[0] / np.pi * last_line)
    near_the_sine = [view.by_frequency[near] for view in views]
    is_visible = max(near_the_sine) > 0.9 * lag
    assert is_visible == bool(hidden)
    assert len(views) == len(AMPLITUDES) + 1  # the smallest sines are below all levels
    validation, *others = records
    premise = measure_error_spectra(model, validation, mismatch, *others)
    assert len(premise.repeating) == len(AMPLITUDES)
    number_of_sines = len(HIDDEN) * len(SINE_AMPLITUDES)
    assert len(premise.sines) == number_of_sines
    ratios: dict[str, float] = {}
    for item in premise.requirements(0.0):
        is_sine = item.place.startswith("one sine")
        model_power = item.model_power.sum()
        if is_sine and model_power > 0:
            ratio = np.sqrt(item.seen / model_power)
            largest_so_far = ratios.get(item.place, 0.0)
            ratios[item.place] = max(largest_so_far, ratio)
    assert ratios["one sine at 0.90 rad/sample"] < 0.1
    is_missed = ratios["one sine at 0.30 rad/sample"] > 0.5
    assert is_missed == bool(hidden)


def test_equal_pulses_in_another_log_do_not_stand_for_it(tmp_path: Path) -> None:
    data_set = log_of(tmp_path, 0.5, 2.0, 1.5)
    trials = data_set.mismatch_records
    in_motion = [trial for trial in trials if not is_return_to_rest(trial)]
    assert in_motion == []


def test_the_command_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "input.csv"
    limits = ["--lower", "0", "--upper", "100", "--rest", "40"]
    times = ["--step-s", "0.5", "--settle-s", "60"]
    command = ["excite", "--to", str(path), *limits, *times]
    assert main(command) == 0
    table = pd.read_csv(path)
    expected = ["time_s", "input"]
    assert list(table) == expected
    differences = np.diff(table["time_s"])
    assert np.allclose(differences, 0.5)
    assert "rest 40" in capsys.readouterr().out


def test_a_first_log_gives_what_is_not_given(smoke_run: Path, tmp_path: Path) -> None:
    """Its own range with rest, its sampling time, and holds that its model's response asks for."""
    file = tmp_path / "input.csv"
    run_files = RunFiles(path=smoke_run, record={})
    excitation = run_files.next_excitation_settings
    command = ["excite", "--to", str(file), "--after", str(smoke_run)]
    assert main(command) == 0
    table = pd.read_csv(file)
    smallest = table["input"].min()
    largest = table["input"].max()
    rest = excitation["rest"]
    assert excitation["lower"] <= smallest < rest
    assert rest < largest <= excitation["upper"]
    differences = np.diff(table["time_s"])
    assert np.allclose(differences, excitation["step_s"])
    settlings_per_amplitude = PERIODS * PERIOD_IN_SETTLINGS + 2
    settlings = 2 + len(AMPLITUDES) * settlings_per_amplitude
    step_s = excitation["step_s"]
    samples_per_settling = round(excitation["settle_s"] / step_s)
    of_levels = settlings * samples_per_settling
    angles = run_files.sine_frequencies
    assert 1 <= len(angles) <= 3
    signal = table["input"].to_numpy()
    last = signal[of_levels:] - rest
    spectrum = np.fft.rfft(last)
    loudest_line = np.argmax(np.abs(spectrum))
    loudest = 2 * np.pi * loudest_line / len(last)
    deviations = [abs(loudest / angle - 1) for angle in angles]
    assert min(deviations) < 0.15
    actual = main([*command, "--upper", "1"])
    assert actual == 0
    table = pd.read_csv(file)
    largest = table["input"].max()
    assert largest <= 1


def test_without_a_log_each_number_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    input_path = str(tmp_path / "input.csv")
    words = ["excite", "--to", input_path, "--lower", "0", "--rest", "1"]
    assert main(words) == 2
    need = "it is needed when no earlier run is named; give it, or --after RUN"
    message = capsys.readouterr().err
    assert f"--upper = not given: {need}" in message


STRICTLY_BETWEEN = "rest must lie strictly between"
REFUSED_LEVELS = [({"rest": 5.0}, STRICTLY_BETWEEN), ({"upper": math.inf}, STRICTLY_BETWEEN)]
TOO_FEW_SAMPLES = "fewer than twenty samples, too few to see its dynamics; sample faster"
REFUSED_TIMES = [
    ({"settle_s": math.inf}, "settle_s = inf: must be positive and finite"),
    ({"step_s": 0.0}, "must be positive"),
    ({"settle_s": 1.9}, TOO_FEW_SAMPLES),
]
SOUND_LEVELS = {"lower": -1.0, "upper": 1.0, "rest": 0.0}
SOUND_TIMES = {"step_s": 0.1, "settle_s": 5.0}


@pytest.mark.parametrize(("changed", "words"), [*REFUSED_LEVELS, *REFUSED_TIMES])
def test_refusals(changed: dict[str, float], words: str) -> None:
    sound = SOUND_LEVELS | SOUND_TIMES
    with pytest.raises(BadRequest, match=words):
        IdentificationExperiment(**(sound | changed))
