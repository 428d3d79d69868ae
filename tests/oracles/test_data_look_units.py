"""The command that `look` proposes carries the units of the log."""

import shlex
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ssm_study.data.look import look

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import kind_named


@pytest.mark.parametrize("stated", [("V", "rad/s"), ("%", "m/s²")])
def test_units_that_a_log_states_stand_in_the_command(
    tmp_path: Path, stated: tuple[str, str]
) -> None:
    """A shell and the command read them back; a dash in the row of units is none."""
    table = kind_named("direction").log(0, samples=500)
    path = tmp_path / "log.csv"
    columns = "t;u;y;load"
    signals = table[["u", "y"]].to_numpy()
    rows = [f"{0.1 * k:.1f};{u:.5f};{y:.5f};{u * y:.5f}" for k, (u, y) in enumerate(signals)]
    path.write_text("\n".join([columns, f"s;{stated[0]};{stated[1]};-", *rows]), encoding="utf-8")
    command = look(path, input="u", output="y").command
    words = OverridesParser.create().parse_overrides(shlex.split(command)[2:])
    values = {word.key_or_group: word.value() for word in words}
    assert (values["data.input_unit"], values["data.output_unit"]) == stated
    assert "disturbance_unit" not in command
