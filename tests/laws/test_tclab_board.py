"""The example's plant on the board: paced, within 0 to 100 %, off however it ends; a fake board in
tclab's place."""

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

from ssm_study.cli.from_python import compose_configuration
from ssm_study.loop.peers.pi import PI
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.refusal import BadRequest
from ssm_study.study.specification import Specification

PACKAGE = Path(__file__).resolve().parents[2] / "examples" / "tclab_study"
STEP_S = 10.0


@dataclass
class FakeBoard:
    """A stand-in for `tclab.TCLab()`: the laboratory's own equation behind a heater, and the clock
    it goes by."""

    plant: Any
    now: float = 0.0
    sent: list[tuple[float, float]] = field(default_factory=list)
    closed: int = 0
    interrupted_at: float = np.inf

    def __post_init__(self) -> None:
        self.state = self.plant.equilibrium_states(np.array([[40.0]]))
        self.duty = 0.0

    def Q1(self, percent: float) -> float:
        self.duty = percent
        self.sent.append((self.now, percent))
        return percent

    def Q2(self, percent: float) -> float:
        return percent

    @property
    def T1(self) -> float:
        return float(self.plant.output(self.state)[0, 0])

    def close(self) -> None:
        self.closed += 1

    def sleep(self, seconds: float) -> None:
        if self.now + seconds > self.interrupted_at:
            raise KeyboardInterrupt
        self.now += seconds
        self.state = self.plant.next_states(self.state, np.array([[self.duty]]), np.zeros((1, 1)))


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    from tclab_study import board

    before = signal.getsignal(signal.SIGTERM)
    yield board
    board.release()
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def plant(board: ModuleType) -> Any:  # noqa: ARG001  which finds the package
    from tclab_study.laboratory import TemperatureLab

    tclab_path = PACKAGE / "tclab_study" / "conf" / "plant" / "tclab.yaml"
    text = tclab_path.read_text()
    settings = yaml.safe_load(text)
    return TemperatureLab(**{name: value for name, value in settings.items() if name != "_target_"})


@pytest.fixture
def fake(board: ModuleType, plant: Any, monkeypatch: pytest.MonkeyPatch) -> FakeBoard:
    made = FakeBoard(plant)
    package = ModuleType("tclab")
    clock = ModuleType("time")
    package.TCLab = lambda: made  # type: ignore[attr-defined]
    clock.monotonic = lambda: made.now
    clock.sleep = made.sleep  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tclab", package)
    monkeypatch.setattr(board, "time", clock)
    return made


def test_a_record_of_the_board_is_what_its_equation_gives_sample_by_sample(
    plant: Any, fake: FakeBoard
) -> None:
    """Two routes: the model simulated at once, and the board asked in real time; then the heater is
    off."""
    rng = np.random.default_rng(0)
    u = rng.uniform(0, 100, (2, 6, 1))
    changed_plant = replace(plant, hardware=True)
    _, y = changed_plant.simulate(u)
    start = plant.equilibrium_states(np.array([[40.0]]))
    response = plant.simulate(u.reshape(1, 12, 1), start)
    whole = response[1][0]
    actual = y.reshape(12, 1)
    np.testing.assert_allclose(actual, whole, rtol=1e-12)
    times, duties = np.array(fake.sent).T
    actual = times[:6]
    expected = STEP_S * np.arange(6)
    np.testing.assert_allclose(actual, expected)
    actual = duties[:6]
    expected = u[0, :, 0]
    np.testing.assert_allclose(actual, expected)
    assert fake.sent[-1][1] == 0
    assert fake.closed == 1


def test_a_pi_regulates_the_board_within_its_limits(plant: Any, fake: FakeBoard) -> None:
    real = replace(plant, hardware=True)
    law = PI.for_plant(real, gain=4.0, integral_s=200.0)
    reference = StepReference(before=8.0, after=-5.0, at_s=1000.0)
    asked = {"reference": reference, "horizon_s": 2000.0}
    loop = LoopExperiment(initial_conditions=1, input_lower=0.0, input_upper=100.0, **asked)
    loop_runs = loop.run_on_plant(real, law, seed=0)
    run = loop_runs.controlled
    duties = np.array(fake.sent)[:, 1]
    assert duties.min() >= 0
    assert duties.max() <= 100
    difference = np.abs(run.y - run.reference)
    largest = difference[0, -20:].max()
    assert largest < 0.5
    assert fake.duty == 0
    assert np.array_equal(run.y, run.measured)  # the board's noise is its own


@pytest.mark.parametrize("cause", [KeyboardInterrupt, ZeroDivisionError, SystemExit])
def test_the_heater_is_off_whatever_ends_it(cause: type, plant: Any, fake: FakeBoard) -> None:
    real = replace(plant, hardware=True)

    class Failing(PI):
        def next_memory(self, *asked: Any) -> Any:
            if len(fake.sent) == 3 and cause is not KeyboardInterrupt:
                raise cause
            return super().next_memory(*asked)

    fake.interrupted_at = 25.0 if cause is KeyboardInterrupt else np.inf
    law = Failing(gain=4.0, integral_s=200.0, input_equilibrium=40.0, step_s=STEP_S)
    loop = LoopExperiment(initial_conditions=1, horizon_s=200.0)
    with pytest.raises(cause):
        loop.simulate(real, law, np.array([[40.0]]), np.zeros((1, 20, 1)))
    assert len(fake.sent) == 4  # three samples, then off
    assert fake.sent[2][1] > 0
    assert fake.duty == 0
    assert fake.closed == 1


@pytest.mark.usefixtures("fake")
def test_a_request_to_terminate_ends_it_as_an_exception_does(plant: Any) -> None:
    changed_plant = replace(plant, hardware=True)
    changed_plant.equilibrium_states(np.zeros((1, 1)))
    with pytest.raises(SystemExit):
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.usefixtures("fake")
def test_without_a_board_it_is_refused_in_one_sentence(
    plant: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent() -> None:
        raise RuntimeError("No Arduino device found.")

    tclab = sys.modules["tclab"]
    monkeypatch.setattr(tclab, "TCLab", absent)
    said = (
        r"plant.hardware = True: no board answers \(No Arduino device found\); connect the board "
        r"and pip install tclab"
    )
    changed_plant = replace(plant, hardware=True)
    with pytest.raises(BadRequest, match=said):
        changed_plant.simulate(np.full((1, 3, 1), 40.0))
    monkeypatch.setitem(sys.modules, "tclab", None)
    changed_plant = replace(plant, hardware=True)
    with pytest.raises(BadRequest, match="no board answers"):
        changed_plant.equilibrium_states(np.zeros((1, 1)))


def test_many_cases_at_once_are_refused_before_anything_is_heated(
    plant: Any, fake: FakeBoard
) -> None:
    config = compose_configuration(["experiment=smoke"])
    known = Specification.from_config(config)
    changed_plant = replace(plant, hardware=True)
    asked = replace(known, plant=changed_plant)
    with pytest.raises(
        BadRequest, match=r"a device runs one case, from where it is; use loop.initial_conditions=1"
    ):
        asked.refuse_excessive_sizes()
    loop = replace(asked.loop, initial_conditions=1)
    one = replace(asked, loop=loop, data=replace(asked.data, trials=False))
    one.refuse_excessive_sizes()
    with pytest.raises(BadRequest, match="a board runs one case at a time"):
        asked.plant.next_states(np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 1)))
    assert not fake.sent
