"""Slopes of coverage: those of finite differences, what the latest ones predict, and a search that
they guide to covered gains of a model with neurons."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import assert_as_recorded
from structured_cases import drawn

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.robustness.coverage_items import DiscRequirement
from ssm_study.synthesis.coverage_slopes import (
    CoverageSample,
    GainCoordinates,
    predict_log_coverage,
    sample_coverage,
)
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_choice import LoopCoverage
from ssm_study.synthesis.measured_discs_program import ConeProgram
from ssm_study.synthesis.slope_search import ScoredGains, SlopeSearch
from ssm_study.systems import JacobianBall, JacobianBalls

CENTRE = 0.0
INPUT_BALL = JacobianBall.from_slopes(0.6, 1.0)
OUTPUT_BALL = JacobianBall(alpha=0.8, beta=0.0)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)
ASKED = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1, input_weight=1.0)
STEP = 0.02


def requirement(angle: float, seen: float) -> DiscRequirement:
    """One line of a record with as much power in the model's output as in the input."""
    angles = np.array([angle])
    power = np.ones(1)
    names = {"record": "record", "place": "line", "is_band": True, "dark": False}
    return DiscRequirement(angles=angles, model_power=power, input_power=power, seen=seen, **names)


@pytest.fixture(scope="module")
def design():
    system = drawn(0)
    no_slopes = np.zeros(system.neurons)
    linear = system.linearise_at_slopes(no_slopes)
    model = SimpleNamespace(system=system, linear=linear)
    made = ASKED.design(model, BALLS)
    assert made.certified
    return system, made


@pytest.fixture(scope="module")
def loop(design) -> LoopCoverage:
    system, _ = design
    context = VerificationContext(system=system, controlled=system, balls=BALLS, gains={})
    items = tuple(requirement(angle, 0.3) for angle in (0.1, 0.5, 1.0, 2.0, 3.0))
    return LoopCoverage(context=context, items={CENTRE: items}, deciding={})


@pytest.fixture(scope="module")
def coordinates(design) -> GainCoordinates:
    _, made = design
    return GainCoordinates(first=made.gain_pair)


def sample_at(loop, coordinates, position) -> CoverageSample:
    sample = sample_coverage(loop, coordinates, position, CENTRE)
    assert sample is not None
    return sample


def test_coordinates_scale_every_entry(coordinates) -> None:
    factors = np.arange(1.0, coordinates.entry_count + 1)
    position = np.log(factors)
    moved = coordinates.gains_at(position)
    first_k = coordinates.first.k
    ratios = moved.k / first_k
    np.testing.assert_allclose(ratios.ravel(), factors[: first_k.size])


def test_slopes_are_those_of_finite_differences(loop, coordinates) -> None:
    at_origin = sample_at(loop, coordinates, np.zeros(coordinates.entry_count))
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = rng.standard_normal(coordinates.entry_count)
        direction /= np.linalg.norm(direction)
        ends = []
        for step in (STEP, -STEP):
            sample = sample_at(loop, coordinates, step * direction)
            ends.append(sample.log_coverage)
        slope = (ends[0] - ends[1]) / (2 * STEP)
        expected = at_origin.slopes @ direction
        assert slope == pytest.approx(expected, abs=0.05)


def test_the_smallest_prediction_counts_and_none_denies_what_the_best_one_has() -> None:
    one = np.ones(1)
    best = CoverageSample(position=0 * one, log_coverage=0.0, slopes=one)
    falling = CoverageSample(position=one, log_coverage=0.5, slopes=-one)
    too_low = CoverageSample(position=one, log_coverage=-3.0, slopes=0 * one)
    positions = np.array([[0.2], [1.0]])
    by_falling = predict_log_coverage([best, falling], best, positions)
    np.testing.assert_allclose(by_falling, [0.2, 0.5])
    by_too_low = predict_log_coverage([best, too_low], best, positions)
    np.testing.assert_allclose(by_too_low, [0.0, 0.0])


def size_of_gain(gains) -> float:
    sizes = np.abs(gains.k)
    return float(sizes.sum())


def guided_search(loop, aimed_coverage: float) -> tuple[SlopeSearch, list[int]]:
    """Search in which the area is the size of the controller's gain; how many are simulated."""
    simulated = []

    def areas(some):
        simulated.append(len(some))
        return [size_of_gain(gains) for gains in some]

    random = np.random.default_rng(0)
    search = SlopeSearch(
        loop=loop,
        centre=CENTRE,
        aimed_coverage=aimed_coverage,
        largest_area=1e3,
        response_areas=areas,
        is_acceptable=lambda _: True,
        evaluations=8,
        random=random,
    )
    return search, simulated


@pytest.mark.parametrize("share", [1.2, 0.9])
def test_a_guided_search_covers_more_and_then_lowers_the_area(loop, coordinates, share) -> None:
    at_origin = sample_at(loop, coordinates, np.zeros(coordinates.entry_count))
    coverage = float(np.exp(at_origin.log_coverage))
    area = size_of_gain(coordinates.first)
    start = ScoredGains(gains=coordinates.first, area=area, coverage=coverage)
    search, simulated = guided_search(loop, share * coverage)
    best = search.search_from(start)
    assert best.coverage >= share * coverage
    assert simulated
    matrices = best.gains.matrices_by_symbol
    again = loop.largest_disc_radius_at_centre(matrices, CENTRE)
    assert again == pytest.approx(best.coverage, rel=5e-3)
    if share < 1:
        assert best.area < area


def test_gains_that_may_not_be_deployed_are_never_taken(loop, coordinates) -> None:
    start = ScoredGains(gains=coordinates.first, area=1.0, coverage=0.1)
    search, _ = guided_search(loop, 1e3)
    search.is_acceptable = lambda _: False
    assert search.search_from(start) is start


def test_without_slopes_at_its_start_the_guided_search_finds_nothing(
    loop, coordinates, monkeypatch
) -> None:
    start = ScoredGains(gains=coordinates.first, area=1.0, coverage=0.1)
    search, simulated = guided_search(loop, 1e3)
    monkeypatch.setattr("ssm_study.synthesis.slope_search.sample_coverage", lambda *_: None)
    assert search.search_from(start) is None
    assert simulated == []


def test_a_sample_has_the_recorded_numbers(loop, coordinates) -> None:
    position = np.zeros(coordinates.entry_count)
    unused = replace(loop, deciding={})  # frequencies of earlier tests would be solved first
    sample = sample_at(unused, coordinates, position)
    assert_as_recorded("coverage_slopes", sample, 1e-2)


def test_a_loop_that_tolerates_almost_everything_is_solved_without_clarabel(
    loop, coordinates, monkeypatch
) -> None:
    """Ten times the recorded error is all that is looked for, with multipliers as small as can
    be."""

    def refuse(*_):
        raise AssertionError("the interior-point method has not converged")

    monkeypatch.setattr(ConeProgram, "minimise", refuse)
    items = tuple(requirement(angle, 1e-3) for angle in (0.1, 1.0, 3.0))
    quiet = replace(loop, items={CENTRE: items}, deciding={})
    matrices = coordinates.first.matrices_by_symbol
    optimum = quiet.radius_optimum_at_centre(matrices, CENTRE)
    assert optimum.radius == pytest.approx(10.0, rel=1e-4)
    assert np.abs(optimum.unknowns).max() < 1e4
