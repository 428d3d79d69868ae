"""Runner-up of a study: a certified run that is slower than the best run, but more robust."""

from dataclasses import dataclass

import pandas as pd

from ssm_study.certificates.decay_time import plain_digits
from ssm_study.report.page.first_screen import row_as_record
from ssm_study.report.words import SETTLED, format_beside_bound
from ssm_study.table.columns import numeric_column, text_column
from ssm_study.table.rank import predicted_stable

SLOWEST = 2.0  # settling time over that of the best run: a slower run is another trade
MUCH = 2.0  # factor in margin or gain from which a run is much more robust


@dataclass(frozen=True, kw_only=True)
class RobustAlternative:
    """Run that is slower than the best run of a study, but more robust, with a sentence that
    compares the two."""

    place: int
    text: str


def choose_robust_alternative(table: pd.DataFrame) -> RobustAlternative | None:
    """Choose the fastest run whose stability margin is at least twice that of the best run.

    If there is none, choose the fastest run whose controller gain is at most half that of the
    best run. The table has the best run first. None if no run that settles in at most twice the
    time is that much more robust.
    """
    if not len(table) or table["verdict"].iloc[0] != SETTLED.word:
        return None
    margin = numeric_column(table, "resolved_margin")
    gain = numeric_column(table, "controller_gain_norm")
    eligible = eligible_run_mask(table) & margin.notna() & gain.notna()
    for is_robust in (margin >= MUCH * margin.iloc[0], MUCH * gain <= gain.iloc[0]):
        places = table.index[eligible & is_robust]
        if len(places):
            place = int(places[0])
            return RobustAlternative(place=place, text=comparison_text(table, place))
    return None


def eligible_run_mask(table: pd.DataFrame) -> "pd.Series[bool]":
    """Mask of the runs that may be shown as an alternative to the best run: on the same plant,
    predicted stable, settled in at most twice the time."""
    time_s = numeric_column(table, "settling_time_mean_s")
    plants = text_column(table, "plant")
    is_settled = text_column(table, "verdict") == SETTLED.word
    is_alike = (plants == plants.iloc[0]) & (time_s <= SLOWEST * time_s.iloc[0])
    return is_settled & predicted_stable(table) & is_alike


def comparison_text(table: pd.DataFrame, row: int) -> str:
    """Text that compares a run with the best run in settling time, stability margin and gain."""
    own = row_as_record(table.iloc[row])
    best = row_as_record(table.iloc[0])
    time_s = f"{plain_digits(own['settling_time_mean_s'])} s"
    own_margin = format_beside_bound(own["resolved_margin"])
    best_margin = format_beside_bound(best["resolved_margin"])
    margins = f"stability margin {own_margin} (best run: {best_margin})"
    own_gain = f"{own['controller_gain_norm']:.3g}"
    gains = f"gain {own_gain} ({best['controller_gain_norm']:.3g})"
    return f"settles in {time_s}, with {margins} and {gains}"
