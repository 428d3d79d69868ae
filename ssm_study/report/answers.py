"""What a newcomer asks of a study, answered from its table: which run is best, where feasibility ends, what failed."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from ssm_study.report import verdict
from ssm_study.report.columns import column, flag, text, words

PARAMETERS = (
    "order",
    "hidden_width",
    "slope_lower",
    "slope_upper",
    "scaffold_in",
    "scaffold_out",
    "plant",
    "excitation",
    "synthesis_method",
    "rate_controller",
    "rate_observer",
    "seed",
)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A question and its answer in plain sentences."""

    question: str
    sentences: tuple[str, ...]


def answers(table: pd.DataFrame) -> list[Answer]:
    """The headline questions of a study, in the order a reader asks them."""
    return [
        Answer(question="Which run is best, and why?", sentences=_best(table)),
        Answer(question="Where does feasibility end, and why?", sentences=_feasibility(table)),
        Answer(question="Does a better fit mean a better loop?", sentences=_fit(table)),
        Answer(question="Does the mismatch margin foretell the plant?", sentences=_margin(table)),
        Answer(question="What failed?", sentences=_failed(table)),
    ]


def swept(table: pd.DataFrame) -> list[str]:
    """The parameters that differ between runs, most values first."""
    counts = {name: table[name].nunique() for name in PARAMETERS if name in table}
    return sorted((name for name, count in counts.items() if count > 1), key=lambda name: -counts[name])


def _best(table: pd.DataFrame) -> tuple[str, ...]:
    if table.empty:
        return ("No run has been made yet.",)
    run = verdict.best_first(table).iloc[[0]]
    word, name = verdict.verdicts(run).iloc[0], text(run, "run").iloc[0]
    if word != verdict.SETTLED.word:
        return (f"No run is certified and brings every start to rest; the nearest, {name}, is {word}.",)
    number = {key: float(column(run, key).iloc[0]) for key in _NUMBERS}
    ratio = number["settling_time_mean_s"] / number["settling_time_open_loop_s"]
    alone = f", {ratio:.2f} of the plant left alone ({number['settling_time_open_loop_s']:.3f} s)"
    return (
        f"{name}: among the runs whose two certificates hold and whose every start settles, it settles soonest, in "
        f"{number['settling_time_mean_s']:.3f} s on average{alone if np.isfinite(ratio) else ''}.",
        f"Its model fits the test record to {number['fit_test_percent']:.1f} %; its controller contracts at rate "
        f"{number['rate_controller']:.3g} per sample where at most {number['controller_rate_limit']:.3g} can be "
        "certified.",
    )


_NUMBERS = (
    "settling_time_mean_s",
    "settling_time_open_loop_s",
    "fit_test_percent",
    "rate_controller",
    "controller_rate_limit",
)


def _feasibility(table: pd.DataFrame) -> tuple[str, ...]:
    rate, limit = column(table, "rate_controller"), column(table, "controller_rate_limit")
    known = rate.notna() & limit.notna()
    if not known.any():
        return ("No run got as far as a rate limit.",)
    beyond, certified = known & (rate >= limit), flag(table, "controller_certified")
    reach = f"from {limit.min():.3g} to {limit.max():.3g}" if limit.nunique() > 1 else f"{limit.max():.3g}"
    sentences = [
        f"The largest rate any controller can be certified for is {reach} per sample over the models of this study; it "
        "follows exactly from the eigenvalues of A and the ratio of the smallest to the largest slope of S_u.",
        f"{int(beyond.sum())} of {int(known.sum())} requests lie beyond it, and {int((beyond & certified).sum())} of "
        "those were certified.",
    ]
    missed = known & ~beyond & ~certified
    if missed.any():
        sentences.append(f"Inside it, {int(missed.sum())} got no certificate: there the method fell short.")
    return tuple(sentences)


def _fit(table: pd.DataFrame) -> tuple[str, ...]:
    certified = flag(table, "controller_certified") & flag(table, "observer_certified")
    fit, share = column(table, "fit_test_percent"), column(table, "stable_fraction")
    known = certified & fit.notna() & share.notna()
    if known.sum() < 3 or fit[known].nunique() < 2 or share[known].nunique() < 2:
        return (f"This study cannot tell: {int(known.sum())} certified runs, too alike in fit or in what settles.",)
    rank = float(np.corrcoef(fit[known].rank(), share[known].rank())[0, 1])
    return (
        f"Over its {int(known.sum())} certified runs, fit and share of starts settled have a rank correlation of "
        f"{rank:.2f} (1: always, 0: unrelated).",
    )


def _margin(table: pd.DataFrame) -> tuple[str, ...]:
    margin, share = column(table, "mismatch_margin"), column(table, "stable_fraction")
    known = margin.notna() & share.notna()
    if not known.any():
        return ("No run has both a margin and a closed loop.",)
    sentences = []
    for label, side in (("above", known & (margin > 1)), ("at or below", known & (margin <= 1))):
        settled = int((side & (share >= 1)).sum())
        sentences.append(f"With a margin {label} one, {settled} of {int(side.sum())} runs bring every start to rest.")
    return tuple(sentences)


def _failed(table: pd.DataFrame) -> tuple[str, ...]:
    word = verdict.verdicts(table)
    failed, infeasible = int((word == verdict.FAILED.word).sum()), int((word == verdict.INFEASIBLE.word).sum())
    if not failed:
        return (f"Nothing: no run ended with an error ({infeasible} are infeasible, which is a result).",)
    reasons = text(table, "error_message")[word == verdict.FAILED.word].value_counts()
    most = reasons.index[0] or "no message was left"
    return (f"{failed} of {len(table)} runs ended with an error, {int(reasons.iloc[0])} of them with: {most}",)


def parameters_line(table: pd.DataFrame) -> str:
    """`Swept: model order (4, 8, 12); ...` and what stayed the same."""
    names = swept(table)
    if not names:
        return "One setting, no sweep."
    return "Swept: " + "; ".join(f"{words(name).split(' (')[0].lower()} {_values(table[name])}" for name in names) + "."


def _values(values: pd.Series) -> str:
    unique = sorted(values.dropna().unique().tolist())
    shown = [f"{value:g}" if isinstance(value, float) else str(value) for value in unique]
    return f"({', '.join(shown)})" if len(shown) <= 8 else f"({len(shown)} values, {shown[0]} to {shown[-1]})"
