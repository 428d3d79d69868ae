"""Columns of a log besides its input, output and clock: possible set points, and possible measured
disturbances."""

from collections.abc import Sequence

from ssm_study.data.column_facts import ColumnFacts
from ssm_study.data.command_words import find_column_index, quote_for_command
from ssm_study.data.signal_guess import is_set_point_title

MOST_NAMED = 4  # columns that move besides input and output, by name in the sentence on them


def set_point_names(facts: Sequence[ColumnFacts], taken: Sequence[str | None]) -> list[str]:
    """Names of the varying columns of a log whose titles suggest a set point; `taken` columns are
    something else."""
    names = [fact.name for fact in facts if fact.levels > 1 and is_set_point_title(fact.name)]
    return [name for name in names if name not in taken]


def set_point_sentences(names: Sequence[str]) -> list[str]:
    """Sentence on columns of a log whose titles suggest a set point; none if there are none."""
    if not names:
        return []
    settings = " or ".join(f"data.reference={quote_for_command(name)}" for name in names)
    return [f"named like a set point: if a controller made the input, state {settings}"]


def possible_disturbance_names(
    facts: Sequence[ColumnFacts], clock: str | None, signals: Sequence[str | None]
) -> list[str]:
    """Names of the varying columns of a log other than input, output and time."""
    titles = [column.name for column in facts]
    places = [find_column_index(titles, name) for name in (*signals, clock)]
    others = [column for k, column in enumerate(facts) if k not in places]
    moving = [column.name for column in others if column.levels > 1]
    return [name for name in moving if not is_set_point_title(name)]


def possible_disturbance_sentences(names: Sequence[str]) -> list[str]:
    """Sentence that lists the columns of a log that may be measured disturbances."""
    if not names:
        return []
    named = ", ".join(names[:MOST_NAMED])
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return [
        f"measured too: {named}{more}; what moves the output and is not commanded belongs in "
        "data.disturbance=[COLUMN]"
    ]
