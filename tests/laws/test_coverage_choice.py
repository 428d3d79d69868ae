"""The choice among designs: covered ones first, the first one where none is, and nothing else where
records say nothing."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from disturbance_cases import random_model

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "oracles"))
from test_coverage import BALLS, MODEL, design, premise, scaled_model, van_der_pol

from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.measured_discs_choice import (
    COVERED,
    LESS_COVERED,
    NOT_COVERED,
    PREDICTED,
    choose_covering_design,
    tolerated_disc_radius,
)
from ssm_study.synthesis.measured_discs_run import (
    add_coverage_certificate,
    chooses_gains_by_coverage,
    coverage_columns,
)
from ssm_study.synthesis.measured_discs_weights import LARGEST_AT_FREE_WEIGHTS

SSM_MODEL = SSM.from_linear(MODEL, 0.01)
FAST = design(input_weight=1e-3)
SLOW = design(input_weight=30.0)


def chosen(known, cover: float = 1.0, designs=(FAST, SLOW)):
    return choose_covering_design(iter(designs), lambda one: one, SSM_MODEL, BALLS, known, cover)


def test_the_first_covered_design_is_taken() -> None:
    known = premise(scaled_model(0.2))
    fast, slow = (tolerated_disc_radius(one, SSM_MODEL, BALLS, known) for one in (FAST, SLOW))
    assert slow > 1.2 * fast
    between = (slow * fast) ** 0.5
    expected = (SLOW, COVERED)
    assert chosen(known, between) == expected
    expected = (FAST, COVERED)
    assert chosen(known, 0.5 * fast) == expected
    assert chosen(known, 10 * slow)[1] in (NOT_COVERED, LESS_COVERED)


def test_a_coverage_is_looked_for_up_to_nine() -> None:
    assert Auto(cover=9.0).cover == 9.0
    with pytest.raises(BadRequest, match=r"synthesis\.cover = 9\.5: .*ask for at most 9"):
        Auto(cover=9.5)


def test_the_certificate_has_the_coverage_that_the_frequencies_promise() -> None:
    known = premise(scaled_model(0.2))
    for one in (FAST, SLOW):
        promised = tolerated_disc_radius(one, SSM_MODEL, BALLS, known)
        facts = coverage_columns(
            add_coverage_certificate(one, SSM_MODEL, BALLS, known), SSM_MODEL, known
        )
        assert facts["coverage"] > 0.94 * promised
        is_all = one is SLOW  # more than is looked for: a certificate may cover more than promised
        assert is_all == (promised**2 > 0.99 * LARGEST_AT_FREE_WEIGHTS)
        assert is_all or facts["coverage"] <= 1.001 * promised


def test_without_a_premise_the_choice_is_the_predicted_one() -> None:
    expected = (FAST, PREDICTED)
    assert chosen(None) == expected
    expected = (FAST, PREDICTED)
    assert chosen(premise(van_der_pol)) == expected
    designs = (None, SLOW)
    expected = (SLOW, PREDICTED)
    assert chosen(None, designs=designs) == expected
    assert chosen(None, designs=())[0] is None


def test_with_neurons_gains_are_chosen_by_coverage_where_noise_is_told_from_mismatch() -> None:
    """Or where a coverage is asked for; with one layer always."""
    known = premise(scaled_model(0.2))
    once = replace(known, repeating=())
    assert known.separates_noise
    assert not once.separates_noise
    neurons = random_model(0, neurons=True)
    assert chooses_gains_by_coverage(neurons, None, known)
    assert not chooses_gains_by_coverage(neurons, None, once)
    assert chooses_gains_by_coverage(neurons, 1.0, once)
    assert chooses_gains_by_coverage(SSM_MODEL, None, once)


def test_a_coverage_below_zero_is_no_request() -> None:
    with pytest.raises(BadRequest, match=r"synthesis\.cover"):
        Auto(cover=-1.0)


def test_where_less_is_covered_than_asked_for_a_covered_design_is_taken() -> None:
    known = premise(scaled_model(0.05))
    assert tolerated_disc_radius(SLOW, SSM_MODEL, BALLS, known) > 1.1
    expected = (SLOW, LESS_COVERED)
    actual = chosen(known, 1e4, designs=(SLOW,))
    assert actual == expected
    far_off = premise(scaled_model(5.0))
    expected = (FAST, NOT_COVERED)
    assert chosen(far_off, 1e4) == expected
