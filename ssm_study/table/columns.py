"""The columns of `runs.parquet`, collected from the rooms that declare them, in the order of the
line.

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

PARTS = {"Plant": plants, "Data": data, "Model": models, "Training": training,
         "Slopes and linear part": bounds,
         "Evidence": evidence, "Design": synthesis, "Closed loop": loop}  # fmt: skip
OF_THE_LINE = tuple(column for room in PARTS.values() for column in room.COLUMNS)
SETTINGS = tuple(column for column in OF_THE_LINE if column.setting)
RESULTS = tuple(column for column in OF_THE_LINE if not column.setting)
# `plant__step_s`: what no other column repeats
FURTHER = Column("*__*", None, word="Any other setting of the command", setting="*")
DECLARED = (*engine.IDENTITY, *SETTINGS, FURTHER, *RESULTS, *engine.CIRCUMSTANCES)
COLUMNS = tuple(column for column in DECLARED if not column.is_pattern)
BY_NAME = {column.name: column for column in COLUMNS}
PATTERNS = tuple(column for column in DECLARED if column.is_pattern)


def declared(name: str) -> Column | None:
    """The declaration of the column of this name, or None where nobody declares it."""
    return BY_NAME.get(name) or next((column for column in PATTERNS if column.covers(name)), None)


def label(name: str) -> str:
    """The printed name of a column with its unit, e.g. `settling_time_mean_s` -> `Mean settling
    time (s)`."""
    if column := BY_NAME.get(name):
        return column.label
    return setting_of(name) or name.replace("_", " ")


def setting_of(name: str) -> str:
    """The entry of the configuration that the column repeats, `plant.step_s`; empty where it is
    none."""
    return (
        name.replace("__", ".")
        if FURTHER.covers(name)
        else BY_NAME[name].setting
        if name in BY_NAME
        else ""
    )


def settings(table: pd.DataFrame) -> list[str]:
    """The columns that repeat settings, those of the command last; not what says who chose a
    rate."""
    names = [
        *(column.name for column in SETTINGS),
        *sorted(filter(FURTHER.covers, map(str, table))),
    ]
    return [name for name in names if name in table and name != "rates_chosen"]


def by_part(names: Iterable[str]) -> dict[str, list[str]]:
    """The names by the part of the study that they describe: settings first, what no part declares
    last."""
    titles = {FURTHER.name: "Settings"} | {
        c.name: "Settings" if c.setting else title
        for title, room in PARTS.items()
        for c in room.COLUMNS
    }
    found: dict[str, list[str]] = {title: [] for title in ("Settings", *PARTS, "Circumstances")}
    for name in names:
        found[titles.get(getattr(declared(name), "name", name), "Circumstances")].append(name)
    return found


def nearest(name: str, names: Iterable[str]) -> str:
    """Advice on a misspelt column: the nearest names, or how to list them."""
    near = get_close_matches(
        name, list(names), n=3, cutoff=0.5
    )  # cutoff: half of the letters in order
    return (
        f"did you mean {' or '.join(near)}?"
        if near
        else "`ssm-study show STUDY --columns` lists them"
    )


def listed(table: pd.DataFrame | None = None) -> Iterator[tuple[str, str, str, str]]:
    """Name, printed word, better direction and what `verify` does with it: of all columns, or of
    those with values."""
    for column in DECLARED:
        if table is None or any(
            column.covers(str(name)) and table[name].notna().any() for name in table
        ):
            yield (
                column.name,
                column.label,
                column.better,
                column.unchecked and f"not checked: {column.unchecked}",
            )
    undeclared = (
        [] if table is None else [str(name) for name in table if declared(str(name)) is None]
    )
    yield from ((name, "declared nowhere", "", "") for name in sorted(undeclared))


def requested(table: pd.DataFrame, name: str) -> pd.Series:
    """The value requested of a setting in each run: for a rate that `auto` chose, `auto`."""
    if not name.startswith("rate_"):
        return table[name]
    chosen = text(table, "rates_chosen").str.contains(name.removeprefix("rate_"))
    return table[name].astype(object).mask(chosen, "auto")


def swept(table: pd.DataFrame) -> list[str]:
    """The settings in which the runs differ, most values first, the seed last."""
    names = [name for name in ("study", *settings(table)) if name in table]
    counts = {name: requested(table, name).nunique() for name in names}
    return sorted(
        (name for name, count in counts.items() if count > 1),
        key=lambda name: (name == "seed", -counts[name]),
    )


def column(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as numbers, NaN where the table has none: a table of failures can be ranked and
    drawn too."""
    if name not in table:
        return pd.Series(float("nan"), index=table.index, name=name, dtype=float)
    return pd.to_numeric(table[name], errors="coerce").astype(float)


def flag(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as truth values; missing counts as false (nothing is certified by silence)."""
    return column(table, name).fillna(0.0) > 0


def text(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as words, empty where missing."""
    if name not in table:
        return pd.Series("", index=table.index, name=name, dtype=str)
    return table[name].astype("string").fillna("").astype(str)
