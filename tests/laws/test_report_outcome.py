"""The end-of-run table: 80 columns, plain in a pipe, coloured on a terminal, and never silent about
why."""

import io
import math
from pathlib import Path
from typing import Any

import pytest
import report_tables
from rich.console import Console

from ssm_study.report.outcome import (
    RunFacts,
    pi_comparison_text,
    prediction_rows,
    print_outcome,
    proved_rows,
)
from ssm_study.report.page.proof_card import coverage_sentence
from ssm_study.training.choice import REFIT_WORDS

RADIUS = "spectral radius of the controller"
TABLE = report_tables.table(30).astype(object)
RECORDS = TABLE.where(TABLE.notna(), None).to_dict("records")


def printed(record: dict[str, Any], *figures: Path, terminal: bool = False) -> str:
    stream = io.StringIO()
    color_system = "standard" if terminal else None
    console = Console(file=stream, width=200, force_terminal=terminal, color_system=color_system)
    print_outcome(record, figures, console)
    return stream.getvalue()


def a_run(status: str) -> dict[str, Any]:
    records = [record for record in RECORDS if record["status"] == status]
    return dict(records[0])


def printed_words(record: dict[str, Any]) -> str:
    """The printed outcome with all line breaks taken out."""
    words = printed(record).split()
    return " ".join(words)


def proved_values(record: dict[str, Any], facts: RunFacts) -> dict[str, str]:
    """The rows of what is proved: the value of each label."""
    rows = proved_rows(record, facts)
    return dict(row[1:] for row in rows)


def test_no_line_is_longer_than_80_columns_whatever_the_run() -> None:
    for record in RECORDS:
        lines = printed(record).splitlines()
        widths = [len(line) for line in lines]
        largest = max(widths)
        assert largest <= 80


def test_a_rate_stands_beside_its_time_constant() -> None:
    """In seconds where the sampling time is known: `-2 step / log(1 - rate)`, rounded up."""
    rates = {"controller_certified_rate": 0.188, "observer_certified_rate": None}
    record = a_run("ok") | rates
    values = proved_values(record, RunFacts(step_s=0.01))
    exact = -2 * 0.01 / math.log(1 - 0.188)
    assert 0.096 < exact < 0.097
    in_seconds = "0.188 per sample (Theorem 1), to 37 % in 0.097 s; "
    assert values["Controller rate"].startswith(in_seconds)
    values = proved_values(record, RunFacts())
    assert "to 37 % in 9.7 samples" in values["Controller rate"]
    assert "37" not in values["Observer rate"]


def test_why_the_exported_code_follows_no_set_points_is_one_line() -> None:
    reason = "the model integrates"
    record = a_run("ok")
    with_reason = proved_values(record, RunFacts(no_set_points_reason=reason))
    assert with_reason["Exported, set points"] == "none: the model integrates"
    without_reason = proved_values(record, RunFacts())
    assert "Exported, set points" not in without_reason


TWO_NOTES = "note: A. note: C."
NOTED_EVIDENCE = [
    ("sound", None, "sound"),
    ("sound", "note: One amplitude.", "sound, 1 note (ssm-study show RUN)"),
    ("sound", TWO_NOTES, "sound, 2 notes (ssm-study show RUN)"),
    ("doubt", "doubt: A. note: B.", "doubt"),
]


@pytest.mark.parametrize(("level", "reasons", "words"), NOTED_EVIDENCE)
def test_sound_evidence_says_where_its_notes_are(
    level: str, reasons: str | None, words: str
) -> None:
    evidence = {"evidence": level, "evidence_reasons": reasons}
    record = a_run("ok") | evidence
    rows = prediction_rows(record)
    values = dict(row[1:] for row in rows)
    assert values["Evidence"] == words


def test_plain_in_a_pipe_and_coloured_on_a_terminal() -> None:
    run = a_run("ok")
    assert "\x1b[" not in printed(run)
    assert "\x1b[" in printed(run, terminal=True)


def test_an_outcome_that_cannot_be_judged_is_no_success_in_its_colour() -> None:
    bold_yellow = "\x1b[1;33m"
    run = a_run("ok")
    all_stable = {"stable_count": run["initial_conditions"], "stable_fraction": 1.0}
    run |= all_stable
    record = run | {"evidence": "sound"}
    assert bold_yellow not in printed(record, terminal=True)
    record = run | {"evidence": "cannot judge"}
    assert bold_yellow in printed(record, terminal=True)


MEASURES = {"fit_test_percent": 91.27, "stable_count": 9, "initial_conditions": 10}
SETTLING_TIMES = {"settling_time_mean_s": 0.07, "settling_time_open_loop_s": 0.21}
PRINTED_NUMBERS = ("91.3 %", "9 of 10", "ratio 0.33", "at most 0.314: certified")
PRINTED_HEADS = ("MODEL", "PROVED", "PREDICTED", "SEEN", "Prediction", "Slopes of S_u")


def test_every_number_of_the_argument_is_there() -> None:
    record = a_run("ok") | MEASURES | SETTLING_TIMES
    record["controller_rate_limit"] = 0.3141
    text = printed(record)
    for words in (*PRINTED_NUMBERS, *PRINTED_HEADS):
        assert words in text, words


def test_where_nothing_settles_uncontrolled_the_settling_time_is_still_printed() -> None:
    times = {"settling_time_mean_s": 6.9, "settling_time_open_loop_s": None}
    record = a_run("ok") | times
    assert "6.900 s, uncontrolled none settles" in printed(record)
    never_settled = record | {"settling_time_mean_s": None}
    assert "Mean settling time" not in printed(never_settled)


def test_it_says_who_chose_each_rate() -> None:
    record = a_run("ok")
    record["synthesis_method"] = "auto"
    record["rates_chosen"] = "observer"
    record["rate_controller"] = 0.123
    text = printed(record)
    assert "0.123 requested, at most" in text
    assert "0.2 chosen by auto, at most" in text


def test_a_loop_on_the_model_and_an_official_score_are_said() -> None:
    record = a_run("ok")
    record["loop_on"] = "identified model"
    record["benchmark"] = "emps"
    record["score_test_1"] = 4.21
    text = printed_words(record)
    assert "SEEN on the identified model" in text
    assert "Score, record 1 4.21 mm" in text


ON_THE_MODEL = ", on the identified model"


@pytest.mark.parametrize("fraction", [1.0, 0.5])
@pytest.mark.parametrize("loop_on", ["identified model", "plant", None])
def test_a_run_that_settles_on_the_model_alone_is_not_said_to_settle_on_the_plant(
    loop_on: str | None, fraction: float
) -> None:
    record = a_run("ok")
    record["controller_certified"] = True
    record["observer_certified"] = True
    record["loop_on"] = loop_on
    record["stable_fraction"] = fraction
    outcome = printed(record).split("MODEL")[0]
    words = " ".join(outcome.split())
    is_on_the_model = loop_on == "identified model"
    all_settle = fraction == 1.0
    assert (ON_THE_MODEL in words) is (is_on_the_model and all_settle)


def test_the_prediction_says_what_it_rests_on() -> None:
    prediction = {"resolved_margin": 1.241, "controller_radius": 0.9312}
    known = a_run("ok") | prediction
    above = f"stability margin 1.24 > 1, {RADIUS} 0.931 < 1"
    stable = known | {"predicted_stable": True}
    assert f"Prediction for the plant stays stable: {above}" in printed_words(stable)
    unstable = known | {"predicted_stable": False}
    verdict = "Prediction for the plant not predicted to be stable"
    assert f"{verdict}: {above}" in printed_words(unstable)
    missed = stable | {"resolved_margin": 0.98, "controller_radius": 1.0}
    below = f"stability margin 0.98 ≤ 1, {RADIUS} 1 ≥ 1"
    assert below in printed_words(missed)
    noisy = unstable | {"noise_peak": 1.562}
    reached = f"{RADIUS} 0.931 < 1, the noise reaches 1.56 ≥ 1 of the band"
    assert reached in printed_words(noisy)


SINE_MARGINS = [(0.84, 1.24, True), (1.0, 1.24, True), (1.1, 1.24, False), (0.84, 1.0, False)]


def test_a_single_sine_takes_the_records_place_where_it_alone_refutes() -> None:
    run = a_run("ok") | {"predicted_stable": False}
    for of_sines, of_records, is_named in SINE_MARGINS:
        margins = {"sine_margin": of_sines, "resolved_margin": of_records}
        text = printed_words(run | margins)
        words = f"single sines show more than the other records (margin {of_sines:g}"
        assert (words in text) is is_named
        assert ("stability margin" in text) is not is_named


def test_a_path_is_never_broken() -> None:
    long_name = "long_" * 20
    figures_path = Path("results") / long_name / "figures"
    path = figures_path / "closed_loop_responses.png"
    vector_path = path.with_suffix(".pdf")
    lines = printed(a_run("ok"), path, vector_path).splitlines()
    assert lines[-1] == f"  {path}, .pdf"


def test_a_failed_run_shows_its_message_and_no_empty_lines() -> None:
    message = "model.order = 0: must be at least 1; use 8."
    record = a_run("failed") | {"error_message": message}
    text = printed(record)
    assert message in text
    assert "Prediction" not in text


def test_a_run_without_certificate_shows_why() -> None:
    reason = "controller: tau 3.1; not positive definite in exact arithmetic"
    uncertified = {"controller_certified": False, "uncertified_reason": reason}
    record = a_run("ok") | uncertified
    assert "not certified" in printed(record)
    assert f"Uncertified reason: {reason}" in printed_words(record)


def test_an_infeasible_run_shows_the_rate_that_was_possible() -> None:
    record = a_run("infeasible") | {"controller_rate_limit": 0.0987}
    text = printed(record)
    assert "at most 0.0987: infeasible" in text


def test_with_neurons_it_says_that_nothing_is_proved_of_the_limits() -> None:
    with_neurons = {"neurons": 3, "controller_certified": True}
    record = a_run("ok") | with_neurons
    known = "the theorems on limits know no neurons"
    assert known in printed_words(record)
    for other in ({"neurons": 0}, {"controller_certified": False}):
        assert known not in printed_words(record | other)


def test_only_a_run_from_the_log_before_is_said_to_be_one() -> None:
    words = ", run from the log before it"
    record = a_run("ok")
    assert words not in printed_words(record)
    assert words not in printed_words(record | {"piece_start": "samples"})
    assert words in printed_words(record | {"piece_start": "past"})


def test_a_coverage_that_is_withheld_is_not_called_none() -> None:
    record = a_run("ok") | {"coverage": None}
    withheld = record | {"coverage_reason": "withheld: few records"}
    assert "covered withheld: few records" in printed_words(withheld)
    none = record | {"coverage_reason": "few records"}
    assert "covered not covered: few records" in printed_words(none)


def test_outputs_that_share_no_range_are_not_given_one() -> None:
    """Two levels that rest apart: `from outputs 6.54 to 6.26` would be of neither."""
    limits = {"limit_lower": 2.16, "limit_upper": 4.14, "limited_rate": 0.1}
    no_range = {"unlimited_from": None, "unlimited_to": None}
    record = a_run("ok") | limits | no_range
    limited = "input 2.16 to 4.14: contracts globally at 0.1 per sample"
    unlimited = "at the full rate from a range of each"
    assert f"{limited}, {unlimited}" in printed_words(record)


NOISE_GAINS = [(1.7, True, False), (3.51, False, True), (0.9, False, False)]


def test_a_plant_that_moves_more_than_the_noise_can_move_it_is_told_so() -> None:
    """A limit cycle of 3.5 noise deviations stood beside `at most 1` without a word."""
    record = a_run("ok") | {"noise_gain_model": 1.0}
    for measured, is_larger, is_doubted in NOISE_GAINS:
        moved = record | {"noise_gain_measured": measured}
        text = printed_words(moved)
        assert ("more than noise moves it" in text) is is_larger
        doubt = "doubt, more than twice what the model predicts"
        assert (doubt in text) is is_doubted
    at_rest = record | {"noise_gain_measured": 0.0}
    assert "does not move the output, the model's 1-fold" in printed_words(at_rest)


THREE_SETS = (
    "1.25 times as large as the records show, at every frequency above zero; 3 fresh data sets "
    "show at most 1.04 times"
)
FRESH_DATA = {
    THREE_SETS: {},
    "; a fresh data set shows 1.04 times": {"fresh_sets": 1},
    "; the test record shows 1.04 times": {"fresh_sets": None},
    "; fresh data lie outside every such disc": {"coverage_needed": "inf"},
}


def test_fresh_data_stand_beside_what_is_proved() -> None:
    coverage = {"coverage": 1.256, "coverage_needed": 1.031, "fresh_sets": 3}
    record = a_run("ok") | coverage
    for words, change in FRESH_DATA.items():
        text = printed_words(record | change)
        assert words in text


def test_records_that_trained_the_model_are_named_beside_what_they_show() -> None:
    remark = "the model was trained on these records"
    coverage = {"coverage": 1.256, "resolved_margin": 2.0}
    record = a_run("ok") | coverage
    assert remark not in printed_words(record)
    refitted = record | {"training_ended": f"100 epochs{REFIT_WORDS}"}
    text = printed_words(refitted)
    assert text.count(remark) == 2
    assert remark in coverage_sentence(refitted)


def test_no_number_is_rounded_across_the_bound_it_is_compared_with() -> None:
    margins = {"resolved_margin": 1.00004, "controller_radius": 0.99996}
    record = a_run("ok") | {"predicted_stable": True, **margins}
    text = printed_words(record)
    assert f"stability margin 1.00004 > 1, {RADIUS} 0.99996 < 1" in text


def settled_run(**values: Any) -> dict[str, Any]:
    certified = {"controller_certified": True, "observer_certified": True}
    sound = {"stable_fraction": 1.0, "evidence": "sound"}
    return a_run("ok") | certified | sound | values


SETTLING_RATIOS = [(0.5, True), (0.98, True), (1.0, False), (1.8, False)]


def test_a_controller_that_is_no_faster_than_none_gets_no_word_of_success() -> None:
    for ratio, helped in SETTLING_RATIOS:
        settling_time_s = 0.2 * ratio
        record = settled_run(settling_time_open_loop_s=0.2, settling_time_mean_s=settling_time_s)
        text = printed_words(record)
        assert ("certified, settles" in text) is helped
        assert ("certified, no faster than without control" in text) is not helped


def test_cannot_judge_stands_first() -> None:
    record = settled_run(evidence="cannot judge")
    text = printed_words(record)
    outcome = text.partition("Outcome ")[2]
    assert outcome.startswith("cannot judge: the evidence allows no judgement")


def test_a_pi_that_is_faster_is_said_to_be() -> None:
    counts = {"stable_count_pi": 4, "initial_conditions": 4}
    record = {**counts, "settling_time_pi_s": 0.05}
    slower = record | {"settling_time_mean_s": 0.1}
    text = pi_comparison_text(slower)
    assert text.endswith("faster than the certified controller")
    faster = record | {"settling_time_mean_s": 0.04}
    assert pi_comparison_text(faster) == "0.050 s, 4 of 4"
    lost = slower | {"stable_count_pi": 3}
    assert pi_comparison_text(lost) == "0.050 s, 3 of 4"
