"""Choice of a linear ARX model, which is tried on every log and preferred if unmeasured
disturbances dominate the log.

Output error is fitted by the error of a free run. Where the records hold few independent motions,
or a slow load acts, its minimum follows what happened by chance, and misses held-out pieces. The
errors of one step hold as many values as there are samples, so a regression is the steadier
estimate. It is a candidate beside the others where it predicts held-out pieces clearly better than
output error.

Where a load dominates, folds see too few values of it to tell a regression from others. There a
regression is taken unless the folds contradict it.
"""

from collections.abc import Sequence

from ssm_study.training.candidates import (
    LINEAR,
    REGRESSION,
    Candidate,
    best_candidate,
    simplest_good_candidate,
)
from ssm_study.training.choice_of_size import simplest_certifiable_candidate
from ssm_study.training.search import SettingsSearch

LOAD = 20.0  # percent of the output's deviation that a load leaves unexplained at least
LAGS = (3, 4, 6, 8, 10, 15, 20)


def score_regressions(search: SettingsSearch) -> list[Candidate]:
    """Cross-validate linear ARX models of several lags; empty if the settings allow none."""
    if not can_try_regression(search):
        return []
    is_direct = search.setting_value("feedthrough") is True
    delay = 0 if is_direct else 1 + int(search.setting_value("dead_time"))
    return [search.score_linear_model("regression", lags, delay, REGRESSION) for lags in LAGS]


def add_clearly_better_regression(
    candidates: Sequence[Candidate], regressions: Sequence[Candidate]
) -> list[Candidate]:
    """Add the simplest good regression to the candidate models, if all output-error models are
    clearly worse.

    It stands behind the output-error models and before all others, which have more to be trained.
    """
    output_error = [candidate for candidate in candidates if candidate.model == LINEAR]
    if not regressions:
        return [*candidates]
    simplest = simplest_good_candidate(regressions)
    if not all(candidate.is_clearly_worse(simplest) for candidate in output_error):
        return [*candidates]
    others = [candidate for candidate in candidates if candidate.model != LINEAR]
    return [*output_error, simplest, *others]


def choose_regression(
    search: SettingsSearch, candidates: Sequence[Candidate], regressions: Sequence[Candidate]
) -> Candidate | None:
    """Linear ARX model, preferred to all other candidate models if unmeasured disturbances dominate
    the log; otherwise None.

    A load dominates if the candidate that predicts best leaves at least `LOAD` percent of its own
    training records unexplained. (Others may explain more, but predict worse.) Even then there is
    no regression if the folds show it behind the model that would be chosen without it.
    """
    best = best_candidate(candidates)
    if best.training_error < LOAD or not regressions:
        return None
    simplest = simplest_good_candidate(regressions)
    if not search.is_certifiable(simplest):
        return None
    chosen = simplest_certifiable_candidate(search, candidates)
    return None if simplest.is_worse_beyond_chance(chosen) else simplest


def can_try_regression(search: SettingsSearch) -> bool:
    """Whether the settings leave the order open, allow a linear model without an integrator, and
    the log has one output: then a linear ARX model may be chosen."""
    has_one_output = search.folds[0].scale.outputs == 1
    is_open = has_one_output and search.is_undecided("order") and search.allows_linear_model
    return is_open and not search.has_integrator
