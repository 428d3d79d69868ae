"""Rows of the printed outcome one by one, at the edges of each case."""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from ssm_study.report.outcome import (
    MISSING,
    RunFacts,
    baseline_text,
    certificate_status_word,
    closed_loop_rows,
    coverage_rows,
    figure_lines,
    format_column,
    fresh_error_ratio_text,
    input_limit_rows,
    log_reading_text,
    loop_place_text,
    model_rows,
    noise_effect_text,
    outcome_reasons,
    outcome_text,
    pi_comparison_text,
    prediction_rows,
    print_outcome,
    proved_rows,
    unused_data_exceed_coverage,
)
from ssm_study.report.words import format_beside_bound

Record = dict[str, Any]


def labelled(rows: Iterable[tuple[str, str, str]]) -> dict[str, str]:
    """Value of each label."""
    return {label: value for _, label, value in rows}


# The place and the numbers.

PLACES: list[tuple[Record, str]] = []
PLACES.append(({"loop_on": "identified model"}, "identified model"))
PLACES.append(({"loop_on": "plant"}, "simulated plant"))
PLACES.append(({"loop_on": "rig"}, "rig"))
PLACES.append(({"loop_on": None, "plant": None}, "identified model"))
PLACES.append(({"loop_on": None, "plant": "motor"}, "simulated plant"))
PLACES.append(({"loop_on": "plant", "plant": None}, "simulated plant"))
PLACES.append(({}, "simulated plant"))


@pytest.mark.parametrize(("record", "place"), PLACES)
def test_a_log_without_a_loop_has_no_plant(record: Record, place: str) -> None:
    assert loop_place_text(record) == place


def test_numbers_have_their_unit_and_missing_ones_a_dash() -> None:
    record = {"a": 0.12345, "b": 3, "c": "inf", "d": None}
    texts = [format_column(record, name, ".2f", " V") for name in "abcde"]
    expected = ["0.12 V", "3.00 V", "inf", MISSING, MISSING]
    assert texts == expected


@given(st.floats(0.5, 2.0))
def test_no_number_changes_sides_of_its_bound(value: float) -> None:
    printed = float(format_beside_bound(value))
    assert (printed < 1) == (value < 1)
    assert (printed > 1) == (value > 1)


def test_figures_of_one_stem_share_a_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    names = ("one.png", "two.png", "one.pdf")
    paths = [Path.cwd() / "figures" / name for name in names]
    expected = ["figures/one.png, .pdf", "figures/two.png"]
    assert figure_lines(paths) == expected


# The model.

BASELINES: list[tuple[Record, str]] = []
BASELINES.append(({"fit_test_percent": 89.9}, "90.1 %, ARX: it predicts better than this model"))
BASELINES.append(
    (
        {"fit_test_percent": 0.0, "fit_baseline_percent": 0.1},
        "0.1 %, ARX: it predicts better than this model",
    )
)
BASELINES.append(({"fit_test_percent": 90.05}, "90.1 %, ARX"))
BASELINES.append(({"fit_test_percent": None}, "90.1 %, ARX"))
BASELINES.append(
    ({"fit_baseline_highest_percent": 91.0, "fit_baseline_lowest_percent": 86.1}, "90.1 %, ARX")
)
BASELINES.append(
    (
        {"fit_baseline_highest_percent": 91.0, "fit_baseline_lowest_percent": 86.0},
        "90.1 %, ARX (86.0 to 91.0 % with those that validate as well)",
    )
)
BASELINES.append(
    (
        {"fit_baseline_highest_percent": 91.0},
        "90.1 %, ARX (divergence to 91.0 % with those that validate as well)",
    )
)


@pytest.mark.parametrize(("change", "text"), BASELINES)
def test_a_baseline_is_ahead_by_what_is_printed(change: Record, text: str) -> None:
    record = {"fit_baseline_percent": 90.1, "baseline": "ARX", **change}
    assert baseline_text(record) == text


READINGS = {
    "note: The log was read so: a column. b. note: More.": "a column. b",
    "note: The log was cut into two. doubt: D.": "cut into two",
    "note: The log was read so: x. note: The log was cut at y.": "x; cut at y",
    "note: Something else.": "",
}


def test_how_a_log_was_read_and_cut_is_taken_from_the_notes() -> None:
    texts = {notes: log_reading_text({"evidence_reasons": notes}) for notes in READINGS}
    assert texts == READINGS
    assert log_reading_text({}) == ""


def test_the_open_loop_is_stated_without_neurons_alone() -> None:
    rows = labelled(model_rows({"spectral_radius": 0.9}))
    assert rows["Open loop"] == "contracts at rate 0.19 per sample"
    rows = labelled(model_rows({"spectral_radius": 1.1}))
    assert rows["Open loop"] == "contracts at rate 0 per sample"
    rows = labelled(model_rows({"spectral_radius": 0.9, "neurons": 3}))
    assert "Open loop" not in rows
    rows = labelled(model_rows({"members": 3, "fit_test_members_percent": 95.0}))
    assert rows["Mean that predicts"] == "95.0 %, of 3 models"
    rows = labelled(model_rows({"members": 1, "fit_test_members_percent": 95.0}))
    assert rows["Model that predicts"] == "95.0 %, with products of input and state"
    scores = {"score_test_2": 1.23456, "score_test_1": 2.0, "benchmark": "ced"}
    rows = labelled(model_rows(scores))
    expected = ["Score, record 1", "Score, record 2"]
    actual = [label for label in rows if "Score" in label]
    assert actual == expected
    assert rows["Score, record 2"] == "1.235 ticks/s"
    rows = labelled(model_rows(scores | {"members": 5, "score_members_1": 1.5}))
    assert rows["Mean's score, record 1"] == "1.5 ticks/s"
    without_unit = labelled(model_rows({"score_test_1": 2.0, "benchmark": "other"}))
    assert without_unit["Score, record 1"] == "2"


# What is proved.

STATUSES: list[tuple[Record, str]] = []
STATUSES.append(({"controller_certified": True, "controller_feasible": True}, "certified"))
STATUSES.append(({"controller_certified": False, "controller_feasible": True}, "not certified"))
STATUSES.append(({"controller_certified": None, "controller_feasible": False}, "infeasible"))
STATUSES.append(({}, "not reached"))


@pytest.mark.parametrize(("record", "word"), STATUSES)
def test_a_side_is_in_one_of_four_states(record: Record, word: str) -> None:
    actual = certificate_status_word(record, "controller")
    assert actual == word


def test_the_limit_is_that_of_the_paper_s_theorems_alone() -> None:
    record = {"rate_controller": 0.2, "controller_rate_limit": 0.3, "rates_chosen": "observer"}
    rows = labelled(proved_rows(record, RunFacts()))
    assert rows["Controller rate"] == "0.2 requested, at most 0.3: not reached"
    facts = RunFacts(own_theorems={"controller": "My theorem"})
    rows = labelled(proved_rows(record | {"controller_certified_rate": 0.25}, facts))
    assert rows["Controller rate"].startswith("0.25 per sample (My theorem)")
    assert "at most" not in rows["Controller rate"]
    rows = labelled(proved_rows(record | {"rates_chosen": "controller"}, RunFacts()))
    assert rows["Controller rate"].startswith("0.2 chosen by auto")


def test_within_limits_it_says_what_is_proved_from_where() -> None:
    record = {"limit_lower": -1.0, "limit_upper": 2.0, "limited_rate": 0.1}
    record |= {"unlimited_from": -3.0, "unlimited_to": 3.0, "loop_on": "plant"}
    facts = RunFacts(input_unit=" V", output_unit=" rad")
    (row,) = input_limit_rows(record, facts)
    start = "input -1 to 2 V: contracts globally at 0.1 per sample"
    end = "at the full rate from initial outputs in [-3, 3] rad"
    assert row == ("limit_lower", "Exported, within limits", f"{start}, {end}")
    (row,) = input_limit_rows(record | {"limited_rate": None, "loop_on": "identified model"}, facts)
    assert row[1] == "Within input limits"
    assert "globally at no rate" in row[2]
    own = RunFacts(own_theorems={"controller": "My theorem"})
    first, _ = input_limit_rows({}, own)
    assert first[2] == "nothing is proved within them for My theorem"
    count = len(list(input_limit_rows(record, own)))
    assert count == 1


COVERAGES: list[tuple[Record, str, str]] = []
COVERAGES.append(({"coverage": 0.99, "coverage_reference": "band 3"}, "coverage", "(band 3)"))
COVERAGES.append(({"coverage": 1.0}, "coverage", "1.00 times as large as the records show"))
COVERAGES.append(({"coverage": 1.259}, "coverage", "1.25 times as large as the records show"))
COVERAGES.append(
    ({"coverage_reason": "few records"}, "coverage_reason", "not covered: few records")
)
COVERAGES.append(({"certified_tolerance": 0.5}, "certified_tolerance", "0.5 is proved, as a gain"))
COVERAGES.append(
    (
        {"certified_tolerance": 0.5, "neurons": 2},
        "certified_tolerance",
        "rest is proved up to 0.5, as a gain",
    )
)


@pytest.mark.parametrize(("record", "column", "words"), COVERAGES)
def test_a_coverage_below_one_is_none(record: Record, column: str, words: str) -> None:
    name, _, value = next(iter(coverage_rows(record)))
    assert name == column
    assert words in value


EXCEEDED: list[tuple[Any, Any, bool]] = []
EXCEEDED.append((1.0, 1.5, True))
EXCEEDED.append((1.5, 1.5, False))
EXCEEDED.append((1.5, 1.4, False))
EXCEEDED.append((0.9, 1.5, False))
EXCEEDED.append((None, 1.5, False))
EXCEEDED.append((1.5, None, False))
EXCEEDED.append((1.5, "inf", True))


@pytest.mark.parametrize(("coverage", "needed", "is_exceeded"), EXCEEDED)
def test_unused_data_exceed_a_coverage_that_there_is(
    coverage: Any, needed: Any, is_exceeded: bool
) -> None:
    record = {"coverage": coverage, "coverage_needed": needed, "fresh_sets": 2}
    assert unused_data_exceed_coverage(record) is is_exceeded
    text = fresh_error_ratio_text(record)
    is_finite = isinstance(needed, float)
    assert ("more than is covered" in text) is (is_exceeded and is_finite)
    assert bool(text) is (needed is not None)


# What is predicted and seen.


def test_a_prediction_is_qualified_or_withheld() -> None:
    record = {"predicted_stable": True, "predicted_faster": False, "evidence": "doubt"}
    label = "Prediction for the plant"
    words = "stays stable, no faster than without control, with doubts"
    actual = labelled(prediction_rows(record))[label]
    assert actual == words
    known = record | {"resolved_margin": 2.0, "predicted_faster": None, "evidence": "sound"}
    margin = "stays stable: stability margin 2 > 1"
    actual = labelled(prediction_rows(known))[label]
    assert actual == margin
    withheld = labelled(prediction_rows(known | {"evidence": "cannot judge"}))
    assert withheld[label] == "none: the evidence allows no judgement"
    on_model = labelled(prediction_rows(known | {"loop_on": "identified model"}))
    assert on_model["Prediction"] == margin


def test_an_earlier_record_says_that_it_states_no_sines() -> None:
    old = {"status": "ok", "record_version": 1}
    assert "Single sines" in labelled(prediction_rows(old))
    assert "Single sines" not in labelled(prediction_rows(old | {"sine_margin": 2.0}))
    assert "Single sines" not in labelled(prediction_rows(old | {"loop_on": "identified model"}))


def test_settling_times_are_compared_where_both_are_known() -> None:
    counts = {"stable_count": 9, "initial_conditions": 10, "settling_time_mean_s": 0.1}
    rows = labelled(closed_loop_rows(counts | {"settling_time_open_loop_s": 0.4}))
    assert rows["Mean settling time"] == "0.100 s, uncontrolled 0.400 s (ratio 0.25)"
    assert rows["Initial states settled"] == "9 of 10"
    rows = labelled(closed_loop_rows(counts | {"settling_time_open_loop_s": 0.0}))
    assert rows["Mean settling time"] == "0.100 s, uncontrolled 0.000 s"
    rows = labelled(closed_loop_rows(counts))
    assert rows["Mean settling time"] == "0.100 s, uncontrolled none settles"
    slow = {"settling_time_mean_s": 66150.0, "settling_time_open_loop_s": 221228.571}
    rows = labelled(closed_loop_rows(counts | slow))
    assert rows["Mean settling time"] == "66150 s, uncontrolled 221229 s (ratio 0.30)"
    fast = {"settling_time_mean_s": 2.5e-4, "settling_time_open_loop_s": 0.00314}
    rows = labelled(closed_loop_rows(counts | fast))
    assert rows["Mean settling time"] == "250 µs, uncontrolled 0.00314 s (ratio 0.08)"


def test_a_pi_that_settles_where_the_controller_does_not_is_faster() -> None:
    counts = {"stable_count_pi": 4, "initial_conditions": 4, "settling_time_pi_s": 0.05}
    text = pi_comparison_text(counts)
    assert "faster" in text
    text = pi_comparison_text(counts | {"settling_time_mean_s": 0.05})
    assert "faster" not in text
    text = pi_comparison_text(counts | {"settling_time_pi_s": None})
    assert "faster" not in text


NOISE: list[tuple[Any, Any, str]] = []
NOISE.append((None, 1.5, "reaches the model's output 1.5-fold"))
NOISE.append((0.0, None, "does not move the output"))
NOISE.append((2.0, None, "reaches the output 2-fold"))
NOISE.append((1.0, 1.0, "reaches the output 1-fold, the model's 1-fold"))
NOISE.append((2.0, 1.0, "reaches the output 2-fold, the model's 1-fold: more than noise moves it"))


@pytest.mark.parametrize(("measured", "model", "text"), NOISE)
def test_noise_is_compared_with_the_model_s(measured: Any, model: Any, text: str) -> None:
    record = {"noise_gain_measured": measured, "noise_gain_model": model}
    assert noise_effect_text(record) == text


def test_every_doubt_and_reason_has_a_line() -> None:
    reasons = "doubt: A. B. note: C. cannot judge: D."
    record = {"evidence_reasons": reasons, "infeasible_reason": "too fast", "error_message": ""}
    lines = ["Doubt: A. B.", "Cannot judge: D.", "Infeasible reason: too fast"]
    assert list(outcome_reasons(record)) == lines


def test_a_run_at_work_has_no_verdict() -> None:
    running = outcome_text({"status": "running"})
    assert running.plain == "running: a process is at this run"
    judged = outcome_text({"status": "failed", "evidence": "cannot judge"})
    assert judged.plain.startswith("cannot judge: the evidence allows no judgement. ")
    assert judged.style == "bold yellow"


def test_a_block_without_known_values_is_left_out() -> None:
    stream = io.StringIO()
    console = Console(file=stream, width=200)
    print_outcome({"status": "failed", "fit_test_percent": 90.0}, [], console)
    printed = stream.getvalue()
    assert "MODEL" in printed
    for title in ("PROVED", "PREDICTED", "SEEN"):
        assert title not in printed
