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
    return next(dict(record) for record in RECORDS if record["status"] == status)


def test_no_line_is_longer_than_80_columns_whatever_the_run() -> None:
    for record in RECORDS:
        lines = printed(record).splitlines()
        largest = max(len(line) for line in lines)
        assert largest <= 80


def test_a_rate_stands_beside_its_time_constant() -> None:
    """In seconds where the sampling time is known: `-2 step / log(1 - rate)`, rounded up."""
    record = a_run("ok") | {"controller_certified_rate": 0.188, "observer_certified_rate": None}
    rows = dict(row[1:] for row in proved_rows(record, RunFacts(step_s=0.01)))
    exact = -2 * 0.01 / math.log(1 - 0.188)
    assert 0.096 < exact < 0.097
    assert rows["Controller rate"].startswith("0.188 per sample (Theorem 1), to 37 % in 0.097 s; ")
    rows = dict(row[1:] for row in proved_rows(record, RunFacts()))
    assert "to 37 % in 9.7 samples" in rows["Controller rate"]
    assert "37" not in rows["Observer rate"]


def test_why_the_exported_code_follows_no_set_points_is_one_line() -> None:
    reason = "the model integrates"
    record = a_run("ok")
    rows = dict(row[1:] for row in proved_rows(record, RunFacts(no_set_points_reason=reason)))
    assert rows["Exported, set points"] == "none: the model integrates"
    assert "Exported, set points" not in dict(row[1:] for row in proved_rows(record, RunFacts()))


@pytest.mark.parametrize(
    ("level", "reasons", "words"),
    [
        ("sound", None, "sound"),
        ("sound", "note: One amplitude.", "sound, 1 note (ssm-study show RUN)"),
        ("sound", "note: A. note: C.", "sound, 2 notes (ssm-study show RUN)"),
        ("doubt", "doubt: A. note: B.", "doubt"),
    ],
)
def test_sound_evidence_says_where_its_notes_are(
    level: str, reasons: str | None, words: str
) -> None:
    record = a_run("ok") | {"evidence": level, "evidence_reasons": reasons}
    rows = dict(row[1:] for row in prediction_rows(record))
    assert rows["Evidence"] == words


def test_plain_in_a_pipe_and_coloured_on_a_terminal() -> None:
    assert "\x1b[" not in printed(a_run("ok"))
    assert "\x1b[" in printed(a_run("ok"), terminal=True)


def test_an_outcome_that_cannot_be_judged_is_no_success_in_its_colour() -> None:
    bold_yellow = "\x1b[1;33m"
    run = a_run("ok")
    run |= {"stable_count": run["initial_conditions"], "stable_fraction": 1.0}
    record = run | {"evidence": "sound"}
    assert bold_yellow not in printed(record, terminal=True)
    record = run | {"evidence": "cannot judge"}
    assert bold_yellow in printed(record, terminal=True)


def test_every_number_of_the_argument_is_there() -> None:
    record = a_run("ok") | {"fit_test_percent": 91.27, "stable_count": 9, "initial_conditions": 10}
    record |= {
        "settling_time_mean_s": 0.07,
        "settling_time_open_loop_s": 0.21,
        "controller_rate_limit": 0.3141,
    }
    text = printed(record)
    for words in (
        "91.3 %",
        "9 of 10",
        "ratio 0.33",
        "at most 0.314: certified",
        "MODEL",
        "PROVED",
        "PREDICTED",
        "SEEN",
        "Prediction",
        "Slopes of S_u",
    ):
        assert words in text, words


def test_where_nothing_settles_uncontrolled_the_settling_time_is_still_printed() -> None:
    record = a_run("ok") | {"settling_time_mean_s": 6.9, "settling_time_open_loop_s": None}
    assert "6.900 s, uncontrolled none settles" in printed(record)
    assert "Mean settling time" not in printed(record | {"settling_time_mean_s": None})


def test_it_says_who_chose_each_rate() -> None:
    record = a_run("ok") | {
        "synthesis_method": "auto",
        "rates_chosen": "observer",
        "rate_controller": 0.123,
    }
    text = printed(record)
    assert "0.123 requested, at most" in text
    assert "0.2 chosen by auto, at most" in text


def test_a_loop_on_the_model_and_an_official_score_are_said() -> None:
    record = a_run("ok") | {
        "loop_on": "identified model",
        "benchmark": "emps",
        "score_test_1": 4.21,
    }
    text = printed(record)
    assert "SEEN on the identified model" in " ".join(text.split())
    assert "Score, record 1 4.21 mm" in " ".join(text.split())


def test_a_run_that_settles_on_the_model_alone_is_not_said_to_settle_on_the_plant() -> None:
    settled = a_run("ok") | {
        "controller_certified": True,
        "observer_certified": True,
        "stable_fraction": 1.0,
    }
    for loop_on, more in (
        ("identified model", ", on the identified model"),
        ("plant", ""),
        (None, ""),
    ):
        for fraction in (1.0, 0.5):
            record = settled | {"loop_on": loop_on, "stable_fraction": fraction}
            text = printed(record).split("MODEL")[0]
            expected = bool(more) and fraction == 1.0
            assert (", on the identified model" in " ".join(text.split())) is (expected)


def test_the_prediction_says_what_it_rests_on() -> None:
    known = {"predicted_stable": True, "resolved_margin": 1.241, "controller_radius": 0.9312}
    for stable, words in ((True, "stays stable"), (False, "not predicted to be stable")):
        record = a_run("ok") | known | {"predicted_stable": stable}
        text = " ".join(printed(record).split())
        assert (
            f"Prediction for the plant {words}: stability margin 1.24 > 1, {RADIUS} 0.931 < 1"
            in text
        )
    record = a_run("ok") | known | {"resolved_margin": 0.98, "controller_radius": 1.0}
    missed = " ".join(printed(record).split())
    assert f"stability margin 0.98 ≤ 1, {RADIUS} 1 ≥ 1" in missed
    record = a_run("ok") | known | {"predicted_stable": False, "noise_peak": 1.562}
    noisy = " ".join(printed(record).split())
    assert f"{RADIUS} 0.931 < 1, the noise reaches 1.56 ≥ 1 of the band" in noisy


def test_a_path_is_never_broken() -> None:
    figures_path = Path("results") / ("long_" * 20) / "figures"
    path = figures_path / "closed_loop_responses.png"
    lines = printed(a_run("ok"), path, path.with_suffix(".pdf")).splitlines()
    assert lines[-1] == f"  {path}, .pdf"


def test_a_failed_run_shows_its_message_and_no_empty_lines() -> None:
    record = a_run("failed") | {"error_message": "model.order = 0: must be at least 1; use 8."}
    text = printed(record)
    assert "model.order = 0: must be at least 1; use 8." in text
    assert "Prediction" not in text


def test_a_run_without_certificate_shows_why() -> None:
    reason = "controller: tau 3.1; not positive definite in exact arithmetic"
    record = a_run("ok") | {"controller_certified": False, "uncertified_reason": reason}
    text = printed(record)
    assert "not certified" in text
    assert f"Uncertified reason: {reason}" in " ".join(text.split())


def test_an_infeasible_run_shows_the_rate_that_was_possible() -> None:
    record = a_run("infeasible") | {"controller_rate_limit": 0.0987}
    text = printed(record)
    assert "at most 0.0987: infeasible" in text


def test_with_neurons_it_says_that_nothing_is_proved_of_the_limits() -> None:
    record = a_run("ok") | {"neurons": 3, "controller_certified": True}
    assert "nothing is proved: the theorems on limits know no" in printed(record)
    assert "know no neurons" not in printed(record | {"neurons": 0})


def test_outputs_that_share_no_range_are_not_given_one() -> None:
    """Two levels that rest apart: `from outputs 6.54 to 6.26` would be of neither."""
    record = a_run("ok") | {"limit_lower": 2.16, "limit_upper": 4.14, "limited_rate": 0.1}
    told = " ".join(printed(record | {"unlimited_from": None, "unlimited_to": None}).split())
    assert (
        "input 2.16 to 4.14: contracts globally at 0.1 per sample, at the full rate from a "
        "range of each" in told
    )


def test_a_plant_that_moves_more_than_the_noise_can_move_it_is_told_so() -> None:
    """A limit cycle of 3.5 noise deviations stood beside `at most 1` without a word."""
    record = a_run("ok") | {"noise_gain_model": 1.0}
    for measured, told, doubted in ((1.7, True, False), (3.51, False, True), (0.9, False, False)):
        text = " ".join(printed(record | {"noise_gain_measured": measured}).split())
        assert ("more than noise moves it" in text) is told
        assert ("doubt, more than twice what the model predicts" in text) is doubted
    at_rest = " ".join(printed(record | {"noise_gain_measured": 0.0}).split())
    assert "does not move the output, the model's 1-fold" in at_rest


def test_fresh_data_stand_beside_what_is_proved() -> None:
    record = a_run("ok") | {"coverage": 1.256, "coverage_needed": 1.031, "fresh_sets": 3}
    expected = {
        "1.25 times as large as the records show, at every frequency above zero; 3 fresh data sets "
        "show at most 1.04 times": {},
        "; a fresh data set shows 1.04 times": {"fresh_sets": 1},
        "; the test record shows 1.04 times": {"fresh_sets": None},
        "; fresh data lie outside every such disc": {"coverage_needed": "inf"},
    }
    for words, change in expected.items():
        text = " ".join(printed(record | change).split())
        assert words in text


def test_records_that_trained_the_model_are_named_beside_what_they_show() -> None:
    remark = "the model was trained on these records"
    record = a_run("ok") | {"coverage": 1.256, "resolved_margin": 2.0}
    assert remark not in " ".join(printed(record).split())
    refitted = record | {"training_ended": f"100 epochs{REFIT_WORDS}"}
    text = " ".join(printed(refitted).split())
    assert text.count(remark) == 2
    assert remark in coverage_sentence(refitted)


def test_no_number_is_rounded_across_the_bound_it_is_compared_with() -> None:
    known = {"predicted_stable": True, "resolved_margin": 1.00004, "controller_radius": 0.99996}
    record = a_run("ok") | known
    text = " ".join(printed(record).split())
    assert f"stability margin 1.00004 > 1, {RADIUS} 0.99996 < 1" in text


def settled_run(**values: Any) -> dict[str, Any]:
    certified = {"controller_certified": True, "observer_certified": True}
    return a_run("ok") | certified | {"stable_fraction": 1.0, "evidence": "sound"} | values


def test_a_controller_that_is_no_faster_than_none_gets_no_word_of_success() -> None:
    for ratio, helped in ((0.5, True), (0.98, True), (1.0, False), (1.8, False)):
        record = settled_run(settling_time_open_loop_s=0.2, settling_time_mean_s=0.2 * ratio)
        text = " ".join(printed(record).split())
        assert ("certified, settles" in text) is helped
        assert ("certified, no faster than without control" in text) is not helped


def test_cannot_judge_stands_first() -> None:
    record = settled_run(evidence="cannot judge")
    text = " ".join(printed(record).split())
    outcome = text.partition("Outcome ")[2]
    assert outcome.startswith("cannot judge: the evidence allows no judgement")


def test_a_pi_that_is_faster_is_said_to_be() -> None:
    record = {"stable_count_pi": 4, "initial_conditions": 4, "settling_time_pi_s": 0.05}
    assert pi_comparison_text(record | {"settling_time_mean_s": 0.1}).endswith(
        "faster than the certified controller"
    )
    assert pi_comparison_text(record | {"settling_time_mean_s": 0.04}) == "0.050 s, 4 of 4"
    lost = record | {"stable_count_pi": 3, "settling_time_mean_s": 0.1}
    assert pi_comparison_text(lost) == "0.050 s, 3 of 4"
