"""Means and standard deviations over seeds, for each combination of the other settings."""

from collections.abc import Iterator

import pandas as pd

from ssm_study.table.columns import BY_NAME, requested_values, setting_columns

MEASURED = ("fit_test_percent", "resolved_margin", "stable_fraction", "settling_time_mean_s")
HEADS = ("fit %", "margin", "settled", "settle s")
FEWEST = 2  # seeds of one setting, below which there is no deviation


def seed_statistics_lines(table: pd.DataFrame) -> list[str]:
    """Text lines of a table with the mean and standard deviation of each result over random seeds.

    Empty where no setting has two seeds. Seeds without a result are left out of its mean.
    """
    if "seed" not in table:
        return []
    settings = setting_columns(table)
    values = {name: requested_values(table, name) for name in settings if name != "seed"}
    varied = [name for name, own in values.items() if own.nunique(dropna=False) > 1]
    labels = pd.Series("all", table.index)
    if varied:
        varied_values = {name: values[name].astype("string") for name in varied}
        keys = pd.DataFrame(varied_values)
        filled_keys = keys.fillna("-")
        labels = filled_keys.agg(", ".join, axis=1)
    rows = []
    for label, runs in table.groupby(labels, sort=False):
        if runs["seed"].nunique() >= FEWEST:
            setting = str(label)
            cells = statistics_cells(setting, runs)
            rows.append(list(cells))
    if not rows:
        return []
    titles = [setting_heading(name) for name in varied]
    first_heading = ", ".join(titles) or "setting"
    head = [first_heading, "seeds", *HEADS]
    lines = [head, *rows]
    aligned = align_columns(lines)
    return ["", "mean ± deviation over seeds", *aligned]


def align_columns(rows: list[list[str]]) -> list[str]:
    """Format the rows of a text table as lines with aligned columns."""
    column_count = len(rows[0])
    widths = [max(len(row[k]) for row in rows) for k in range(column_count)]
    lines = []
    for first, *rest in rows:
        first_cell = first.ljust(widths[0])
        cells = [first_cell]
        other_widths = widths[1:]
        for text, width in zip(rest, other_widths, strict=True):
            cells.append(text.rjust(width))
        lines.append("  ".join(cells))
    return lines


def setting_heading(name: str) -> str:
    """Short heading of the table column that holds a setting."""
    column = BY_NAME.get(name)
    return column.head if column is not None and column.head else name


def statistics_cells(label: str, runs: pd.DataFrame) -> Iterator[str]:
    """Cells of a printed table row with statistics over the runs of one combination of settings."""
    yield label
    yield str(runs["seed"].nunique())
    for name in MEASURED:
        values = runs[name].dropna().astype(float) if name in runs else pd.Series(dtype=float)
        yield mean_and_deviation_text(values)


def mean_and_deviation_text(values: pd.Series) -> str:
    """Mean and standard deviation as text, such as `3.3 ± 0.26`, the deviation with two digits; a
    dash without values."""
    if not len(values):
        return "-"
    if len(values) < FEWEST:
        return f"{values.mean():.3g}"
    return f"{values.mean():.4g} ± {values.std():.2g}"
