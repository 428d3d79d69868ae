"""Sentences on feasibility, model fit and predicted stability, from the results of a study.

They answer the three questions of a study: where feasibility ends, whether a better fit means a
better loop, and whether the prediction holds.
The best run and the failures have parts of the page of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from ssm_study.report.words import choice_label, printed_column_name
from ssm_study.table.columns import (
    boolean_column,
    numeric_column,
    requested_values,
    swept_settings,
    text_column,
)
from ssm_study.table.rank import predicted_stable

CONFIDENCE = 0.95
LARGEST_TELLING = 0.5  # upper bound on a share of models, above which it says nothing
MOST_LISTED = 8  # values of a setting that are listed; of more the first and the last
FEWEST_RANKED = 3  # runs, and different fits: with fewer a rank correlation says nothing
# Column that the fit is compared with, its name in a sentence, and what the better end means.
OUTCOMES_OF_FIT = (
    ("stable_fraction", "share of starts settled", "1: the better the fit, the more settle"),
    ("settling_time_mean_s", "settling time", "-1: the better the fit, the sooner"),
)


@dataclass(frozen=True)
class Answer:
    """Question about a study, with its answer in plain sentences."""

    question: str
    sentences: tuple[str, ...]


def question_answers(table: pd.DataFrame) -> list[Answer]:
    """Questions that the results of a study can answer, each with its answer."""
    all_answers = [
        Answer("Where does feasibility end, and why?", feasibility_sentences(table)),
        Answer("Does a better fit mean a better loop?", fit_correlation_sentences(table)),
        Answer("Does the prediction hold on the plant?", prediction_sentences(table)),
    ]
    return [answer for answer in all_answers if answer.sentences]


def swept_settings_line(table: pd.DataFrame) -> str:
    """Text line that names the swept settings of a study and their values, such as `Swept: model
    order (4, 8, 12); ...`. Without a sweep it says so."""
    parts = []
    for name in swept_settings(table):
        title = printed_column_name(name).split(" (")[0].lower()
        parts.append(f"{title} ({distinct_values_text(requested_values(table, name))})")
    return f"Swept: {'; '.join(parts)}." if parts else "One setting, no sweep."


def distinct_values_text(values: pd.Series) -> str:
    """Text that lists the distinct values of a setting in ascending order. Of many values it gives
    their number, the first and the last."""
    distinct = values.dropna().unique().tolist()
    distinct.sort(key=lambda value: (value == "auto", value))
    printed = [f"{value:g}" if isinstance(value, float) else str(value) for value in distinct]
    if len(printed) <= MOST_LISTED:
        return ", ".join(printed)
    return f"{len(printed)} values, {printed[0]} to {printed[-1]}"


def group_by_plant(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Group the runs of a study by plant, each group with words that name the plant. The name is
    empty for a single plant.

    Settling times of different plants do not compare.
    """
    plants = text_column(table, "plant")
    if plants.nunique() < 2:
        yield "", table
        return
    for name in filter(None, plants.unique()):
        title = choice_label(name)
        yield f"{title[:1].upper()}{title[1:]}: ", table[plants == name]


def feasibility_sentences(table: pd.DataFrame) -> tuple[str, ...]:
    """Sentences on which requested contraction rates can be certified, with the exact limits of the
    rates. Observers are mentioned only where a request failed."""
    sides = ("controller", "observer")
    return tuple(sentence for side in sides for sentence in certifiable_rate_sentences(table, side))


def certifiable_rate_sentences(table: pd.DataFrame, side: str) -> Iterator[str]:
    """Sentences on the largest certifiable contraction rates of a study's models, and on how many
    requested rates exceed them."""
    rate = numeric_column(table, f"rate_{side}")
    limit = numeric_column(table, f"{side}_rate_limit")
    certified = boolean_column(table, f"{side}_certified")
    has_both = rate.notna() & limit.notna()
    beyond = has_both & (rate >= limit)  # at the limit itself no certificate exists
    missed = has_both & (rate < limit) & ~certified
    failed = beyond | missed
    if not has_both.any() or (side == "observer" and not failed.any()):
        return
    yield rate_limit_sentence(side, limit)
    if beyond.any():
        yield exceeded_limit_sentence(
            int(beyond.sum()), int(has_both.sum()), int((beyond & certified).sum())
        )
    elif has_both.sum() > 1:
        yield "Every rate is below the limit of its model."
    else:
        yield "The rate is below it."
    if missed.any():
        count = int(missed.sum())
        yield f"Inside it, {count} got no certificate: there the method fell short."


def rate_limit_sentence(side: str, limit: pd.Series) -> str:
    """Sentence that states the largest contraction rate that can be certified for the models of a
    study, and what determines it."""
    reach = f"{limit.max():.3g}"
    if limit.nunique() > 1:
        reach = f"from {limit.min():.3g} to {reach}"
    input_map = "S_u" if side == "controller" else "S_y"
    return (
        f"The largest rate any {side} can be certified for is {reach} per sample over the models "
        "of this study; it follows exactly from the eigenvalues of A and the ratio of the smallest "
        f"to the largest slope of {input_map}."
    )


def exceeded_limit_sentence(exceeding_count: int, request_count: int, certified_count: int) -> str:
    """Sentence on how many requested contraction rates exceed the exact limit, and on how those
    runs ended."""
    outcome = (
        f"{certified_count} of those were certified"
        if certified_count
        else "none of those was certified"
    )
    return f"{exceeding_count} of {request_count} requests lie beyond it, and {outcome}."


def fit_correlation_sentences(table: pd.DataFrame) -> tuple[str, ...]:
    """Sentences on whether a better model fit goes with a better closed loop, for each plant of a
    study. They correlate the fit with the share of settled initial states, or with the settling
    time."""
    if len(table) < 2:
        return ()
    return tuple(prefix + fit_correlation_sentence(runs) for prefix, runs in group_by_plant(table))


def fit_correlation_sentence(table: pd.DataFrame) -> str:
    """Sentence on the rank correlation (Spearman) between model fit and closed-loop result over the
    runs of a study."""
    certified = boolean_column(table, "controller_certified") & boolean_column(
        table, "observer_certified"
    )
    fit = numeric_column(table, "fit_test_percent")
    for name, outcome, meaning in OUTCOMES_OF_FIT:
        other = numeric_column(table, name)
        has_all = certified & fit.notna() & other.notna()
        fits = fit[has_all]
        if has_all.sum() < FEWEST_RANKED or fits.nunique() < FEWEST_RANKED:
            continue
        if other[has_all].nunique() > 1:
            rank = float(np.corrcoef(fits.rank(), other[has_all].rank())[0, 1])
            return (
                f"Over {int(has_all.sum())} certified runs, fit and {outcome} have a rank "
                f"correlation of {rank:.2f} ({meaning}; 0: unrelated)."
            )
    count = int(certified.sum())
    different = fit[certified].nunique()
    return (
        "This study cannot tell. It needs certified runs with three different fits, and loops that "
        f"differ; it has {count} certified run{'' if count == 1 else 's'} with {different} "
        f"different fit{'' if different == 1 else 's'}."
    )


def prediction_sentences(table: pd.DataFrame) -> tuple[str, ...]:
    """Sentences that count the settled closed loops among those predicted to be stable, and among
    the others. They also bound how often the prediction may be wrong. There are none where every
    loop was closed on the model that predicts."""
    if (text_column(table, "loop_on") == "identified model").all():
        return ()
    share = numeric_column(table, "stable_fraction")
    stable = predicted_stable(table)
    has_both = numeric_column(table, "predicted_stable").notna() & share.notna()
    if not has_both.any():
        return ()
    sides = {
        "Where the loop was predicted to stay stable": share[has_both & stable],
        "Where it was not": share[has_both & ~stable],
    }
    sentences = [
        f"{side}, every start settles in {int((shares >= 1).sum())} of {len(shares)} runs."
        for side, shares in sides.items()
        if len(shares)
    ]
    if len(sentences) < len(sides):
        sentences.append(
            "All runs are on one side, so this study cannot show where the prediction fails."
        )
    models = text_column(table, "stage_bounds_key")[has_both & stable]
    return (*sentences, *failure_bound_sentences(models, share[has_both & stable]))


def failure_bound_sentences(models: pd.Series, settled_fraction: pd.Series) -> list[str]:
    """Sentence with an upper confidence bound on how often a loop that is predicted stable does not
    settle. The runs of one model count as one sample.

    Loops of one model are not independent. With k of N models wrong the probability is below the p
    of `P(X <= k) = 0.05`, X binomial (Clopper & Pearson 1934); `1 - 0.05^(1/N)` for none.
    """
    wrong = (settled_fraction < 1).groupby(models[models != ""]).any()
    count = len(wrong)
    failed = int(wrong.sum())
    if count < 2 or failed == count:
        return []
    bound = scipy.special.betaincinv(failed + 1, count - failed, CONFIDENCE)
    if bound > LARGEST_TELLING:
        return [f"{count} models are too few to say how often a prediction fails."]
    of_them = f"{failed} had" if failed else "none had"
    return [
        f"Each model counted once: of {count} models {of_them} a predicted loop that does not "
        f"settle, so with {100 * CONFIDENCE:g} % confidence the share of such models is below "
        f"{bound:.2g}."
    ]
