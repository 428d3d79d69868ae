"""Choice of a model's order, number of neurons and number of break points. The question of size:
linear models of growing order, one layer, few neurons, many."""

from collections.abc import Sequence

from ssm_study.models.structured_spec import AUTO
from ssm_study.training.candidates import (
    NEARLY,
    Candidate,
    Settings,
    best_candidate,
    good_candidates,
    simplest_good_candidate,
)
from ssm_study.training.choice_of_paths import DELAY_GAIN, TRIED_SIZE
from ssm_study.training.search import LINEAR, STRUCTURED, SettingsSearch

LINEAR_ORDERS = (1, 2, 3, 4, 6, 8, 10)
HIGH_LINEAR_ORDERS = (14, 20)  # one by one, while all that are smaller are behind
ONE_LAYER_ORDERS = (3, 8)  # least and most
SIZES: tuple[Settings, ...] = (  # the smallest first; with one layer before them
    {"order": 3, "neurons": 1, "knots": 0},
    {"order": 2, "neurons": 2, "knots": 0},
    {"order": 2, "neurons": 5, "knots": 16},
    TRIED_SIZE,
)
INTEGRATING_SIZES: tuple[Settings, ...] = (
    {"order": 1, "neurons": 1, "knots": 0},
    {"order": 1, "neurons": 2, "knots": 0},
    {"order": 2, "neurons": 1, "knots": 0},
    {"order": 2, "neurons": 1, "knots": 16},
    {"order": 3, "neurons": 1, "knots": 0},
    TRIED_SIZE,
)
FREE_ORDERS_AND_NEURONS = ((2, 2), (3, 3), (2, 5), (3, 5))
FEW_NEURONS = 2  # sizes of these that are tried first
FREE_SIZES: tuple[Settings, ...] = tuple(  # not contracting by construction
    {"order": order, "neurons": neurons, "knots": 0, "rate": None}
    for order, neurons in FREE_ORDERS_AND_NEURONS
)
FREE_GAIN = 0.25  # of the error that a model must remove that need not contract in open loop
FINALIST = 1.5  # times the best error: candidates nearer than this are trained further
MOST_FINALISTS = 3
FURTHER_STEPS = 40  # of their training on each fold
LARGER: tuple[Settings, ...] = (  # one by one, while all that are smaller are behind
    {"order": 5, "neurons": 5, "knots": 16},
    {"order": 8, "neurons": 5, "knots": 16},
)


def decide_on_integrator(search: SettingsSearch) -> bool:
    """Decide on an integrator by comparison with models without neurons, and return whether to try
    models both with and without one.

    The two models that were compared have neurons. Where something acts that is not in the log,
    both follow it in the records that they are trained on, and are wrong elsewhere. So the
    integrator is decided on only if it is clearly better than models without neurons, too. If it is
    better, but not clearly, models of several sizes with an integrator are trained as well.
    """
    is_open = search.has_integrator and search.spec.integrating_output == AUTO
    if not is_open:
        return False
    with_integrator = search.chosen[-1]
    search.decided["integrating_output"] = False
    simple = try_sizes_without_neurons(search)
    if all(each.is_clearly_worse(with_integrator, DELAY_GAIN) for each in simple):
        search.decided["integrating_output"] = True
        return False
    search.chosen.pop()
    return all(with_integrator.mean_error_percent < each.mean_error_percent for each in simple)


def try_model_sizes(search: SettingsSearch, *, also_integrating: bool = False) -> list[Candidate]:
    """Cross-validate models of increasing order, number of neurons and number of break points.

    Linear models of growing order are tried by output error first. With `also_integrating`,
    candidates with an integrator come next: one neuron on one state is smaller than one layer.
    """
    if not any(search.is_undecided(name) for name in ("order", "neurons", "knots")):
        return []
    candidates = [] if search.has_integrator else try_sizes_without_neurons(search)
    sizes = INTEGRATING_SIZES if search.has_integrator else SIZES
    candidates += score_sizes(search, "size", sizes)
    candidates += try_larger_models(search, candidates)
    candidates += candidates_without_neurons_or_integrator(search)
    free = try_noncontracting_models(search)
    contracting = train_finalists(search, candidates)
    integrating = try_models_with_integrator(search, contracting) if also_integrating else []
    linear = [candidate for candidate in contracting if candidate.model == LINEAR]
    larger = [candidate for candidate in contracting if candidate.model != LINEAR]
    far_ahead = far_better_noncontracting(free, contracting)
    return [*linear, *integrating, *larger, *far_ahead]


def candidates_without_neurons_or_integrator(search: SettingsSearch) -> list[Candidate]:
    """Candidate models without neurons and without integrator, once an integrator has been chosen;
    otherwise none.

    Of models with an integrator often only the smallest can be certified. One that then predicts
    worse than one layer without an integrator is no gain.
    """
    if not search.has_integrator:
        return []
    structured = [candidate for candidate in search.tried if candidate.model == STRUCTURED]
    return [
        candidate
        for candidate in structured
        if candidate.settings.get("neurons") == 0
        and candidate.settings.get("integrating_output") is False
    ]


def try_larger_models(
    search: SettingsSearch, smaller_models: Sequence[Candidate]
) -> list[Candidate]:
    """Cross-validate models of higher order, one after another, as long as each is clearly better
    than all smaller ones. The first is tried, too, if a linear model needs more states than the
    others have."""
    first_settings = smaller_models[0].settings
    first_order = first_settings.get("order")  # None where the order is given
    needs_order = first_order is not None and int(first_order) > int(TRIED_SIZE["order"])
    candidates = [*smaller_models]
    for larger in LARGER:
        is_last_good = simplest_good_candidate(candidates) is candidates[-1]
        if not (is_last_good or needs_order):
            break
        needs_order = False
        larger_candidate = search.score_structured_model("size", larger)
        candidates.append(larger_candidate)
    return candidates[len(smaller_models) :]


def try_models_with_integrator(
    search: SettingsSearch, contracting: Sequence[Candidate]
) -> list[Candidate]:
    """Cross-validate models with an integrator, and return those that predict better than all
    others and can be certified. The best of several sizes are trained further before they are
    compared.

    They are tried where the folds did not decide between the two.
    """
    with_integrator = {"integrating_output": True, "input_path": "none"}
    sizes = [size | with_integrator for size in INTEGRATING_SIZES]
    scored = score_sizes(search, "integrator", sizes)
    finalists = train_finalists(search, scored)
    best_contracting = best_candidate(contracting)
    most = (1.0 - NEARLY) * best_contracting.mean_error_percent
    leading = [candidate for candidate in finalists if candidate.mean_error_percent < most]
    return [candidate for candidate in leading if search.is_certifiable(candidate)]


def try_noncontracting_models(search: SettingsSearch) -> list[Candidate]:
    """Cross-validate models that are not constrained to contract in open loop.

    No metric common to all slopes of a spring that hardens exists where it is lightly damped.
    Feedback adds the damping, so that the closed loop can be certified all the same. Many neurons
    are tried only where few were not given up before the last fold.
    """
    if not search.is_undecided("rate") or search.has_integrator:
        return []
    few_neurons = score_sizes(search, "no contraction", FREE_SIZES[:FEW_NEURONS])
    if all(len(candidate.errors) < len(search.folds) for candidate in few_neurons):
        return few_neurons
    return score_sizes(search, "no contraction", FREE_SIZES)  # those of few neurons only once


def score_sizes(
    search: SettingsSearch, question: str, sizes: Sequence[Settings]
) -> list[Candidate]:
    """Cross-validate models of several sizes; a size that is given twice is evaluated only once."""
    scored = [search.score_structured_model(question, size) for size in sizes]
    distinct = {id(candidate): candidate for candidate in scored}
    return list(distinct.values())


def far_better_noncontracting(
    noncontracting: Sequence[Candidate], contracting: Sequence[Candidate]
) -> list[Candidate]:
    """Models without the contraction constraint that predict far better than all contracting
    ones."""
    return [
        candidate
        for candidate in noncontracting
        if all(other.is_clearly_worse(candidate, FREE_GAIN) for other in contracting)
    ]


def train_finalists(search: SettingsSearch, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Continue the training of the best structured models, and return all candidate models with
    their new errors.

    After a few steps large models are less trained than small ones.
    """
    best = best_candidate(candidates)
    trained = [candidate for candidate in candidates if len(candidate.fits) == len(best.errors)]
    most = FINALIST * best.mean_error_percent
    near = [candidate for candidate in trained if candidate.mean_error_percent <= most]
    by_error = sorted(near, key=lambda candidate: candidate.mean_error_percent)
    best_by_error = by_error[:MOST_FINALISTS]
    finalists = [id(candidate) for candidate in best_by_error]
    return [
        search.train_further(candidate, FURTHER_STEPS) if id(candidate) in finalists else candidate
        for candidate in candidates
    ]


def try_sizes_without_neurons(search: SettingsSearch) -> list[Candidate]:
    """Cross-validate models without neurons: the best linear model, and models of similar order
    with an input map."""
    order = int(TRIED_SIZE["order"])
    candidates = []
    scale = search.folds[0].scale
    if scale.outputs == 1 and search.is_undecided("order"):
        simplest = choose_linear_order(search)
        order = int(simplest.settings["order"])
        if not search.allows_linear_model:
            without_neurons = {"order": order, "neurons": 0, "knots": 0}
            simplest = search.score_structured_model("size", without_neurons)
        candidates.append(simplest)
    least, most = ONE_LAYER_ORDERS
    least_order = max(order, least)
    one_layer_order = min(least_order, most)
    one_layer = {"order": one_layer_order, "neurons": 0, "knots": 16}
    one_layer_candidate = search.score_structured_model("size", one_layer)
    candidates.append(one_layer_candidate)
    return candidates


def choose_linear_order(search: SettingsSearch) -> Candidate:
    """Choose by cross-validation the smallest order of a linear output-error model that is not
    clearly worse than the best."""
    feedthrough = search.setting_value("feedthrough") is True
    delay = 0 if feedthrough else 1 + int(search.setting_value("dead_time"))
    tried = [search.score_linear_model("linear order", order, delay) for order in LINEAR_ORDERS]
    for order in HIGH_LINEAR_ORDERS:
        if simplest_good_candidate(tried) is not tried[-1]:
            break
        linear_candidate = search.score_linear_model("linear order", order, delay)
        tried.append(linear_candidate)
    return simplest_good_candidate(tried)


def simplest_certifiable_candidate(
    search: SettingsSearch, candidates: Sequence[Candidate]
) -> Candidate:
    """Smallest candidate model that can be certified and is not clearly worse than the best
    certifiable one. If none can be certified, all count.

    Certificates are asked for as they are needed, of the models trained on the folds.
    """
    left = list(candidates)
    while left:
        chosen = simplest_good_candidate(left)
        if search.is_certifiable(chosen):
            return chosen
        left.remove(chosen)
    return simplest_good_candidate(candidates)


def models_of_other_structure(
    candidates: Sequence[Candidate], chosen: Candidate
) -> list[Candidate]:
    """Contracting models of other structure that predict about as well as the best, to be averaged
    with the chosen one. Their mean with the chosen one contracts."""
    good = [candidate for candidate in good_candidates(candidates) if candidate is not chosen]
    structured = [candidate for candidate in good if candidate.fits]
    contracting = [candidate for candidate in structured if is_contracting(candidate)]
    return sorted(contracting, key=lambda candidate: candidate.mean_error_percent)


def is_contracting(candidate: Candidate) -> bool:
    """Whether the settings of a candidate model make it contract by construction."""
    rate = candidate.settings.get("rate", 0.0)
    has_rate = rate is not None
    return has_rate and candidate.settings.get("integrating_output") is not True
