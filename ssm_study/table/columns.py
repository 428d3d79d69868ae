"""Columns of the results table `runs.parquet`, collected from the modules that declare them.

First which run it is, then what was requested, then the results, room by room, and last the
circumstances.
"""

from collections.abc import Iterable, Iterator
from difflib import get_close_matches

import pandas as pd

from ssm_study.bounds import metrics as bounds
from ssm_study.columns import Column
from ssm_study.data import metrics as data
from ssm_study.engine import metrics as engine
from ssm_study.evidence import metrics as evidence
from ssm_study.loop import metrics as loop
from ssm_study.models import metrics as models
from ssm_study.plants import metrics as plants
from ssm_study.synthesis import metrics as synthesis
from ssm_study.training import metrics as training

PARTS = {
    "Plant": plants,
    "Data": data,
    "Model": models,
    "Training": training,
    "Slopes and linear part": bounds,
    "Evidence": evidence,
    "Design": synthesis,
    "Closed loop": loop,
}
OF_THE_LINE = tuple(column for room in PARTS.values() for column in room.COLUMNS)
SETTINGS = tuple(column for column in OF_THE_LINE if column.setting)
RESULTS = tuple(column for column in OF_THE_LINE if not column.setting)
# `plant__step_s`: what no other column repeats
FURTHER = Column("*__*", None, word="Any other setting of the command", setting="*")
DECLARED = (*engine.IDENTITY, *SETTINGS, FURTHER, *RESULTS, *engine.CIRCUMSTANCES)
COLUMNS = tuple(column for column in DECLARED if not column.is_pattern)
BY_NAME = {column.name: column for column in COLUMNS}
PATTERNS = tuple(column for column in DECLARED if column.is_pattern)


def find_declaration(name: str) -> Column | None:
    """Find the declaration of the table column with a given name; None for an undeclared column."""
    if name in BY_NAME:
        return BY_NAME[name]
    matching = (column for column in PATTERNS if column.matches_name(name))
    return next(matching, None)


def column_label(name: str) -> str:
    """Printed name of a table column with its unit.

    For instance `Mean settling time (s)` for `settling_time_mean_s`, and `Benchmark score 2` for
    `score_test_2`.
    """
    if name in BY_NAME:
        return BY_NAME[name].label
    column = find_declaration(name)
    if column is not None and column.word and not column.setting:
        prefix = column.name.removesuffix("*")
        return f"{column.label} {name.removeprefix(prefix)}"
    return setting_path(name) or name.replace("_", " ")


def setting_path(name: str) -> str:
    """Dotted path of the setting that a table column holds, such as `plant.step_s`; empty if the
    column holds none."""
    if FURTHER.matches_name(name):
        return name.replace("__", ".")
    return BY_NAME[name].setting if name in BY_NAME else ""


def setting_columns(table: pd.DataFrame) -> list[str]:
    """Names of the columns of a results table that hold settings of the configuration."""
    declared_names = [column.name for column in SETTINGS]
    further_names = (name for name in map(str, table) if FURTHER.matches_name(name))
    further = sorted(further_names)
    names = [*declared_names, *further]
    return [name for name in names if name in table and name != "rates_chosen"]


def group_by_part(names: Iterable[str]) -> dict[str, list[str]]:
    """Group the names of table columns by the part of the study, such as model or controller.

    Settings come first, what no part declares last.
    """
    titles = {FURTHER.name: "Settings"}
    for title, room in PARTS.items():
        for column in room.COLUMNS:
            titles[column.name] = "Settings" if column.setting else title
    titles_of_parts = ("Settings", *PARTS, "Circumstances")
    parts: dict[str, list[str]] = {title: [] for title in titles_of_parts}
    for name in names:
        declaration = find_declaration(name)
        declared_name = getattr(declaration, "name", name)
        parts[titles.get(declared_name, "Circumstances")].append(name)
    return parts


def suggest_column(name: str, names: Iterable[str]) -> str:
    """Suggestion for a misspelt column name: the nearest names, or how to list all of them."""
    half_of_the_letters = 0.5
    candidates = list(names)
    near = get_close_matches(name, candidates, n=3, cutoff=half_of_the_letters)
    if near:
        return f"did you mean {' or '.join(near)}?"
    return "`ssm-study show STUDY --columns` lists them"


def describe_columns(table: pd.DataFrame | None = None) -> Iterator[tuple[str, str, str, str]]:
    """Description of each table column: name, printed name, better direction, and way of
    verification.

    All columns, or those that have values in the table.
    """
    with_values = DECLARED
    undeclared: list[str] = []
    if table is not None:
        filled = [str(name) for name in table if table[name].notna().any()]
        with_values = tuple(column for column in DECLARED if any(map(column.matches_name, filled)))
        undeclared = [str(name) for name in table if find_declaration(str(name)) is None]
    for column in with_values:
        unchecked = column.unchecked and f"not checked: {column.unchecked}"
        yield (column.name, column.label, column.better, unchecked)
    for name in sorted(undeclared):
        yield (name, "declared nowhere", "", "")


def requested_values(table: pd.DataFrame, name: str) -> pd.Series:
    """Values of a setting as each run requested them. A contraction rate that the program chose
    itself reads as the word `auto`."""
    if not name.startswith("rate_"):
        return table[name]
    side = name.removeprefix("rate_")
    chosen_rates = text_column(table, "rates_chosen")
    is_chosen = chosen_rates.str.contains(side)
    values = table[name].astype(object)
    return values.mask(is_chosen, "auto")


def swept_settings(table: pd.DataFrame) -> list[str]:
    """Settings in which the runs of a study differ, sorted by their number of values, with the seed
    last."""
    settings = setting_columns(table)
    names = [name for name in ("study", *settings) if name in table]
    counts = {name: requested_values(table, name).nunique() for name in names}
    varied = [name for name, count in counts.items() if count > 1]
    return sorted(varied, key=lambda name: (name == "seed", -counts[name]))


def numeric_column(table: pd.DataFrame, name: str) -> pd.Series:
    """Column of a results table as numbers, NaN where values are missing.

    So that a table of failures can be ranked and drawn too.
    """
    if name not in table:
        return pd.Series(float("nan"), index=table.index, name=name, dtype=float)
    numbers = pd.to_numeric(table[name], errors="coerce")
    return numbers.astype(float)


def boolean_column(table: pd.DataFrame, name: str) -> pd.Series:
    """Column of a results table as truth values, false where values are missing."""
    numbers = numeric_column(table, name)
    return numbers.fillna(0.0) > 0


def text_column(table: pd.DataFrame, name: str) -> pd.Series:
    """Column of a results table as texts, empty where values are missing."""
    if name not in table:
        return pd.Series("", index=table.index, name=name, dtype=str)
    texts = table[name].astype("string")
    return texts.fillna("").astype(str)
