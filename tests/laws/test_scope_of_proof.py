"""Lines of a design's print that say where its proof ends."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import assert_as_recorded

import ssm_study as st
from ssm_study.api.design import Design
from ssm_study.api.scope_of_proof import (
    describe_deciding_band,
    describe_simulated_loop,
    requested_rate,
    smallest_coverage_band_text,
    unproved_properties_text,
)
from ssm_study.api.summaries import summarise_gain_certificate

ROWS_OF_A = [[0.9]]
A = np.array(ROWS_OF_A)
B = np.array([[1.0]])
C = np.array([[0.1]])
D = np.array([[0.0]])
LAG = (A, B, C, D, 1.0)
UNEXCITED = "note: The input has no power in 3 of 33 bands, from 0.25 Hz: the mismatch is unknown."


@pytest.fixture(scope="module")
def design() -> Design:
    return st.control(LAG, rate=0.3)


FREQUENCIES = [
    ("input of rms 0.98, around 2.36 rad/sample", "at 0.376 Hz"),
    ("input of rms 0.98, 0.31 to 0.63 rad/sample", "from 0.0493 to 0.1 Hz"),
    ("input of rms 0.98, around 0.00 rad/sample", "at the lowest frequencies"),
    ("input of rms 0.98, in total", ""),
]


@pytest.mark.parametrize(("reference", "words"), FREQUENCIES)
def test_a_frequency_is_given_in_hertz(reference: str, words: str) -> None:
    assert smallest_coverage_band_text(reference, 1.0) == words


def test_the_coverage_names_its_frequency_and_the_missing_power_there(design: Design) -> None:
    """The note of the evidence stands beside the coverage only from its first frequency on."""
    facts = {"coverage_reference": "input of rms 0.98, around 2.36 rad/sample"}
    reasons_of_record = {"evidence_reasons": UNEXCITED}
    record = facts | reasons_of_record
    loaded = replace(design, stored_record=record)
    words = describe_deciding_band(loaded)
    assert words.startswith(", decided at 0.376 Hz with an input of rms 0.98 input scales")
    assert words.endswith("(the input has no power in 3 of 33 bands, from 0.25 Hz)")
    facts["coverage_reference"] = "input of rms 0.98, around 1.00 rad/sample"
    loaded = replace(design, stored_record=facts | reasons_of_record)
    assert "no power" not in describe_deciding_band(loaded)
    reasons = "note: All records have one amplitude (0.97 input scales, rms)"
    other_reasons = {"evidence_reasons": reasons}
    other_record = facts | other_reasons
    loaded = replace(design, stored_record=other_record)
    assert describe_deciding_band(loaded) == ", decided at 0.159 Hz"


def test_what_was_simulated_is_said_with_its_means(design: Design) -> None:
    facts = {"initial_conditions": 10, "stable_count": 9, "loop_on": "identified model"}
    loaded = replace(design, stored_record=facts)
    assert describe_simulated_loop(loaded) == "on the identified model 9 of 10 starts settle"
    times = {"settling_time_mean_s": 3.6, "settling_time_open_loop_s": 30.9}
    loaded = replace(design, stored_record=facts | times)
    words = "settle, in 3.6 s on average (30.9 s without control)"
    assert describe_simulated_loop(loaded).endswith(words)


def test_a_plant_that_is_not_covered_is_not_proved_to_rest(design: Design) -> None:
    words = "that the plant itself comes to rest"
    too_little = {"coverage": 0.8}
    uncovered = replace(design, stored_record=too_little)
    unproved = unproved_properties_text(uncovered)
    assert words in unproved
    enough = {"coverage": 2.2}
    covered = replace(design, stored_record=enough)
    unproved_of_covered = unproved_properties_text(covered)
    assert words not in unproved_of_covered


def test_a_rate_other_than_the_requested_one_names_both(design: Design) -> None:
    """A rate that `auto` chose from records was asked for by nobody."""
    actual = requested_rate(design, "state_feedback")
    assert actual == 0.3
    chosen = replace(design, overrides=("synthesis=auto",))
    assert requested_rate(chosen, "state_feedback") is None
    words = ("synthesis=auto", "synthesis.rate_controller=0.4")
    with_rate = replace(design, overrides=words)
    assert requested_rate(with_rate, "state_feedback") == 0.4
    assert requested_rate(with_rate, "observer") is None
    part = design.certificate.state_feedback
    side = summarise_gain_certificate("controller", part, 0.48, 1.0, 0.4)
    line = side["controller"]
    assert line.startswith("rate 0.48 (asked 0.4) per sample (to 37 % in")
    side_at_the_rate = summarise_gain_certificate("controller", part, 0.4, 1.0, 0.4)
    line_at_the_rate = side_at_the_rate["controller"]
    assert "asked" not in line_at_the_rate
    assert "any gain: below" in line


def test_the_design_has_the_recorded_numbers(design: Design) -> None:
    assert_as_recorded("scope_of_proof", [design.certificate, str(design)], 1e-3)
