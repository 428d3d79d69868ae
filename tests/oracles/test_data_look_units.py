"""The command that `look` proposes carries the units of the log."""

import shlex
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ssm_study.data.look import look

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import kind_named

UNITS = [("V", "rad/s"), ("%", "m/s²")]


@pytest.mark.parametrize("stated", UNITS)
def test_units_that_a_log_states_stand_in_the_command(
    tmp_path: Path, stated: tuple[str, str]
) -> None:
    """A shell and the command read them back; a dash in the row of units is none."""
    table = kind_named("direction").log(0, samples=500)
    path = tmp_path / "log.csv"
    columns = "t;u;y;load"
    names = ["u", "y"]
    signal_array_and_names = table[names]
    signals = signal_array_and_names.to_numpy()
    rows = [f"{0.1 * k:.1f};{u:.5f};{y:.5f};{u * y:.5f}" for k, (u, y) in enumerate(signals)]
    row_of_units = f"s;{stated[0]};{stated[1]};-"
    lines = [columns, row_of_units, *rows]
    content = "\n".join(lines)
    path.write_text(content, encoding="utf-8")
    proposal = look(path, input="u", output="y")
    command = proposal.command
    parser = OverridesParser.create()
    arguments = shlex.split(command)
    words = parser.parse_overrides(arguments[2:])
    values = {word.key_or_group: word.value() for word in words}
    units = (values["data.input_unit"], values["data.output_unit"])
    assert units == stated
    assert "disturbance_unit" not in command
