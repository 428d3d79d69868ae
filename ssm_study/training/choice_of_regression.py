"""Choice of a linear regression (ARX) for logs that unmeasured disturbances dominate.

The error of a free run is then mostly the load, which is slow: a few thousand samples hold few
independent values of it, and models that minimise this error follow it by chance. The errors of one
step hold as many values as there are samples. So a regression is the steadier estimate, although
its free run fits the records less. Folds see too few values of the load to tell the two apart.
"""

from collections.abc import Sequence

from ssm_study.training.candidates import (
    REGRESSION,
    Candidate,
    best_candidate,
    simplest_good_candidate,
)
from ssm_study.training.search import SettingsSearch

LOAD = 20.0  # percent of the output's deviation that a load leaves unexplained at least
LAGS = (3, 4, 6, 8, 10, 15, 20)


def choose_regression(search: SettingsSearch, candidates: Sequence[Candidate]) -> Candidate | None:
    """Linear ARX model, preferred to all other candidate models if unmeasured disturbances dominate
    the log; otherwise None.

    The candidates explain the records if the one that predicts best leaves less than `LOAD` of
    those that it was trained on. Others may leave less: what they explain more does not help them
    predict.
    """
    best = best_candidate(candidates)
    if best.training_error < LOAD or not can_try_regression(search):
        return None
    is_direct = search.setting_value("feedthrough") is True
    delay = 0 if is_direct else 1 + int(search.setting_value("dead_time"))
    tried = [search.score_linear_model("regression", lags, delay, REGRESSION) for lags in LAGS]
    simplest = simplest_good_candidate(tried)
    is_taken = search.is_certifiable(simplest) and not simplest.is_worse_beyond_chance(best)
    return simplest if is_taken else None


def can_try_regression(search: SettingsSearch) -> bool:
    """Whether the settings allow a linear ARX model with one output and any order, and without an
    integrator."""
    has_one_output = search.folds[0].scale.outputs == 1
    is_open = has_one_output and search.is_undecided("order") and search.allows_linear_model
    return is_open and not search.has_integrator
