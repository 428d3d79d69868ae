"""Single sines after the choice: the gain of one line, what noise hides is not zero, and a mismatch
that a broadband record dithers away refutes a prediction."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "oracles"))
from loop_cases import motor
from test_coverage import BALLS, MODEL, design, records, scaled_model

from ssm_study.bounds.frequency import frequency_response
from ssm_study.data.simulated import PERIOD, SINE_SHARES, simulate_sine_records
from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.robustness.prediction import predict
from ssm_study.robustness.sensitivity import sensitivity
from ssm_study.robustness.sine_trials import (
    SineMismatch,
    measure_sine_mismatch,
    peak_lines,
    with_sines,
)
from ssm_study.signals import Trajectory
from ssm_study.synthesis.sine_judgement import design_lines, sine_facts

SSM_MODEL = SSM.of(MODEL, 0.01)
FAST = design(input_weight=1e-3)
SHARE = 0.2
MISMATCH = measure_mismatch(SSM_MODEL, records(scaled_model(SHARE), noise=1e-3))


def sine(answer, line: int, amplitude: float, noise: float, seed: int = 0) -> Trajectory:
    wave = amplitude * np.sin(2 * np.pi * line * np.arange(PERIOD) / PERIOD)
    u = np.tile(wave[:, None], (3, 1))
    y = answer(u) + noise * np.random.default_rng(seed).standard_normal(u.shape)
    return Trajectory(u=u, y=y, step_s=0.01, name="sine")


@pytest.mark.parametrize("line", [5, 43, 128, 400])  # 128 repeats within a period, too
def test_a_sine_shows_the_gain_of_its_line(line: int) -> None:
    trial = sine(scaled_model(SHARE), line, 0.5, 1e-3)
    (measured,) = measure_sine_mismatch(SSM_MODEL, (trial,), MISMATCH, PERIOD)
    assert measured.angle == pytest.approx(2 * np.pi * line / PERIOD)
    assert measured.amplitude == pytest.approx(0.5 / np.sqrt(2), rel=1e-3)
    response = frequency_response(MODEL, np.array([measured.angle]))[0, 0, 0]
    exact = SHARE * abs(response)
    assert exact * 0.999 < measured.gain < 1.05 * exact + 1e-3


def test_what_noise_hides_is_not_zero() -> None:
    """Without any mismatch the limit is that of the noise, and an upper one nearly always."""
    trials = tuple(sine(scaled_model(0.0), 43, 0.01, 1e-3, seed) for seed in range(40))
    gains = [trial.gain for trial in measure_sine_mismatch(SSM_MODEL, trials, MISMATCH, PERIOD)]
    assert min(gains) > 0
    scale = 1e-3 / 0.01 * np.sqrt(2 / PERIOD)
    assert 0.3 * scale < np.median(gains) < 3 * scale
    small = tuple(sine(scaled_model(SHARE), 43, 0.01, 1e-3, seed) for seed in range(40))
    limits = [trial.gain for trial in measure_sine_mismatch(SSM_MODEL, small, MISMATCH, PERIOD)]
    exact = SHARE * abs(frequency_response(MODEL, np.array([2 * np.pi * 43 / PERIOD]))[0, 0, 0])
    assert np.mean(np.array(limits) > exact) > 0.9


def test_a_sine_that_shows_more_than_the_records_refutes_the_prediction() -> None:
    before = predict(SSM_MODEL, FAST.pair, BALLS, MISMATCH)
    assert before.predicts_stability()
    (line, *_) = peak_lines(SSM_MODEL, FAST.pair, BALLS, PERIOD)
    angle = 2 * np.pi * line / PERIOD
    loop = sensitivity(SSM_MODEL.linear, FAST.pair, 1.0, 1.0)
    peak = abs(frequency_response(loop, np.array([angle]))[0, 0, 0])
    harmful = SineMismatch(angle=angle, amplitude=0.3, gain=1.2 / peak)
    facts = sine_facts(FAST, SSM_MODEL, BALLS, MISMATCH, [harmful])
    assert facts["predicted_stable"] is False
    assert facts["sine_margin"] < 1
    harmless = replace(harmful, gain=1e-6)
    facts = sine_facts(FAST, SSM_MODEL, BALLS, MISMATCH, [harmless])
    assert facts == {"predicted_stable": True, "sine_margin": before.resolved_margin}
    assert sine_facts(FAST, SSM_MODEL, BALLS, MISMATCH, []) == {}


def test_a_sine_below_every_record_has_a_view_of_its_own() -> None:
    smallest = MISMATCH.views[0]
    tiny = SineMismatch(angle=0.3, amplitude=smallest.amplitude / 10, gain=5.0)
    views = with_sines(MISMATCH, [tiny]).views
    assert len(views) == len(MISMATCH.views) + 1
    assert views[0].amplitude == tiny.amplitude
    np.testing.assert_array_equal(views[1].by_frequency, smallest.by_frequency)
    assert np.interp(0.3, np.linspace(0, np.pi, 33), views[0].by_frequency) == pytest.approx(5.0)


def test_the_trials_lie_at_the_peaks_of_the_sensitivity() -> None:
    lines = peak_lines(SSM_MODEL, FAST.pair, BALLS, PERIOD)
    assert 1 <= len(lines) <= 2
    angles = 2 * np.pi * np.arange(4, PERIOD // 2) / PERIOD
    loop = sensitivity(SSM_MODEL.linear, FAST.pair, 1.0, 1.0)
    size = np.abs(frequency_response(loop, angles)[:, 0, 0])
    assert max(size[line - 4] for line in lines) > 0.99 * size.max()


def test_where_no_noise_is_known_nothing_is_tried() -> None:
    unknown = replace(MISMATCH, noise=())
    assert design_lines(FAST, SSM_MODEL, BALLS, unknown, PERIOD) == []
    assert len(design_lines(FAST, SSM_MODEL, BALLS, MISMATCH, PERIOD)) > 0


def test_the_simulated_sines_repeat_and_reach_down_to_a_hundredth() -> None:
    plant = motor()
    trials = simulate_sine_records(plant, np.random.default_rng(0), np.zeros(1), [43, 128])
    assert len(trials) == 2 * len(SINE_SHARES)
    assert min(SINE_SHARES) == 0.01
    for trial in trials:
        u = trial.u[:, 0]
        np.testing.assert_array_equal(u[PERIOD : 2 * PERIOD], u[2 * PERIOD :])
    largest = max(float(np.abs(trial.u - plant.equilibrium().u).max()) for trial in trials)
    assert largest == pytest.approx(plant.input_amplitude[0], rel=1e-3)
    assert simulate_sine_records(plant, np.random.default_rng(0), np.zeros(1), []) == ()
