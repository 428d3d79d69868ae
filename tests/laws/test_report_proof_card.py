"""The card of the proof says what is covered and what is not, and how the shown starts lie."""

from dataclasses import replace
from typing import Any

import numpy as np

from ssm_study.report.outcome import proved_rows
from ssm_study.report.page.first_screen import closed_loop_card
from ssm_study.report.page.proof_card import (
    RecordedLoopFacts,
    certified_rates_card,
    exceeded_limits_text,
    input_limit_text,
)
from ssm_study.report.run_facts import RunFacts

LOOP = RecordedLoopFacts(
    initial_outputs=np.array([[0.1], [-0.13], [0.14], [3.0]]),
    input_range=(-3.0, 4.0),
    output_unit="rad/s",
    input_unit="V",
    step_s=0.01,
)


def certified(**values: Any) -> dict[str, Any]:
    record = {"controller_certified_rate": 0.36149, "controller_certified": True}
    record |= {"observer_certified": True, "limit_lower": -4.9, "limit_upper": 4.97}
    record |= {"unlimited_from": -0.1309, "unlimited_to": 0.1309}
    return record | values


def test_the_card_of_the_proof_says_within_which_limits_it_holds() -> None:
    card = certified_rates_card(certified(), LOOP)
    assert card is not None
    assert card.number == "0.361"
    assert card.text.startswith("certified rate per sample, to 37 % in 0.045 s; with")
    assert "between -4.9 and 4.97 V only from rest at outputs between -0.131 and 0.131" in card.text
    assert "where 2 of the 4 starts shown lie; from everywhere no rate is proved" in card.text
    text = " ".join(card.lines)
    assert "20 % or more a sample (10 ms)" in text, "a rate is of squared distances"
    limited = certified_rates_card(certified(limited_rate=0.02))
    assert limited is not None
    assert limited.text.endswith("from everywhere the rate 0.02, to 37 % in 99 samples")
    no_gain = input_limit_text(certified(limited_rate=0.02, spectral_radius=0.98), LOOP)
    assert no_gain.endswith(
        "from everywhere the rate 0.02, to 37 % in 0.99 s (no more than without control)"
    )


def test_what_the_proof_does_not_cover_is_a_list() -> None:
    card = certified_rates_card(certified(coverage=1.068), LOOP)
    assert card is not None
    excluded = " ".join(card.not_covered)
    assert "exceeds 1.06 times what the records show" in excluded
    assert "starts outside -0.131 to 0.131 rad/s: 2 of the 4 shown" in excluded
    for word in ("noise", "disturbances", "set points", "frequency zero"):
        assert word in excluded
    for coverage in (None, 0.9):
        bare = certified_rates_card(certified(coverage=coverage), LOOP)
        assert bare is not None
        assert bare.not_covered[0].startswith("the plant: ")
    infeasible = certified_rates_card({"rate_controller": 0.4, "controller_rate_limit": 0.2}, LOOP)
    assert infeasible is not None
    assert infeasible.not_covered == (), "nothing is proved, so no list of exceptions"


def test_outputs_that_count_as_settled_are_no_starts_that_a_proof_reaches() -> None:
    wide = replace(LOOP, settling_band=0.2)
    assert (
        "all within the settling band of ±0.2 rad/s, where 2 of the 4 starts"
        in input_limit_text(certified(), wide)
    )
    assert "settling band" not in input_limit_text(certified(), replace(LOOP, settling_band=0.1))
    elsewhere = replace(LOOP, settling_band=0.2, output_at_rest=1.0)
    assert "settling band" not in input_limit_text(certified(), elsewhere)
    assert "settling band" not in input_limit_text(certified(), LOOP), "an old recording has none"


def test_the_card_says_where_the_proved_rate_shows_no_gain() -> None:
    slow = {"controller_certified_rate": 0.009755, "spectral_radius": 0.98484, "neurons": 5}
    log = certified(**slow, faster_than_open_loop=True)
    card = certified_rates_card(log, LOOP)
    assert card is not None
    words = card.lines[0]
    assert words.startswith("Without control the model's linear part contracts at rates below 0.03")
    assert words.endswith("shows no gain, and the speed-up seen is not proved")
    rows = {label: words for _, label, words in proved_rows(log, RunFacts(step_s=0.01))}
    assert rows["Speed-up"] == words, "the terminal says it, too"
    fast = certified_rates_card(certified(spectral_radius=0.98), LOOP)
    assert fast is not None
    assert "Without control" not in " ".join(fast.lines)


def test_how_far_the_plant_left_the_bound_of_the_model_is_said() -> None:
    record = certified(
        certified_bound_excess_plant=0.0697, noise_gain_measured=0.0, loop_on="plant"
    )
    card = certified_rates_card(record, LOOP)
    assert card is not None
    (line,) = [line for line in card.not_covered if "bound" in line]
    assert "of the model without noise: the estimate on the plant, with sensor noise" in line
    assert line.endswith("exceeded it by up to 7 % of its value at the start")
    for other in ({"certified_bound_excess_plant": 0.0}, {"loop_on": "identified model"}):
        quiet = certified_rates_card(record | other, LOOP)
        assert quiet is not None
        assert "bound" not in " ".join(quiet.not_covered)


def test_on_a_log_the_limited_input_is_not_covered() -> None:
    log = {"limit_lower": None, "unlimited_from": None, "loop_on": "identified model", "neurons": 5}
    card = certified_rates_card(certified(**log), LOOP)
    assert card is not None
    assert any("here to the range of the records" in line for line in card.not_covered)


def test_the_card_of_the_loop_says_where_the_input_left_its_limits() -> None:
    record = certified(stable_count=4.0, initial_conditions=4.0)
    card = closed_loop_card(record, LOOP)
    assert card is not None
    assert card.lines == ("The input, -3 to 4 V, stayed within the limits of the proof",)
    beyond = closed_loop_card(record | {"limit_upper": 3.9}, LOOP)
    assert beyond is not None
    assert beyond.text == "starts settle without input limits"
    assert "loop.input_lower and loop.input_upper apply them" in beyond.lines[0]
    actual = exceeded_limits_text(certified(limit_lower=None), LOOP)
    assert actual == ""
    assert exceeded_limits_text(certified(), None) == "", "no recording, no range"
