"""What a newcomer asks of a study, answered from its table: which run is best, where feasibility ends, what failed."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from ssm_study.report import verdict
from ssm_study.report.columns import column, flag, spoken, text, words

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


def by_plant(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The runs of each plant, with `DC motor: ` to stand before its first sentence; nothing if there is only one plant.

    Settling times of different plants do not compare.
    """
    plants = text(table, "plant")
    if plants.nunique() < 2:
        return [("", table)]
    return [(f"{_capital(spoken(name))}: ", table[plants == name]) for name in plants.unique() if name]


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _best(table: pd.DataFrame) -> tuple[str, ...]:
    if table.empty:
        return ("No run has been made yet.",)
    return tuple(
        begun * (k == 0) + sentence for begun, runs in by_plant(table) for k, sentence in enumerate(_best_of(runs))
    )


def _best_of(table: pd.DataFrame) -> list[str]:
    ordered = verdict.best_first(table)
    run, word = ordered.iloc[[0]], verdict.verdicts(ordered)
    name = text(run, "run").iloc[0]
    if word.iloc[0] != verdict.SETTLED.word:
        return [f"No run is certified and brings every start to rest; the nearest, {name}, is {word.iloc[0]}."]
    rivals = ordered[word == verdict.SETTLED.word]
    number = {key: float(column(run, key).iloc[0]) for key in _NUMBERS}
    return [
        f"{name}. {_why(rivals)} {_settles(number)}.",
        f"Its model fits the test record to {number['fit_test_percent']:.1f} %; its controller contracts at rate "
        f"{number['rate_controller']:.3g} per sample where at most {number['controller_rate_limit']:.3g} can be "
        "certified.",
        *_faster_but_not_foretold(rivals),
    ]


def _settles(number: dict[str, float]) -> str:
    ratio = number["settling_time_mean_s"] / number["settling_time_open_loop_s"]
    alone = f", {ratio:.2f} of the plant left alone ({number['settling_time_open_loop_s']:.3f} s)"
    return f"in {number['settling_time_mean_s']:.3f} s on average{alone if np.isfinite(ratio) else ''}"


def _why(rivals: pd.DataFrame) -> str:
    """What sets the first of the certified runs that settle apart: the prediction, where there was one, and speed."""
    foretold = verdict.foretold(rivals)
    predicted = f", as was predicted without the plant ({_prediction(rivals)})" if foretold.iloc[0] else ""
    such = int(foretold.sum()) if foretold.iloc[0] else len(rivals)
    soonest = f"Of the {such} such runs it settles soonest," if such > 1 else "It settles"
    return f"Both certificates hold and every start settles{predicted}. {soonest}"


def _prediction(runs: pd.DataFrame) -> str:
    """The numbers behind the prediction for the first run."""
    resolved, radius, margin = (
        float(column(runs, name).iloc[0]) for name in ("resolved_margin", "controller_radius", "mismatch_margin")
    )
    if np.isfinite(resolved):
        return f"margin {resolved:.4g} by frequency, controller's own radius {radius:.3g}"
    return f"mismatch margin {margin:.4g}, above one" if margin > 1 else f"mismatch margin {margin:.4g}"


def _faster_but_not_foretold(rivals: pd.DataFrame) -> list[str]:
    quickest = rivals.loc[[column(rivals, "settling_time_mean_s").idxmin()]]
    if verdict.foretold(quickest).iloc[0] or not verdict.foretold(rivals).any():
        return []
    time = float(column(quickest, "settling_time_mean_s").iloc[0])
    return [
        f"{text(quickest, 'run').iloc[0]} was faster ({time:.3f} s), yet only the plant itself could tell "
        f"({_prediction(quickest)})."
    ]


_NUMBERS = (
    "settling_time_mean_s",
    "settling_time_open_loop_s",
    "fit_test_percent",
    "rate_controller",
    "controller_rate_limit",
)


def _feasibility(table: pd.DataFrame) -> tuple[str, ...]:
    sentences = [sentence for side in ("controller", "observer") for sentence in _side(table, side)]
    return tuple(sentences) or ("No run got as far as a rate limit.",)


def _side(table: pd.DataFrame, side: str) -> list[str]:
    """The frontier of the controllers, or of the observers where some request went beyond it."""
    rate, limit = column(table, f"rate_{side}"), column(table, f"{side}_rate_limit")
    known = rate.notna() & limit.notna()
    beyond, certified = known & (rate >= limit), flag(table, f"{side}_certified")
    missed = known & ~beyond & ~certified
    if not known.any() or (side == "observer" and not (beyond | missed).any()):
        return []
    reach = f"from {limit.min():.3g} to {limit.max():.3g}" if limit.nunique() > 1 else f"{limit.max():.3g}"
    scaffold = "S_u" if side == "controller" else "S_y"
    sentences = [
        f"The largest rate any {side} can be certified for is {reach} per sample over the models of this study; it "
        f"follows exactly from the eigenvalues of A and the ratio of the smallest to the largest slope of {scaffold}.",
        _beyond(int(known.sum()), int(beyond.sum()), int((beyond & certified).sum())),
    ]
    if missed.any():
        sentences.append(f"Inside it, {int(missed.sum())} got no certificate: there the method fell short.")
    return sentences


def _beyond(known: int, beyond: int, certified: int) -> str:
    if not beyond:
        return "Every rate asked lies inside it." if known > 1 else "The rate asked lies inside it."
    none = "none of those was certified" if not certified else f"{certified} of those were certified"
    return f"{beyond} of {known} requests lie beyond it, and {none}."


def _fit(table: pd.DataFrame) -> tuple[str, ...]:
    return tuple(begun + _fit_of(runs) for begun, runs in by_plant(table))


def _fit_of(table: pd.DataFrame) -> str:
    """Against the share of starts settled; against settling time where all settle."""
    certified = flag(table, "controller_certified") & flag(table, "observer_certified")
    fit = column(table, "fit_test_percent")
    for name, said, meaning in (
        ("stable_fraction", "share of starts settled", "1: the better the fit, the more settle"),
        ("settling_time_mean_s", "settling time", "-1: the better the fit, the sooner"),
    ):
        other = column(table, name)
        known = certified & fit.notna() & other.notna()
        if known.sum() >= 3 and fit[known].nunique() > 2 and other[known].nunique() > 1:
            rank = float(np.corrcoef(fit[known].rank(), other[known].rank())[0, 1])
            return (
                f"Over {int(known.sum())} certified runs, fit and {said} have a rank correlation of {rank:.2f} "
                f"({meaning}; 0: unrelated)."
            )
    fits, runs = fit[certified].nunique(), int(certified.sum())
    had = f"certified runs: {runs}, different fits among them: {fits}"
    return f"This study cannot tell ({had}); it takes three different fits, and loops that differ."


def _margin(table: pd.DataFrame) -> tuple[str, ...]:
    share, foretold = column(table, "stable_fraction"), verdict.foretold(table)
    by_frequency = column(table, "predicted_stable").notna()
    known = (by_frequency | column(table, "mismatch_margin").notna()) & share.notna()
    if not known.any():
        return ("No run has both a margin and a closed loop.",)
    yes, no = "With a margin above one", "With a margin at or below one"
    if by_frequency[known].any():
        yes = "With a margin above one at every frequency and a controller that is stable by itself"
        no = "Without that"
    return tuple(f"{said}, {_at_rest(share[known & side])}." for said, side in ((yes, foretold), (no, ~foretold)))


def _at_rest(share: pd.Series) -> str:
    return (
        f"{int((share >= 1).sum())} of {len(share)} runs bring every start to rest" if len(share) else "there is no run"
    )


def _failed(table: pd.DataFrame) -> tuple[str, ...]:
    word = verdict.verdicts(table)
    failed, lost, infeasible = (int((word == v.word).sum()) for v in (verdict.FAILED, verdict.LOST, verdict.INFEASIBLE))
    sentences = [_errors(table[word == verdict.FAILED.word], len(table)) if failed else "No run ended with an error."]
    if lost:
        sentences.append(f"Certified, plant lost: {lost}; both certificates hold, yet some start does not settle.")
    if infeasible:
        sentences.append(f"Infeasible, which is a result: {infeasible}; each record says how much was possible.")
    return tuple(sentences)


def _errors(failed: pd.DataFrame, runs: int) -> str:
    reasons = text(failed, "error_message").value_counts()
    most = reasons.index[0] or "no message was left"
    return f"{len(failed)} of {runs} runs ended with an error, {int(reasons.iloc[0])} of them with: {most}"


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
