"""The order in which `auto` tries pairs of gains: never idle where a faster one is predicted."""

from itertools import islice
from typing import Any

import numpy as np
import pytest
from loop_cases import BALLS, motor_model

from ssm_study.robustness.mismatch import Mismatch
from ssm_study.synthesis import expected_response
from ssm_study.synthesis.candidates import Candidates
from ssm_study.synthesis.expected_response import FASTER, ExpectedResponse, compared_indices, rank

# Relative area on the model and loop gain (1 / margin) of four pairs: fast and near the edge, idle,
# slower than nothing, and refused.
AREAS = np.array([0.3, 1.0, 2.4, 0.1])
LOOP_GAINS = (0.95, 0.01, 0.01, 1.5)
PAIRS = np.array([[0, 0], [1, 0], [2, 0], [3, 0]])


@pytest.fixture
def response(monkeypatch: pytest.MonkeyPatch) -> ExpectedResponse:
    monkeypatch.setattr(ExpectedResponse, "stable_pairs", lambda *_: PAIRS)
    monkeypatch.setattr(ExpectedResponse, "loop_gain", lambda _, pair, __: LOOP_GAINS[pair[0]])
    monkeypatch.setattr(ExpectedResponse, "resists_noise", lambda *_: True)
    monkeypatch.setattr(expected_response, "relative_areas", lambda *_: AREAS)
    gains: Any = np.zeros((4, 1, 1))
    grid = Candidates(feedback=(), ks=gains, observing=(), ls=gains[:1])
    return ExpectedResponse(
        model=motor_model(), balls=BALLS, candidates=grid, mismatch=Mismatch(views=()), margin=1.0
    )


def order_of(response: ExpectedResponse) -> list[int]:
    pairs = response.ordered_pairs(np.zeros((4, 1)), (), None)
    ranked = list(islice(pairs, 10))
    for pair, is_faster in ranked:
        assert is_faster == (expected_response.relative_areas()[pair[0]] < expected_response.FASTER)
    return [int(pair[0]) for pair, _ in ranked]


def test_a_predicted_faster_pair_comes_before_an_idle_one(response):
    assert order_of(response) == [0, 1, 2]


def test_by_expected_area_alone_the_idle_one_came_first(response, monkeypatch):
    monkeypatch.setattr(expected_response, "FASTER", np.inf)
    assert order_of(response) == [1, 0, 2]


def test_without_a_faster_pair_the_others_are_still_offered(response, monkeypatch):
    monkeypatch.setattr(expected_response, "relative_areas", lambda *_: AREAS + 1)
    order = order_of(response)
    assert order[0] == 1
    assert sorted(order) == [0, 1, 2]


def test_a_plant_that_does_not_rest_is_offered_nothing(response):
    restless = Mismatch(views=(), left_at_rest=0.5)
    moving = ExpectedResponse(**{**vars(response), "mismatch": restless})
    assert order_of(moving) == []


def test_rank_and_compared_pairs():
    assert rank(FASTER - 0.01, 5.0) < rank(FASTER, 0.0)
    areas = np.linspace(1.0, 0.0, 1000)
    compared = compared_indices(areas)
    assert compared[0] == 999
    assert set(compared[:200]) == set(range(800, 1000))
    assert min(compared) < 10  # the slowest are among them
