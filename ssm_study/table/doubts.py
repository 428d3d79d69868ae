"""Warnings about runs of a study that are repeated, and about planned runs that are missing."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import pandas as pd

from ssm_study.engine.sweep import SWEEP, swept_numbers
from ssm_study.table.columns import SETTINGS
from ssm_study.table.folders import abbreviate_names

FITS = ("fit_train_percent", "fit_validation_percent", "fit_test_percent")
MOST = 10000  # combinations of a sweep that are compared with the table
RUNS_IN_SENTENCE = 4


def row_count_warnings(study: Path, table: pd.DataFrame) -> list[str]:
    """Sentences that say why the results table of a study may have too many or too few rows."""
    return [*repeated_run_sentences(table), *missing_run_sentences(study, table)]


def repeated_run_sentences(table: pd.DataFrame) -> Iterator[str]:
    """Sentences on runs of a study that have the same hash, or the same model under different
    seeds."""
    names = table["run"].astype("string")
    hashes = names.str.rsplit("-", n=1).str[-1]
    same_hash = hashes.duplicated(keep=False)
    if same_hash.any():
        listed = abbreviate_names(names[same_hash], RUNS_IN_SENTENCE)
        yield f"The same settings stand under several names, so they are one run: {listed}."
    if not set(FITS) <= set(table) or "seed" not in table:
        return
    fits = table[["seed", *FITS]].assign(run=names)[~same_hash].dropna()
    fits = fits[fits.duplicated(list(FITS), keep=False)]
    for _, alike in fits.groupby(list(FITS), sort=False):
        if alike["seed"].nunique() > 1:
            listed = abbreviate_names(alike["run"], RUNS_IN_SENTENCE)
            yield f"Runs of different seeds have the same model, so they count once: {listed}."


def missing_run_sentences(study: Path, table: pd.DataFrame) -> Iterator[str]:
    """Sentence on the combinations of settings in a study's last sweep for which the table has no
    run."""
    swept = swept_values(study)
    columns = {path: column_of_setting(path) for path in swept}
    known = [path for path in swept if columns[path] in table]
    if not known:
        return
    combinations = set(product(*(swept[path] for path in known)))
    cells = [table[columns[path]].map(comparable_setting_text) for path in known]
    present = set(zip(*cells, strict=True))
    damaged = sum("<NA>" in values for values in present)  # a record that cannot be read
    missing = len(combinations - present) - damaged
    if missing > 0:
        are = "is" if missing == 1 else "are"
        count = f"{missing} of {len(combinations)} runs of the sweep {are} missing"
        yield f"{count} ({SWEEP} lists them: not started, or removed)."


def swept_values(study: Path) -> dict[str, list[str]]:
    """Values of each setting that a study's last sweep varied, as texts, by the dotted path of the
    setting. Empty without a sweep that can be read, and for one of more than `MOST`
    combinations."""
    numbers = swept_numbers(study)
    swept = {path: list(map(comparable_setting_text, values)) for path, values in numbers.items()}
    return swept if prod(map(len, swept.values())) <= MOST else {}


def column_of_setting(path: str) -> str:
    """Name of the table column that holds the setting at a dotted path."""
    declared = (column.name for column in SETTINGS if column.setting == path)
    return next(declared, path.replace(".", "__"))


def comparable_setting_text(value: Any) -> str:
    """Text of a setting's value in one form, so that values from command line and table can be
    compared."""
    text = str(value)
    if text in ("True", "False", "<NA>"):
        return text
    with suppress(TypeError, ValueError):
        return f"{float(value):.12g}"
    return text
