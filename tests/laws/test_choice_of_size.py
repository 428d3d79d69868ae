"""Which sizes are tried, and which answer is taken, by the errors that a search would find."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssm_study.models.structured_spec import AUTO
from ssm_study.training.candidates import Candidate, Settings
from ssm_study.training.choice_of_size import (
    FREE_SIZES,
    HIGH_LINEAR_ORDERS,
    INTEGRATING_SIZES,
    LARGER,
    LINEAR_ORDERS,
    SIZES,
    choose_linear_order,
    decide_on_integrator,
    try_sizes_without_neurons,
)
from ssm_study.training.search import LINEAR, STRUCTURED, SettingsSearch

WORST = 80.0


class FakeSearch(SettingsSearch):
    """Search that trains nothing: the error of a linear model is that of its order, the error of
    any other model is the same."""

    has_integrator = True
    allows_linear_model = True

    def __init__(self, **state: Any) -> None:
        vars(self).update(state)

    def score_linear_model(self, question: str, order: int, delay: int, *_: Any) -> Candidate:
        self.delays.append(delay)
        error = self.errors.get(order, WORST)
        return candidate(question, LINEAR, error, order=order)

    def score_structured_model(self, question: str, settings: Settings) -> Candidate:
        self.structured.append(settings)
        return candidate(question, STRUCTURED, self.other_error, **settings)

    def setting_value(self, name: str) -> Any:
        return self.settings.get(name)

    def is_undecided(self, name: str) -> bool:
        return name in self.undecided


def candidate(question: str, model: str, error: float, **settings: Any) -> Candidate:
    errors = np.array([error, 1.02 * error, 0.98 * error])
    return Candidate(question=question, model=model, settings=settings, errors=errors)


def search_of(errors: dict[int, float], **changes: Any) -> FakeSearch:
    """Search on records of one output, in which the order is open."""
    folds = [SimpleNamespace(scale=SimpleNamespace(outputs=1))] * 3
    state = {"errors": errors, "other_error": WORST, "undecided": {"order"}, "folds": folds}
    state |= {"delays": [], "structured": [], "decided": {}}
    state |= {"settings": {"feedthrough": False, "dead_time": 0}}
    return FakeSearch(**(state | changes))


ORDERS = [
    ({3: 10.0, 4: 9.9}, 3, len(LINEAR_ORDERS)),
    ({10: 10.0}, 10, len(LINEAR_ORDERS) + 1),
    ({10: 10.0, 14: 5.0}, 14, len(LINEAR_ORDERS) + 2),
    ({10: 10.0, 14: 5.0, 20: 2.0}, 20, len(LINEAR_ORDERS) + len(HIGH_LINEAR_ORDERS)),
    ({1: 10.0, 20: 1.0}, 1, len(LINEAR_ORDERS)),
]


@pytest.mark.parametrize(("errors", "chosen", "tried"), ORDERS)
def test_high_orders_are_tried_while_the_highest_before_is_needed(
    errors: dict[int, float], chosen: int, tried: int
) -> None:
    search = search_of(errors)
    candidate = choose_linear_order(search)
    assert candidate.settings["order"] == chosen
    count = len(search.delays)
    assert count == tried


@pytest.mark.parametrize(
    ("feedthrough", "dead_time", "delay"), [(True, 0, 0), (False, 0, 1), (False, 6, 7)]
)
def test_a_linear_model_answers_after_the_dead_time(
    feedthrough: bool, dead_time: int, delay: int
) -> None:
    settings = {"feedthrough": feedthrough, "dead_time": dead_time}
    search = search_of({1: 1.0}, settings=settings)
    choose_linear_order(search)
    delays = set(search.delays)
    assert delays == {delay}


@pytest.mark.parametrize(("order", "expected"), [(1, 3), (6, 6), (10, 8)])
def test_one_layer_has_the_order_of_the_linear_model_within_bounds(
    order: int, expected: int
) -> None:
    search = search_of({order: 1.0})
    linear, one_layer = try_sizes_without_neurons(search)
    assert linear.settings["order"] == order
    settings = one_layer.settings
    assert settings["order"] == expected
    assert settings["neurons"] == 0
    assert settings["knots"] == SIZES[2]["knots"]


def test_where_no_linear_model_is_allowed_its_order_is_tried_without_neurons() -> None:
    search = search_of({4: 1.0}, allows_linear_model=False)
    simplest, _ = try_sizes_without_neurons(search)
    assert simplest.model == STRUCTURED
    expected = {"order": 4, "neurons": 0, "knots": 0}
    assert simplest.settings == expected


INTEGRATORS = [(10.0, True, False), (72.0, True, False), (74.0, False, True), (90.0, False, False)]


@pytest.mark.parametrize(("error", "is_decided", "are_both_tried"), INTEGRATORS)
def test_an_integrator_is_decided_on_where_it_is_clearly_better(
    error: float, is_decided: bool, are_both_tried: bool
) -> None:
    """Better, but not clearly, means that both are tried."""
    spec = SimpleNamespace(integrating_output=AUTO)
    chosen = [candidate("integrator", STRUCTURED, error)]
    search = search_of({}, spec=spec, chosen=chosen)
    assert decide_on_integrator(search) is are_both_tried
    assert search.decided["integrating_output"] is is_decided
    assert len(search.chosen) == int(is_decided)


@pytest.mark.parametrize("sizes", [SIZES, INTEGRATING_SIZES, FREE_SIZES, LARGER])
def test_each_size_is_tried_once_and_none_after_one_that_contains_it(
    sizes: tuple[Settings, ...],
) -> None:
    names = ("order", "neurons", "knots")
    grids = [tuple(int(size[name]) for name in names) for size in sizes]
    for number, later in enumerate(grids):
        for earlier in grids[:number]:
            is_contained = all(a <= b for a, b in zip(later, earlier, strict=True))
            assert not is_contained, (earlier, later)
