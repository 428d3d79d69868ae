"""The servo of the rehearsals: its exact step against an integrator, its parameters found again,
test files closed."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hydra.errors import InstantiationException
from plants_cases import from_yaml
from scipy.integrate import solve_ivp

from ssm_study import extensions

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDER = REPOSITORY / "benchmarks" / "rehearsal"
BENCHMARKS = str(FOLDER.parent)
sys.path.append(BENCHMARKS)
from rehearsal.servo import Servo, fitted, tracked  # noqa: E402 - of a folder that `--with` names

SERVO = Servo(mass=95.0, viscous=200.0, coulomb=20.0, offset=-3.0, force_per_volt=35.0)
STEP_S = 1e-3
GAINS = (160.0, 243.0)


@pytest.fixture(autouse=True)
def _trusted(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Trust the rehearsal package for one test, as `--with benchmarks/rehearsal` does."""
    monkeypatch.setenv(extensions.FOLDER, str(FOLDER))
    extensions.trusted_packages.cache_clear()
    yield
    monkeypatch.undo()
    extensions.trusted_packages.cache_clear()


@pytest.fixture
def rehearsed(benchmark_data: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    monkeypatch.setenv("SSM_STUDY_DATA", str(benchmark_data))
    return lambda *overrides: from_yaml("data", "emps_rehearsed", *overrides)


def moves(samples: int) -> np.ndarray:
    """A reference there and back, with rests: 0.1 m in 1.5 s."""
    whole_turn = 2 * np.pi
    time_s = np.arange(samples) * STEP_S
    time_in_period = time_s % 4.0
    angle = whole_turn * time_in_period / 3.0
    cosine = np.cos(np.clip(angle, 0, whole_turn))
    return 0.05 * (1 - cosine)


VOLTAGES = [2.0, 0.3, -0.3, -2.0]


@pytest.mark.parametrize("volt", VOLTAGES)
def test_a_step_is_what_an_integrator_finds(volt: float) -> None:
    """From 0.05 m/s over half a second: it slows down, stops and sticks, or turns, as the voltage
    has it."""

    def motion(_: float, state: np.ndarray) -> list[float]:
        direction = state[1] / 1e-6
        friction = SERVO.coulomb * np.tanh(direction)
        driving_force = 35.0 * volt + 3.0
        viscous_force = 200.0 * state[1]
        difference = driving_force - viscous_force - friction
        return [state[1], difference / 95.0]

    span = (0.0, 0.5)
    start = [0.01, 0.05]
    route = solve_ivp(motion, span, start, method="Radau", rtol=1e-9, atol=1e-11)
    q, v = SERVO.step(0.01, 0.05, volt, 0.5)
    actual = [q, v]
    expected = route.y[:, -1]
    np.testing.assert_allclose(actual, expected, atol=2e-6)
    force_at_rest = 35.0 * volt + 3.0
    expected = abs(force_at_rest) <= 20.0
    assert (v == 0.0) == expected


def test_it_sticks_exactly_and_steps_add_up() -> None:
    servo = SERVO.step(0.2, 0.0, 0.4, 1.0)
    assert servo == (0.2, 0.0)
    q = 0.0
    v = -0.1
    for _ in range(100):
        q, v = SERVO.step(q, v, 2.0, 0.01)
    actual = (q, v)
    expected = SERVO.step(0.0, -0.1, 2.0, 1.0)
    np.testing.assert_allclose(actual, expected, rtol=1e-12)


def test_the_parameters_of_a_simulated_servo_are_found_again() -> None:
    no_load = np.zeros(8000)
    volt, position = tracked(SERVO, moves(8000), no_load, GAINS, STEP_S)
    servo = fitted(volt, position, STEP_S, 35.0)
    actual = (servo.mass, servo.viscous, servo.coulomb)
    expected = (95.0, 200.0, 20.0)
    np.testing.assert_allclose(actual, expected, rtol=0.02)
    expected_offset = pytest.approx(-3.0, abs=0.3)
    assert servo.offset == expected_offset


def test_the_servo_of_the_record_is_the_published_one(rehearsed) -> None:  # type: ignore[no-untyped-def]
    """Janot, Gautier & Brunot (2019): 95.1 kg, 203.5 N s/m, 20.4 N, -3.16 N; and it asks for the
    recorded voltage."""
    source = rehearsed()
    fine = source._build_record()
    tracked_record = source._build_record(output="qg")
    reference = tracked_record.y[:, 0]
    voltage = fine.u[:, 0]
    servo = fitted(voltage, fine.y[:, 0], fine.step_s, source.force_per_volt)
    actual = (servo.mass, servo.viscous, servo.coulomb)
    expected = (95.1, 203.5, 20.4)
    np.testing.assert_allclose(actual, expected, rtol=0.02)
    no_load = np.zeros(len(fine))
    gains = (source.kp, source.kv)
    volt, _ = tracked(servo, reference, no_load, gains, fine.step_s)
    difference = volt - voltage
    mean = np.mean(difference**2)
    assert np.sqrt(mean) < 0.1  # of 1.54 V


def test_a_rehearsal_opens_no_test_file_and_asks_more_than_the_training_record(rehearsed) -> None:  # type: ignore[no-untyped-def]
    source = rehearsed("experiments.test.0.path=nowhere.mat", "rehearsals=2")
    data = source.build(0)
    paths = source.data_files()
    names = [path.name for path in paths]
    assert names == ["DATA_EMPS.mat"]
    training_record = data.training[0]
    samples = len(training_record)
    expected = [samples] * 2
    lengths = [len(record) for record in data.test]
    assert lengths == expected
    largest_in_training = np.abs(data.training[0].u).max()
    assert all(np.abs(record.u).max() > 1.1 * largest_in_training for record in data.test)
    test_u = data.test[0].u
    other_test = data.test[1]
    assert not np.array_equal(test_u, other_test.u)
    test = source.build(1).test
    actual = test[1].y
    expected = data.test[1].y
    np.testing.assert_array_equal(actual, expected)


def test_no_rehearsal_is_refused() -> None:
    for wrong in ("rehearsals=0", "pulses=0"):
        problem = rf"data\.{wrong[:-2]} = 0"
        with pytest.raises(InstantiationException, match=problem):
            from_yaml("data", "emps_rehearsed", wrong)
