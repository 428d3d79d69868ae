"""Means and deviations over seeds, for each combination of the other settings."""

from collections.abc import Iterator

import pandas as pd

from ssm_study.table.columns import BY_NAME, requested, settings

MEASURED = ("fit_test_percent", "resolved_margin", "stable_fraction", "settling_time_mean_s")
HEADS = ("fit %", "margin", "settled", "settle s")
FEWEST = 2  # seeds of one setting, below which there is no deviation


def over_seeds(table: pd.DataFrame) -> list[str]:
    """A small table: other settings that vary, seeds, then `mean ± deviation` of each result.

    Empty where no setting has two seeds. Seeds without a result are left out of its mean.
    """
    if "seed" not in table or table["seed"].nunique() < FEWEST:
        return []
    values = {name: requested(table, name) for name in settings(table) if name != "seed"}
    varied = [name for name, own in values.items() if own.nunique(dropna=False) > 1]
    keys = pd.DataFrame({name: values[name].astype("string") for name in varied})
    labels = keys.fillna("-").agg(", ".join, axis=1) if varied else pd.Series("all", table.index)
    groups = [(str(label), runs) for label, runs in table.groupby(labels, sort=False)]
    groups = [(label, runs) for label, runs in groups if runs["seed"].nunique() >= FEWEST]
    if not groups:
        return []
    titles = [BY_NAME[name].head or name if name in BY_NAME else name for name in varied]
    head = [", ".join(titles) or "setting", "seeds", *HEADS]
    rows = [head, *(list(group_cells(label, runs)) for label, runs in groups)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    lines = []
    for first, *rest in rows:
        cells = [text.rjust(width) for text, width in zip(rest, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]))
    return ["", "mean ± deviation over seeds", *lines]


def group_cells(label: str, runs: pd.DataFrame) -> Iterator[str]:
    """The printed row of one setting."""
    yield label
    yield str(runs["seed"].nunique())
    for name in MEASURED:
        values = runs[name].dropna().astype(float) if name in runs else pd.Series(dtype=float)
        yield mean_and_deviation(values)


def mean_and_deviation(values: pd.Series) -> str:
    """`3.3 ± 0.26`: the deviation to two digits; a dash without values."""
    if not len(values):
        return "-"
    if len(values) < FEWEST:
        return f"{values.mean():.3g}"
    return f"{values.mean():.4g} ± {values.std():.2g}"
