"""Logs of other people as they lie in their repositories: read without conversion, and what `look`
says of them is what is known of the machines."""

import json
from pathlib import Path

import numpy as np
import pytest
from recorded import assert_as_recorded

from ssm_study.data.look import LogOverview, look
from ssm_study.data.recorded import RecordedData

SHARED = Path(__file__).parents[3] / "shared"
FOLDER = SHARED / "data" / "logs_real"
IS_MISSING = not FOLDER.is_dir()
pytestmark = pytest.mark.skipif(IS_MISSING, reason="needs ../shared/data/logs_real")
TANKER_LOGS = ("tanker_zigzag_10.dat", "tanker_zigzag_minus20.dat")
SIGNALS = {
    "heat_exchanger.dat": ("1", "2"),
    "house_heat_pump.csv": ("Ph", "Ti"),
    "propeller_bench.csv": ("Servo 3 (µs)", "Motor Optical Speed (RPM)"),
    "servo_position.csv": ("inputSignal(8bits)", "enconder(steps)"),
}
GUESSED = tuple(SIGNALS)
SIGNALS |= dict.fromkeys(TANKER_LOGS, ("9", "8"))
STEP_S = {
    "heat_exchanger.dat": 1.0,
    "house_heat_pump.csv": 3600.0,
    "propeller_bench.csv": 5.521,
    "servo_position.csv": 0.1,
}
STEP_S |= dict.fromkeys(TANKER_LOGS, 0.1353)
SAMPLES = {"heat_exchanger.dat": 4000, "house_heat_pump.csv": 792, "servo_position.csv": 3000}
OF_HEAT_EXCHANGER = ["semicolons, no names", "counts the rows", "within the same sample"]
OF_HEAT_PUMP = ["nameless first column (dates)", "next sample", "measured too: Ta, Th"]
OF_PROPELLER = ["clock Time (s)", "99% of the samples interpolated"]
OF_SERVO = ["clock time(ms)", "integrator: the input explains 76%"]
OF_TANKERS = ["times rounded to 1 s", "of the output's"]
SAYS = {
    "heat_exchanger.dat": OF_HEAT_EXCHANGER,
    "house_heat_pump.csv": OF_HEAT_PUMP,
    "propeller_bench.csv": OF_PROPELLER,
    "servo_position.csv": OF_SERVO,
    "tanker_zigzag_10.dat": ["2 lines of prose above", *OF_TANKERS],
    "tanker_zigzag_minus20.dat": ["tabs, no names", *OF_TANKERS],
}
SETTINGS = {
    "heat_exchanger.dat": ["model.feedthrough=true"],
    "servo_position.csv": ["model.integrating_output=true"],
}
KNOWN_SETTINGS = ("model.feedthrough=true", "model.integrating_output=true")


@pytest.fixture(scope="module")
def looks() -> dict[str, LogOverview]:
    """Each log once, its input and output named as its source names them."""
    outcomes = {}
    for name, (u, y) in SIGNALS.items():
        outcomes[name] = look(FOLDER / name, input=u, output=y)
    return outcomes


@pytest.mark.parametrize("name", SIGNALS)
def test_the_plain_command_reads_it(name: str) -> None:
    """Input and output alone are named; the step is the machine's, and no value is invented."""
    u, y = SIGNALS[name]
    path = str(FOLDER / name)
    recorded_data = RecordedData(path=path, input=u, output=y)
    data = recorded_data.build(0)
    step_s = STEP_S[name]
    assert data.step_s == pytest.approx(step_s, rel=3e-4)
    records = (*data.training, *data.validation, *data.test)
    lengths = [len(record) for record in records]
    total = sum(lengths)
    expected = SAMPLES.get(name, total)
    assert total == pytest.approx(expected, rel=0.002)
    for record in records:
        assert np.isfinite(record.u).all()


@pytest.mark.parametrize("name", SIGNALS)
def test_look_says_what_is_known(name: str, looks: dict[str, LogOverview]) -> None:
    log_look = looks[name]
    text = str(log_look)
    for sentence in SAYS[name]:
        assert sentence in text
    assert "closed loop" not in text
    settings = SETTINGS.get(name, [])
    command = log_look.command
    assert [words for words in KNOWN_SETTINGS if words in command] == settings


@pytest.mark.parametrize("name", GUESSED)
def test_input_and_output_are_guessed(name: str, looks: dict[str, LogOverview]) -> None:
    """The ship is left out: of its eleven nameless columns the input alone can be told."""
    guessed = look(FOLDER / name)
    u, y = SIGNALS[name]
    assert guessed.input == u
    assert guessed.output == y
    expected = looks[name].command
    assert guessed.command == expected


def test_the_rudder_is_guessed_among_nameless_columns() -> None:
    log_look = look(FOLDER / "tanker_zigzag_10.dat")
    assert log_look.input == "9"


def test_the_looks_are_the_recorded_ones(looks: dict[str, LogOverview]) -> None:
    lines = {name: str(overview).splitlines() for name, overview in looks.items()}
    text = json.dumps(lines).replace(str(FOLDER), "FOLDER")
    assert_as_recorded("real_logs", json.loads(text), 1e-3)
