"""What became of a run, in one word: the same word, colour and marker in the terminal, the figures and the page."""

from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes

from ssm_study.report import style
from ssm_study.report.columns import column, flag, text


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A word with its sentence; colour and marker differ both, so that either alone tells them apart."""

    word: str
    sentence: str
    colour: str
    marker: str


SETTLED = Verdict(
    word="certified, settles", sentence="both certificates hold and every start settles", colour=style.BLUE, marker="o"
)
LOST = Verdict(
    word="certified, plant lost",
    sentence="both certificates hold for the model, yet some start does not settle on the plant",
    colour=style.VERMILLION,
    marker="^",
)
UNCERTIFIED = Verdict(
    word="not certified", sentence="a design exists, but a certificate did not pass", colour=style.ORANGE, marker="s"
)
IDENTIFIED = Verdict(
    word="identified",
    sentence="a baseline, identified and scored; no controller is designed for it",
    colour=style.PURPLE,
    marker="v",
)
INFEASIBLE = Verdict(
    word="infeasible", sentence="no certificate exists at the rate asked", colour=style.GREY, marker="x"
)
FAILED = Verdict(word="failed", sentence="the run ended with an error", colour=style.INK, marker="P")
ALL = (SETTLED, LOST, UNCERTIFIED, IDENTIFIED, INFEASIBLE, FAILED)
BY_WORD = {verdict.word: verdict for verdict in ALL}


def verdicts(table: pd.DataFrame) -> pd.Series:
    """One word per row (see `ALL`); whatever is neither ok nor infeasible counts as failed."""
    status = text(table, "status")
    certified = flag(table, "controller_certified") & flag(table, "observer_certified")
    settled = column(table, "stable_fraction") >= 1
    word = pd.Series(UNCERTIFIED.word, index=table.index, name="verdict", dtype=object)
    word[certified & settled] = SETTLED.word
    word[certified & ~settled] = LOST.word
    word[column(table, "controller_feasible").isna() & column(table, "controller_certified").isna()] = IDENTIFIED.word
    word[status == "infeasible"] = INFEASIBLE.word
    word[~status.isin(["ok", "infeasible"])] = FAILED.word
    return word


def foretold(table: pd.DataFrame) -> pd.Series:
    """Whether the plant was predicted to stay stable, from model and validation record alone: it decides among runs.

    The column `predicted_stable` where there is one; in older tables a mismatch margin above one.
    """
    predicted = column(table, "predicted_stable")
    return (predicted > 0).where(predicted.notna(), column(table, "mismatch_margin") > 1)


def best_first(table: pd.DataFrame) -> pd.DataFrame:
    """By verdict; among equals those predicted to keep the plant first, then by settling time, then by fit.

    The first row is the best run: of the certified ones that settle, the fastest of those that one would have chosen
    without the plant. Settling times are relative to the plant left alone where that is known, so plants compare.
    """
    rank = verdicts(table).map({verdict.word: k for k, verdict in enumerate(ALL)})
    keys = pd.DataFrame(
        {
            "rank": rank.astype(float),
            "unforeseen": (~foretold(table)).astype(float),
            "time": _relative_time(table).fillna(float("inf")),
            "fit": -column(table, "fit_test_percent").fillna(float("-inf")),
        },
        index=table.index,
    )
    return table.loc[keys.sort_values(["rank", "unforeseen", "time", "fit"], kind="stable").index]


def _relative_time(table: pd.DataFrame) -> pd.Series:
    time, alone = column(table, "settling_time_mean_s"), column(table, "settling_time_open_loop_s")
    return time / alone if alone[time.notna()].notna().all() else time


def counts(table: pd.DataFrame) -> str:
    """A line such as `12 runs: 9 certified, settles; 2 infeasible; 1 failed`."""
    tally = verdicts(table).value_counts()
    parts = [f"{tally[verdict.word]} {verdict.word}" for verdict in ALL if verdict.word in tally]
    return f"{len(table)} run{'s' if len(table) != 1 else ''}" + (": " + "; ".join(parts) if parts else "")


def scatter(axes: Axes, table: pd.DataFrame, x: pd.Series, y: pd.Series, dodge: float = 0.0) -> None:
    """One point per run in the colour and marker of its verdict; only verdicts that occur enter the legend.

    `dodge` moves each verdict sideways by that much, so that runs at one setting do not hide each other.
    """
    word = verdicts(table)
    for k, verdict in enumerate(ALL):
        here = (word == verdict.word) & x.notna() & y.notna()
        if here.any():
            crossed = verdict.marker == "x"
            axes.scatter(
                x[here] + k * dodge,
                y[here],
                s=18,
                c=verdict.colour,
                marker=verdict.marker,
                edgecolors=verdict.colour if crossed else "white",
                linewidths=0.9 if crossed else 0.3,
                label=verdict.word,
                zorder=3,
            )
