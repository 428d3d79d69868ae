"""Choice of a model's order, number of neurons and number of break points. The question of size:
linear models of growing order, one layer, few neurons, many."""

from collections.abc import Sequence

from ssm_study.training.candidates import Candidate, Settings, simplest_good_candidate
from ssm_study.training.choice_of_paths import TRIED_SIZE
from ssm_study.training.search import Search

LINEAR_ORDERS = (1, 2, 3, 4, 6, 8, 10)
HIGH_LINEAR_ORDERS = (14, 20)  # one by one, while all that are smaller are behind
ONE_LAYER_ORDERS = (3, 8)  # least and most
SIZES: tuple[Settings, ...] = (  # the smallest first; with one layer before them
    {"order": 3, "neurons": 1, "knots": 0},
    TRIED_SIZE,
)
INTEGRATING_SIZES: tuple[Settings, ...] = (
    {"order": 1, "neurons": 1, "knots": 0},
    {"order": 1, "neurons": 2, "knots": 0},
    {"order": 2, "neurons": 1, "knots": 0},
    {"order": 2, "neurons": 1, "knots": 16},
    *SIZES,
)
FREE_SIZES: tuple[Settings, ...] = (  # not contracting by construction
    {"order": 2, "neurons": 5, "knots": 0, "rate": None},
    {"order": 3, "neurons": 5, "knots": 0, "rate": None},
)
FREE_GAIN = 0.25  # of the error that a model must remove that need not contract in open loop
LARGER: tuple[Settings, ...] = (  # one by one, while all that are smaller are behind
    {"order": 5, "neurons": 5, "knots": 16},
    {"order": 8, "neurons": 5, "knots": 16},
)


def try_model_sizes(search: Search) -> list[Candidate]:
    """Candidates of increasing order, number of neurons and number of break points; empty if all of
    these are given.

    Linear models of growing order are tried by output error first.
    """
    if not any(search.is_open(name) for name in ("order", "neurons", "knots")):
        return []
    candidates = [] if search.has_integrator else try_sizes_without_neurons(search)
    sizes = INTEGRATING_SIZES if search.has_integrator else SIZES
    candidates += [search.score_structured_model("size", size) for size in sizes]
    first_order = candidates[0].settings.get("order")  # None where the order is given
    needs_order = first_order is not None and int(first_order) > int(TRIED_SIZE["order"])
    for larger in LARGER:
        if simplest_good_candidate(candidates) is not candidates[-1] and not needs_order:
            break
        needs_order = False
        candidates.append(search.score_structured_model("size", larger))
    return [*candidates, *free_candidates(search, candidates)]


def free_candidates(search: Search, contracting: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that need not contract in open loop, for use if all that do are far behind them.

    No metric common to all slopes of a spring that hardens exists where it is lightly damped.
    Feedback adds the damping, so that the closed loop can be certified all the same.
    """
    if not search.is_open("rate") or search.has_integrator:
        return []
    free = [search.score_structured_model("no contraction", size) for size in FREE_SIZES]
    return [
        candidate
        for candidate in free
        if all(other.is_clearly_worse(candidate, FREE_GAIN) for other in contracting)
    ]


def try_sizes_without_neurons(search: Search) -> list[Candidate]:
    """Candidates without neurons: the best linear model, and models of similar order with an input
    map."""
    order = int(TRIED_SIZE["order"])
    candidates = []
    if search.folds[0].scale.outputs == 1 and search.is_open("order"):
        linear = choose_linear_order(search)
        order = int(linear.settings["order"])
        candidates.append(
            linear
            if search.allows_linear_model
            else search.score_structured_model("size", {"order": order, "neurons": 0, "knots": 0})
        )
    least, most = ONE_LAYER_ORDERS
    one_layer = {"order": min(max(order, least), most), "neurons": 0, "knots": 16}
    return [*candidates, search.score_structured_model("size", one_layer)]


def choose_linear_order(search: Search) -> Candidate:
    """Linear output-error model of the smallest order that is not clearly worse than the best."""
    feedthrough = search.setting_value("feedthrough") is True
    delay = 0 if feedthrough else 1 + int(search.setting_value("dead_time"))
    tried = [search.score_linear_model("linear order", order, delay) for order in LINEAR_ORDERS]
    for order in HIGH_LINEAR_ORDERS:
        if simplest_good_candidate(tried) is not tried[-1]:
            break
        tried.append(search.score_linear_model("linear order", order, delay))
    return simplest_good_candidate(tried)


def simplest_certifiable_candidate(search: Search, candidates: Sequence[Candidate]) -> Candidate:
    """Smallest candidate that can be certified and is not clearly worse than the best certifiable
    one. If none can be certified, all count.

    Certificates are asked for as they are needed, of the model trained without the last fold.
    """
    left = list(candidates)
    while left:
        chosen = simplest_good_candidate(left)
        if search.is_certifiable(chosen):
            return chosen
        left.remove(chosen)
    return simplest_good_candidate(candidates)
