"""Names and units of the channels of a recording, from what a configuration states."""

from ssm_study.data.plain_names import plain_name
from ssm_study.refusal import require
from ssm_study.signals import Channel

Names = str | int | list[str] | list[int] | tuple[str, ...]


def as_name_tuple(names: Names) -> tuple[str, ...]:
    """Convert one or several column names, or column numbers, to a tuple of texts."""
    if isinstance(names, str | int):
        return (str(names),)
    return tuple(map(str, names))


def name_channels(
    names: Names, units: Names, side: str, has_separate_files: bool
) -> tuple[Channel, ...]:
    """Give the input, output or disturbance channels of a recording their names and units.
    Recordings store signals under plain names: `Motor voltage (V)` becomes `Motor_voltage_V`.

    A column number becomes a name with its side, such as `input_0`; so does every name in separate
    files, where two may be equal.
    """
    columns = as_name_tuple(names)
    stated_units = as_name_tuple(units)
    if stated_units == ("",):
        stated_units = ("",) * len(columns)
    has_all_units = len(stated_units) == len(columns)
    problem = f"there are {len(columns)} columns"
    require(has_all_units, f"data.{side}_unit", units, problem, "give one unit per column")
    plain = [plain_name(column) for column in columns]
    twice = [name for name in plain if plain.count(name) > 1]
    problem = f"two of them would be called {twice[0]}" if twice else ""
    column_list = ", ".join(columns)
    require(not twice, f"data.{side}", column_list, problem, "rename a column of the log")
    channels = []
    for name, unit in zip(plain, stated_units, strict=True):
        needs_side = has_separate_files or name[0].isdigit()
        full_name = f"{side}_{name}" if needs_side else name
        channel = Channel(name=full_name, unit=unit)
        channels.append(channel)
    return tuple(channels)
