"""The order in which `auto` tries pairs of gains: never idle where a faster one is predicted."""

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from loop_cases import BALLS, motor_model

from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import Trajectory
from ssm_study.synthesis import expected_response
from ssm_study.synthesis.candidates import GainCandidates
from ssm_study.synthesis.decay_response import (
    NO_DECAYS,
    largest_settling_time_ratios,
    simulate_decays,
)
from ssm_study.synthesis.expected_response import FASTER, ExpectedResponse, indices_to_compare
from ssm_study.systems import Gains

# Relative area on the model and loop gain (1 / margin) of four pairs: fast and near the edge, idle,
# slower than nothing, and refused.
AREAS = np.array([0.3, 1.0, 2.4, 0.1])
LOOP_GAINS = (0.95, 0.01, 0.01, 1.5)
RNG = np.random.default_rng(0)
START = np.array([0.5, 0.0])
ROWS_OF_PAIRS = [[0, 0], [1, 0], [2, 0], [3, 0]]
PAIRS = np.array(ROWS_OF_PAIRS)


@pytest.fixture
def response(monkeypatch: pytest.MonkeyPatch) -> ExpectedResponse:
    monkeypatch.setattr(ExpectedResponse, "stable_pair_indices", lambda *_: PAIRS)
    monkeypatch.setattr(ExpectedResponse, "loop_gain", lambda _, pair, __: LOOP_GAINS[pair[0]])
    monkeypatch.setattr(ExpectedResponse, "resists_noise", lambda *_: True)
    monkeypatch.setattr(expected_response, "relative_response_areas", lambda *_: AREAS)
    gains: Any = np.zeros((4, 1, 1))
    ls = gains[:1]
    grid = GainCandidates(feedback=(), ks=gains, observing=(), ls=ls)
    mismatch = Mismatch(views=())

    return ExpectedResponse(
        model=motor_model(), balls=BALLS, candidates=grid, mismatch=mismatch, margin=1.0
    )


def order_of(response: ExpectedResponse) -> list[int]:
    peaks = np.zeros((4, 1))
    pairs = response.pairs_by_expected_response(peaks, (), None)
    ranked = list(islice(pairs, 10))
    for pair, is_faster in ranked:
        areas = expected_response.relative_response_areas()
        expected = areas[pair[0]] < expected_response.FASTER
        assert is_faster == expected
    return [int(pair[0]) for pair, _ in ranked]


def test_a_predicted_faster_pair_comes_before_an_idle_one(response):
    expected = [0, 1, 2]
    assert order_of(response) == expected


def test_by_expected_area_alone_the_idle_one_came_first(response, monkeypatch):
    monkeypatch.setattr(expected_response, "FASTER", np.inf)
    expected = [1, 0, 2]
    assert order_of(response) == expected


def test_without_a_faster_pair_the_others_are_still_offered(response, monkeypatch):
    monkeypatch.setattr(expected_response, "relative_response_areas", lambda *_: AREAS + 1)
    order = order_of(response)
    assert order[0] == 1
    expected = [0, 1, 2]
    assert sorted(order) == expected


def test_a_plant_that_does_not_rest_is_offered_nothing(response):
    restless = Mismatch(views=(), left_at_rest=0.5)
    fields = {**vars(response), "mismatch": restless}
    moving = ExpectedResponse(**fields)
    assert order_of(moving) == []


def test_a_pair_that_only_stirs_up_a_decay_comes_after_the_others(response, monkeypatch):
    """The fast pair settles no sooner than the plant does by itself from where it was recorded."""
    ratios = np.array([1.2, 0.5, 0.5, 0.5])
    monkeypatch.setattr(expected_response, "largest_settling_time_ratios", lambda *_: ratios)
    monkeypatch.setattr(expected_response, "relative_response_areas", lambda *_: 0.5 * AREAS)
    peaks = np.zeros((4, 1))
    rankeds = response.pairs_by_expected_response(peaks, (), None)
    pairs = [(int(ranked.pair[0]), ranked.is_faster) for ranked in rankeds]
    first = (1, True)
    second = (2, False)
    third = (0, False)
    expected = [first, second, third]
    assert pairs == expected


def test_the_compared_pairs_are_the_fastest_and_some_of_the_rest():
    areas = np.linspace(1.0, 0.0, 1000)
    compared = indices_to_compare(areas, areas >= FASTER)
    assert compared[0] == 999
    fastest = range(800, 1000)
    expected = set(fastest)
    first_compared = compared[:200]
    set_of_first = set(first_compared)
    assert set_of_first == expected
    assert min(compared) < 10  # the slowest are among them
    slow = np.array([True, False])
    expected = [1, 0]
    areas = np.array([0.1, 0.8])
    assert indices_to_compare(areas, slow) == expected


def test_a_decay_is_answered_by_the_model_alone():
    """Without gains the decay is what it was; gains that act at once settle it sooner."""
    model = motor_model()
    linear = model.linear
    input_equilibrium = model.scale.input_equilibrium
    samples = (200, 1)
    u = np.tile(input_equilibrium, samples)
    resting_input = np.tile(input_equilibrium, samples)
    y = model.simulate(resting_input, START)
    trial = Trajectory(u=u, y=y, step_s=model.step_s)
    shape_of_b = linear.b.shape
    rng = RNG.standard_normal((400, shape_of_b[1]))
    u = input_equilibrium + rng
    outputs = len(linear.c)
    y = np.zeros((400, outputs))
    excited = Trajectory(u=u, y=y, step_s=model.step_s)
    decays = simulate_decays(model, (trial,), (excited,))
    assert len(decays) == 1
    k = np.zeros((1, 1, model.order))
    no_injection = np.zeros((1, model.order, 1))
    none = Gains(k=k, l=no_injection)
    ratios = largest_settling_time_ratios(model, none, decays, 0.05)
    expected_ratios = pytest.approx([1.0])
    assert ratios == expected_ratios
    no_ratios = largest_settling_time_ratios(model, none, NO_DECAYS, 0.05)
    assert not no_ratios.any()
    u = trial.u + 1.0
    moving = replace(trial, u=u)
    simulated = simulate_decays(model, (moving,), (excited,))
    assert not len(simulated)
