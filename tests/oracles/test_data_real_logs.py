"""Logs of other people as they lie in their repositories: read without conversion, and what `look`
says of them is what is known of the machines."""

from pathlib import Path

import numpy as np
import pytest

from ssm_study.data.look import LogLook, look
from ssm_study.data.recorded import RecordedData

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "logs_real"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/data/logs_real")
SIGNALS = {
    "heat_exchanger.dat": ("1", "2"),
    "house_heat_pump.csv": ("Ph", "Ti"),
    "propeller_bench.csv": ("Servo 3 (µs)", "Motor Optical Speed (RPM)"),
    "servo_position.csv": ("inputSignal(8bits)", "enconder(steps)"),
    "tanker_zigzag_10.dat": ("9", "8"),
    "tanker_zigzag_minus20.dat": ("9", "8"),
}
STEP_S = {
    "heat_exchanger.dat": 1.0,
    "house_heat_pump.csv": 3600.0,
    "propeller_bench.csv": 5.521,
    "servo_position.csv": 0.1,
    "tanker_zigzag_10.dat": 0.1353,
    "tanker_zigzag_minus20.dat": 0.1353,
}
SAMPLES = {"heat_exchanger.dat": 4000, "house_heat_pump.csv": 792, "servo_position.csv": 3000}
SAYS = {
    "heat_exchanger.dat": ["semicolons, no names", "counts the rows", "within the same sample"],
    "house_heat_pump.csv": ["nameless first column (dates)", "next sample", "measured too: Ta, Th"],
    "propeller_bench.csv": ["clock Time (s)", "99% of the samples interpolated"],
    "servo_position.csv": ["clock time(ms)", "integrator: the input explains 76%"],
    "tanker_zigzag_10.dat": ["2 lines of prose above", "times rounded to 1 s", "of the output's"],
    "tanker_zigzag_minus20.dat": ["tabs, no names", "times rounded to 1 s", "of the output's"],
}
SETTINGS = {
    "heat_exchanger.dat": ["model.feedthrough=true"],
    "servo_position.csv": ["model.integrating_output=true"],
}
KNOWN_SETTINGS = ("model.feedthrough=true", "model.integrating_output=true")


@pytest.fixture(scope="module")
def looks() -> dict[str, LogLook]:
    """Each log once, its input and output named as its source names them."""
    signals = SIGNALS.items()
    return {name: look(FOLDER / name, input=u, output=y) for name, (u, y) in signals}


@pytest.mark.parametrize("name", SIGNALS)
def test_the_plain_command_reads_it(name: str) -> None:
    """Input and output alone are named; the step is the machine's, and no value is invented."""
    u, y = SIGNALS[name]
    path = str(FOLDER / name)
    recorded_data = RecordedData(path=path, input=u, output=y)
    data = recorded_data.build(0)
    assert data.step_s == pytest.approx(STEP_S[name], rel=3e-4)
    records = (*data.training, *data.validation, *data.test)
    total = sum(len(record) for record in records)
    expected = SAMPLES.get(name, total)
    assert total == pytest.approx(expected, rel=0.002)
    assert all(np.isfinite(record.u).all() for record in records)


@pytest.mark.parametrize("name", SIGNALS)
def test_look_says_what_is_known(name: str, looks: dict[str, LogLook]) -> None:
    text = str(looks[name])
    for sentence in SAYS[name]:
        assert sentence in text
    assert "closed loop" not in text
    settings = SETTINGS.get(name, [])
    assert [words for words in KNOWN_SETTINGS if words in looks[name].command] == settings


@pytest.mark.parametrize("name", [name for name in SIGNALS if not name.startswith("tanker")])
def test_input_and_output_are_guessed(name: str, looks: dict[str, LogLook]) -> None:
    """The ship is left out: of its eleven nameless columns the input alone can be told."""
    guessed = look(FOLDER / name)
    assert (guessed.input, guessed.output) == SIGNALS[name]
    expected = looks[name].command
    assert guessed.command == expected


def test_the_rudder_is_guessed_among_nameless_columns() -> None:
    log_look = look(FOLDER / "tanker_zigzag_10.dat")
    assert log_look.input == "9"
