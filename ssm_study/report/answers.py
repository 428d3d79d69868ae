"""What a newcomer asks of a study, answered from its table: which run is best, where feasibility
ends, what failed."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from ssm_study.report.words import (
    FAILED,
    INFEASIBLE,
    LOST,
    SETTLED,
    decides,
    spoken,
    verdicts,
    words,
)
from ssm_study.table.columns import column, flag, requested, swept, text
from ssm_study.table.rank import best_first, predicted

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Answer:
    """A question and its answer in plain sentences."""

    question: str
    sentences: tuple[str, ...]


def answers(table: pd.DataFrame) -> list[Answer]:
    """The headline questions of a study, in the order a reader asks them."""
    best = [
        begun * (k == 0) + said
        for begun, runs in by_plant(table)
        for k, said in enumerate(_best(runs))
    ]
    feasibility = [
        sentence for side in ("controller", "observer") for sentence in _feasibility(table, side)
    ]
    fit = [begun + _fit(runs) for begun, runs in by_plant(table)]
    return [
        Answer("Which run is best, and why?", tuple(best)),
        Answer(
            "Where does feasibility end, and why?",
            tuple(feasibility) or ("No run got as far as a rate limit.",),
        ),
        *([Answer("Does a better fit mean a better loop?", tuple(fit))] if len(table) != 1 else []),
        Answer("Does the prediction hold on the plant?", _margin(table)),
        Answer("What failed?", _failed(table)),
    ]


def parameters_line(table: pd.DataFrame) -> str:
    """`Swept: model order (4, 8, 12); ...`, or that there was no sweep."""
    told = []
    for name in swept(table):
        unique = sorted(
            requested(table, name).dropna().unique().tolist(),
            key=lambda value: (value == "auto", value),
        )
        shown = [f"{value:g}" if isinstance(value, float) else str(value) for value in unique]
        many = f"{len(shown)} values, {shown[0]} to {shown[-1]}"
        told.append(
            f"{words(name).split(' (')[0].lower()} ({', '.join(shown) if len(shown) <= 8 else many})"
        )
    return f"Swept: {'; '.join(told)}." if told else "One setting, no sweep."


def by_plant(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The runs of each plant, with `DC motor: ` to stand before its first sentence; nothing if
    there is only one plant.

    Settling times of different plants do not compare.
    """
    plants = text(table, "plant")
    if plants.nunique() < 2:
        return [("", table)]
    titles = {name: spoken(name) for name in plants.unique() if name}
    return [
        (f"{title[:1].upper()}{title[1:]}: ", table[plants == name])
        for name, title in titles.items()
    ]


def _number(runs: pd.DataFrame, name: str) -> float:
    """Of the first run."""
    return float(column(runs, name).iloc[0])


def _best(table: pd.DataFrame) -> list[str]:
    if table.empty:
        return ["No run has been made yet."]
    ordered = best_first(table)
    name, word = text(ordered, "run").iloc[0], verdicts(ordered)
    if word.iloc[0] != SETTLED.word:
        return [
            f"No run is certified and brings every start to rest; the nearest, {name}, is {word.iloc[0]}."
        ]
    rivals = ordered[word == SETTLED.word]
    where = (
        ""
        if text(rivals, "loop_on").iloc[0] in ("", "plant")
        else f" on the {text(rivals, 'loop_on').iloc[0]}"
    )
    said, time_s = predicted(rivals), _number(rivals, "settling_time_mean_s")
    told = f", as was predicted without the plant ({_prediction(rivals)})" if said.iloc[0] else ""
    such = int(said.sum()) if said.iloc[0] else len(rivals)
    soonest = f"Of the {such} such runs it settles soonest," if such > 1 else "It settles"
    alone_s = _number(rivals, "settling_time_open_loop_s")
    share = (
        f", {time_s / alone_s:.2f} of the uncontrolled time ({alone_s:.4g} s)"
        if np.isfinite(alone_s)
        else ""
    )
    fit, rate = _number(rivals, "fit_test_percent"), _number(rivals, "rate_controller")
    return [
        f"{name}. Both certificates hold and every start settles{where}{told}. "
        f"{soonest} in {time_s:.4g} s on average{share}.",
        f"Its model fits the test record to {fit:.1f} %; its controller was designed for rate {rate:.3g} per sample, "
        f"where at most {_number(rivals, 'controller_rate_limit'):.3g} can be certified.",
        *_faster_but_not_predicted(rivals),
    ]


def _prediction(runs: pd.DataFrame) -> str:
    """The numbers behind the prediction for the first run."""
    return decides(
        *(_number(runs, name) for name in ("resolved_margin", "controller_radius", "noise_peak"))
    )


def _faster_but_not_predicted(rivals: pd.DataFrame) -> list[str]:
    quickest = rivals.loc[[column(rivals, "settling_time_mean_s").idxmin()]]
    if predicted(quickest).iloc[0] or not predicted(rivals).any():
        return []
    name, time_s = text(quickest, "run").iloc[0], _number(quickest, "settling_time_mean_s")
    return [
        f"{name} was faster ({time_s:.4g} s), yet only the plant itself could tell ({_prediction(quickest)})."
    ]


def _feasibility(table: pd.DataFrame, side: str) -> list[str]:
    """The frontier of the controllers, or of the observers where some request went beyond it."""
    rate, limit = column(table, f"rate_{side}"), column(table, f"{side}_rate_limit")
    known, certified = rate.notna() & limit.notna(), flag(table, f"{side}_certified")
    beyond, missed = (
        known & (rate >= limit),
        known & (rate < limit) & ~certified,
    )  # at the limit itself none exists
    if not known.any() or (side == "observer" and not (beyond | missed).any()):
        return []
    reach = (
        f"from {limit.min():.3g} to {limit.max():.3g}"
        if limit.nunique() > 1
        else f"{limit.max():.3g}"
    )
    sentences = [
        f"The largest rate any {side} can be certified for is {reach} per sample over the models of this study; it "
        "follows exactly from the eigenvalues of A and the ratio of the smallest to the largest slope of "
        f"{'S_u' if side == 'controller' else 'S_y'}."
    ]
    held = int((beyond & certified).sum())
    if beyond.any():
        none = f"{held} of those were certified" if held else "none of those was certified"
        sentences.append(
            f"{int(beyond.sum())} of {int(known.sum())} requests lie beyond it, and {none}."
        )
    else:
        sentences.append(
            "Every rate is below the limit of its model."
            if known.sum() > 1
            else "The rate is below it."
        )
    if missed.any():
        sentences.append(
            f"Inside it, {int(missed.sum())} got no certificate: there the method fell short."
        )
    return sentences


def _fit(table: pd.DataFrame) -> str:
    """Against the share of starts settled; against settling time where all settle."""
    certified = flag(table, "controller_certified") & flag(table, "observer_certified")
    fit = column(table, "fit_test_percent")
    for name, said, meaning in (
        ("stable_fraction", "share of starts settled", "1: the better the fit, the more settle"),
        ("settling_time_mean_s", "settling time", "-1: the better the fit, the sooner"),
    ):
        other = column(table, name)
        known = certified & fit.notna() & other.notna()
        if (
            known.sum() >= 3 and fit[known].nunique() > 2 and other[known].nunique() > 1
        ):  # else a rank says nothing
            rank = float(np.corrcoef(fit[known].rank(), other[known].rank())[0, 1])  # Spearman's
            return (
                f"Over {int(known.sum())} certified runs, fit and {said} have a rank correlation of {rank:.2f} "
                f"({meaning}; 0: unrelated)."
            )
    had = (
        f"it has {int(certified.sum())} certified, with different fits: {fit[certified].nunique()}"
    )
    return f"This study cannot tell: that takes certified runs with three different fits and unequal loops ({had})."


def _margin(table: pd.DataFrame) -> tuple[str, ...]:
    share, said_so = column(table, "stable_fraction"), predicted(table)
    known = column(table, "predicted_stable").notna() & share.notna()
    if not known.any():
        return ("No run has both a prediction and a closed loop.",)
    yes, no = share[known & said_so], share[known & ~said_so]
    sides = {"Where the loop was predicted to stay stable": yes, "Where it was not": no}
    told = [
        f"{said}, every start settles in {int((s >= 1).sum())} of {len(s)} runs."
        for said, s in sides.items()
        if len(s)
    ]
    if len(told) < len(sides):
        told.append(
            "All runs are on one side, so this study cannot show where the prediction fails."
        )
    return (*told, *_by_model(text(table, "stage_bounds_key")[known & said_so], yes))


def _by_model(models: pd.Series, share: pd.Series) -> list[str]:
    """How often a prediction may fail: loops of one model are not independent, so each model counts
    once.

    With k of N models wrong the probability is below the p of `P(X <= k) = 0.05`, X binomial
    (Clopper & Pearson 1934);
    `1 - 0.05^(1/N)` for none.
    """
    wrong = (share < 1).groupby(models[models != ""]).any()
    count, failed = len(wrong), int(wrong.sum())
    if count < 2 or failed == count:
        return []
    bound = scipy.special.betaincinv(failed + 1, count - failed, CONFIDENCE)
    of_them = f"{failed} had" if failed else "none had"
    return [
        f"Each model counted once: of {count} models {of_them} a predicted loop that does not settle, so with "
        f"{100 * CONFIDENCE:g} % confidence the share of such models is below {bound:.2g}."
    ]


def _failed(table: pd.DataFrame) -> tuple[str, ...]:
    word = verdicts(table)
    failed, lost, infeasible = (
        int((word == verdict.word).sum()) for verdict in (FAILED, LOST, INFEASIBLE)
    )
    sentences = ["No run ended with an error."]
    if failed:
        reasons = text(table[word == FAILED.word], "error_message").value_counts()
        most = f"{int(reasons.iloc[0])} of them with: {reasons.index[0] or 'no message was left'}"
        sentences = [f"{failed} of {len(table)} runs ended with an error, {most}"]
    if lost:
        runs = f"{lost} certified runs do" if lost > 1 else "1 certified run does"
        sentences.append(
            f"{runs} not settle: both certificates hold for the model, yet some start does not settle."
        )
    if infeasible:
        runs = f"{infeasible} runs are" if infeasible > 1 else "1 run is"
        sentences.append(
            f"{runs} infeasible, which is a result: the record states the largest feasible rate."
        )
    return tuple(sentences)
