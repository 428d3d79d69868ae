"""Words of the command that `ssm-study look` proposes: quoted values, and the units of the chosen
columns."""

import re
from collections.abc import Mapping, Sequence

from ssm_study.data.column_facts import ColumnFacts
from ssm_study.data.readers.reader import normalise_title, title_without_unit

LETTER = re.compile(r"[^\W\d_]|[%°]")  # what has none, such as a dash, names no unit


def unit_overrides(facts: Sequence[ColumnFacts], columns: Mapping[str, str | None]) -> list[str]:
    """Command-line overrides, such as `data.input_unit=V`, with the units that a log states for its
    signals. `columns` has the column of each side: input, output, disturbance."""
    titles = [column.name for column in facts]
    settings = []
    for side, name in columns.items():
        index = find_column_index(titles, name)
        unit = "" if index is None else facts[index].unit
        if LETTER.search(unit):
            settings.append(f"data.{side}_unit={quote_for_command(unit)}")
    return settings


def find_column_index(titles: Sequence[str], name: str | None) -> int | None:
    """Index of the column that a name or number on the command line stands for; None if there is no
    such column."""
    if name is None or name in titles:
        return None if name is None else titles.index(name)
    plain = [normalise_title(title_without_unit(title)) for title in titles]
    if normalise_title(name) in plain:
        return plain.index(normalise_title(name))
    return int(name) if name.isdigit() and int(name) < len(titles) else None


def quote_for_command(text: str) -> str:
    """Quote a text so that both the shell and Hydra's override grammar read it unchanged. Letters
    and digits need no quotes."""
    if re.fullmatch(r"[\w./:\-]+", text, re.ASCII):
        return text
    escaped_backslashes = text.replace("\\", "\\\\")
    escaped = escaped_backslashes.replace("'", "\\'")
    return f"\"'{escaped}'\""
