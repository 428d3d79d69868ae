"""The search for covered gains: it covers more, its gains are certified, it ends without a design
where none is covered, and the choice turns to it only where the grid does not reach."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import assert_as_recorded

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "oracles"))
from test_coverage import BALLS, MODEL, design, premise, records, scaled_model

from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.synthesis.covered_gains import GainSearch, is_worth_another_round
from ssm_study.synthesis.measured_discs_choice import (
    COVERED,
    NEAR,
    NOT_COVERED,
    OVERESTIMATE,
    SEARCHED,
    choose_covering_design,
    tolerated_disc_radius,
)
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate, coverage_columns
from ssm_study.synthesis.slope_search import ScoredGains, SlopeSearch

SSM_MODEL = SSM.from_linear(MODEL, 0.01)
SHARE = 0.2  # by which the plant answers more than its model
RECORDS = records(scaled_model(SHARE))
PREMISE = premise(scaled_model(SHARE))
FAST = design(input_weight=1e-3)
AREA_TOO_LARGE = 0.99
TARGET_SHARE = 1.05  # of the coverage of the first gains


@pytest.fixture(scope="module")
def search() -> GainSearch:
    mismatch = measure_model_error(SSM_MODEL, RECORDS)
    validation = RECORDS[:1]
    return GainSearch(
        model=SSM_MODEL,
        balls=BALLS,
        premise=PREMISE,
        mismatch=mismatch,
        validation=validation,
        limits=None,
        margin=1.0,
    )


@pytest.fixture(scope="module")
def coverage_of_grid() -> float:
    return tolerated_disc_radius(FAST, SSM_MODEL, BALLS, PREMISE)


@pytest.fixture(scope="module")
def improved(search, coverage_of_grid):
    return search.improve_design(
        FAST, TARGET_SHARE * coverage_of_grid, rounds=4, largest_area=AREA_TOO_LARGE
    )


def test_gains_around_the_grid_cover_more_and_are_certified(improved, coverage_of_grid) -> None:
    assert improved.certified
    by_frequency = tolerated_disc_radius(improved, SSM_MODEL, BALLS, PREMISE)
    assert by_frequency >= TARGET_SHARE * coverage_of_grid  # as the certificate does, below
    proved = add_coverage_certificate(improved, SSM_MODEL, BALLS, PREMISE)
    facts = coverage_columns(proved, SSM_MODEL, PREMISE)
    assert facts["coverage"] >= TARGET_SHARE * coverage_of_grid


def test_the_search_gives_the_same_gains_again(search) -> None:
    first, again = (search.search_best_gains(FAST, 1e4, 1, AREA_TOO_LARGE) for _ in range(2))
    assert first.coverage == again.coverage
    actual = first.gains.k
    expected = again.gains.k
    np.testing.assert_array_equal(actual, expected)
    gains_k = first.gains.k
    pair_k = FAST.gain_pair.k
    assert not np.array_equal(gains_k, pair_k)


def test_without_slopes_gains_are_searched_at_random(search, monkeypatch) -> None:
    at_random = search.search_best_gains(FAST, 1e4, 1, AREA_TOO_LARGE)
    asked = []
    monkeypatch.setattr(SlopeSearch, "search_from", lambda _, start: asked.append(start))
    structured = type(SSM_MODEL.system)
    monkeypatch.setattr("ssm_study.synthesis.covered_gains.StructuredSystem", structured)
    found = search.search_best_gains(FAST, 1e4, 1, AREA_TOO_LARGE)
    assert len(asked) == 1
    assert found.coverage == at_random.coverage > asked[0].coverage


def test_where_nothing_covers_the_search_has_no_design(search) -> None:
    assert search.improve_design(FAST, 1e4, rounds=1, largest_area=AREA_TOO_LARGE) is None


def test_covered_gains_are_made_faster_and_stay_covered(search, coverage_of_grid) -> None:
    target = 0.8 * coverage_of_grid
    slow = design(input_weight=30.0)
    faster = search.improve_design(slow, target, rounds=2, largest_area=AREA_TOO_LARGE)
    assert search.response_area(faster.gain_pair) < search.response_area(slow.gain_pair)
    assert tolerated_disc_radius(faster, SSM_MODEL, BALLS, PREMISE) >= target


@pytest.mark.parametrize(
    ("share_of_coverage", "cover", "searches"),
    [(0.8, None, True), (0.5, None, True), (0.5, 1.0, True), (1.1, None, False)],
)
def test_the_choice_searches_only_where_the_grid_does_not_cover(
    monkeypatch, share_of_coverage, cover, searches
) -> None:
    coverage = share_of_coverage * OVERESTIMATE
    monkeypatch.setattr(
        "ssm_study.synthesis.measured_discs_choice.tolerated_disc_radius", lambda *_: coverage
    )
    asked = []
    found = design(input_weight=1.0)

    def note(first, most, target):
        asked.append((first, most, target))
        return found

    pairs = iter([FAST])
    chosen = choose_covering_design(pairs, lambda one: one, SSM_MODEL, BALLS, PREMISE, cover, note)
    if searches:
        assert chosen == (found, SEARCHED)
        expected = [(FAST, FAST, 1.0)]
        assert asked == expected
    else:
        assert chosen == (FAST, COVERED)
        assert not asked


@pytest.mark.parametrize("searches", [True, False])
def test_a_covered_pair_from_far_down_the_order_is_made_faster(monkeypatch, searches) -> None:
    slow = design(input_weight=1.0)
    monkeypatch.setattr(
        "ssm_study.synthesis.measured_discs_choice.tolerated_disc_radius",
        lambda one, *_: 1.1 * OVERESTIMATE if one is slow else 0.5,
    )
    found = design(input_weight=0.1)
    asked = []

    def search(first, most, wanted):
        asked.append((first, most, wanted))
        return found if searches and most is slow else None

    def make(place):
        return slow if place > NEAR else FAST

    pairs = iter(range(400))
    chosen = choose_covering_design(pairs, make, SSM_MODEL, BALLS, PREMISE, None, search)
    assert chosen == ((found, SEARCHED) if searches else (slow, COVERED))
    assert asked == [(FAST, FAST, 1.0), (FAST, slow, 1.0)]


def test_a_search_without_a_design_leaves_the_first(monkeypatch) -> None:
    monkeypatch.setattr(
        "ssm_study.synthesis.measured_discs_choice.tolerated_disc_radius",
        lambda *_: 0.9 * OVERESTIMATE,
    )
    pairs = iter([FAST])
    chosen = choose_covering_design(
        pairs, lambda one: one, SSM_MODEL, BALLS, PREMISE, None, lambda *_: None
    )
    assert chosen == (FAST, NOT_COVERED)


def test_rounds_beyond_those_planned_follow_only_while_they_would_reach_the_target() -> None:
    steady = [0.6, 0.7, 0.8]
    assert is_worth_another_round(steady[:2], 2.0, rounds=2)  # the planned ones always follow
    assert is_worth_another_round(steady, 1.05, rounds=2)
    assert not is_worth_another_round(steady, 1.1, rounds=2)  # 0.8 * 0.8 / 0.6 is 1.07
    assert not is_worth_another_round([0.6, 0.7, 1.1], 1.05, rounds=2)
    assert not is_worth_another_round([0.0, 0.0, 0.0], 1.05, rounds=2)


def test_gains_that_fall_short_of_the_aim_but_not_of_the_target_are_proved(
    search, coverage_of_grid
) -> None:
    target = coverage_of_grid / 1.01  # the search aims at 1.02 times the target
    kept = search.improve_design(FAST, target, rounds=0, largest_area=AREA_TOO_LARGE)
    assert search.proved_coverage(kept) >= target


def test_gains_whose_proof_fell_short_are_not_proved_again(
    search, coverage_of_grid, monkeypatch
) -> None:
    proved = []

    def coverage_short_of_target(_search, design) -> float:
        proved.append(design)
        return 0.5 * coverage_of_grid

    monkeypatch.setattr(GainSearch, "proved_coverage", coverage_short_of_target)
    target = coverage_of_grid / 1.05  # the aim is met by the gains at the start
    kept = search.improve_design(FAST, target, rounds=0, largest_area=AREA_TOO_LARGE)
    assert kept is None
    assert len(proved) == 1


def test_a_grid_without_a_design_is_given_up_after_its_near_pairs() -> None:
    tried = []

    def make(place):
        tried.append(place)

    chosen = choose_covering_design(iter(range(400)), make, SSM_MODEL, BALLS, PREMISE, None)
    assert chosen[0] is None
    assert tried == list(range(NEAR + 1))


@pytest.mark.parametrize(("proved", "takes_faster"), [(1.01, True), (0.99, False)])
def test_covered_gains_are_left_only_for_faster_ones_with_a_proof(proved, takes_faster) -> None:
    faster = design(input_weight=0.1)
    found = ScoredGains(gains=faster.gain_pair, area=0.5, coverage=1.1)
    stub = SimpleNamespace(
        model=SSM_MODEL,
        response_area=lambda _: 0.9,
        search_best_gains=lambda *_: found,
        certify_gains=lambda *_: faster,
        proved_coverage=lambda _: proved,
    )
    taken = GainSearch._faster_design(stub, FAST, 1.0, 8)
    assert taken is (faster if takes_faster else FAST)


def test_the_improved_gains_are_the_recorded_ones(improved) -> None:
    sides = [improved.state_feedback, improved.observer]
    assert_as_recorded("covered_gains", sides, 1e-3)
