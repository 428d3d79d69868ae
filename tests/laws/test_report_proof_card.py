"""The card of the proof says what is covered and what is not, and how the shown starts lie."""

from typing import Any

import numpy as np

from ssm_study.report.page.first_screen import closed_loop_card
from ssm_study.report.page.proof_card import ShownLoop, certified_rates_card, proved_starts_text

LOOP = ShownLoop(
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
    text = " ".join(card.lines)
    assert "between -4.9 and 4.97 V: this rate from rest at outputs between -0.131 and" in text
    assert "0.131 rad/s, from everywhere no rate is proved" in text
    assert "20 % or more a sample (10 ms)" in text, "a rate is of squared distances"
    limited = certified_rates_card(certified(limited_rate=0.02))
    assert limited is not None
    assert "from everywhere the rate 0.02" in " ".join(limited.lines)


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


def test_the_card_of_the_loop_says_how_many_starts_the_proof_reaches() -> None:
    card = closed_loop_card(certified(stable_count=4.0, initial_conditions=4.0), LOOP)
    assert card is not None
    (line,) = card.lines
    assert line.startswith("2 of the 4 starts lie where the proof holds with a limited input")
    assert line.endswith("the input stayed within the limits (-3 to 4 V)")
    assert "went beyond" in proved_starts_text(certified(limit_upper=3.9), LOOP)
    assert proved_starts_text(certified(unlimited_from=None), LOOP) == ""
    assert proved_starts_text(certified(), None) == "", "no recording, no count"
