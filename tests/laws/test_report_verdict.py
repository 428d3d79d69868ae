"""The best run and the verdicts are what a reader takes away: their rules, tested."""

import pandas as pd
import report_tables

from ssm_study.report import words
from ssm_study.table.rank import predicted_stable, sort_best_first


def row(**values: object) -> dict[str, object]:
    good = {
        "status": "ok",
        "controller_certified": True,
        "observer_certified": True,
        "stable_fraction": 1.0,
    }
    measures = {"settling_time_mean_s": 0.1, "fit_test_percent": 90.0}
    return good | measures | values


def test_a_fast_loop_without_certificate_never_beats_a_certified_one() -> None:
    slow = row(run="slow", settling_time_mean_s=0.3)
    quick = row(run="quick", settling_time_mean_s=0.2)
    bare = row(run="bare", settling_time_mean_s=0.01, controller_certified=False)
    lost = row(run="lost", settling_time_mean_s=0.02, stable_fraction=0.9)
    failed = {"run": "failed", "status": "failed"}
    rows = [failed, bare, slow, lost, quick]
    table = pd.DataFrame(rows)
    run = sort_best_first(table)["run"]
    order = run.tolist()
    expected = ["quick", "slow", "lost", "bare", "failed"]
    assert order == expected


def test_a_baseline_that_is_only_scored_is_identified_not_uncertified() -> None:
    baseline = {"run": "gru", "status": "ok", "fit_test_percent": 95.0}
    ours = row(run="ours")
    table = pd.DataFrame([baseline, ours])
    expected = ["identified", "certified, settles"]
    words_of_table = words.verdict_words(table)
    verdicts = words_of_table.tolist()
    assert verdicts == expected


def test_a_certified_run_without_a_loop_is_not_said_to_miss_a_start() -> None:
    untried = {
        "status": "ok",
        "controller_certified": True,
        "observer_certified": True,
        "fit_test_percent": 95.0,
    }
    table = pd.DataFrame([untried])
    words_of_untried = words.verdict_words(table)
    assert words_of_untried.tolist() == ["certified, not tried"]
    half = row(stable_fraction=0.5)
    table = pd.DataFrame([untried, half])
    expected = words.LOST.word
    words_of_both = words.verdict_words(table)
    said_of_both = words_of_both.tolist()
    assert said_of_both[1] == expected


def test_an_unknown_status_counts_as_failed_not_as_fine() -> None:
    statuses = ("failed", "lost", "corrupt", "running", None)
    for status in statuses:
        unknown = row(status=status)
        table = pd.DataFrame([unknown])
        expected = [words.FAILED.word]
        words_of_unknown = words.verdict_words(table)
        said_of_unknown = words_of_unknown.tolist()
        assert said_of_unknown == expected


def test_counts_add_up() -> None:
    table = report_tables.table(50)
    sentence = words.verdict_counts(table)
    after_the_colon = sentence.split(": ")
    parts = after_the_colon[1].split("; ")
    total = sum(int(part.split()[0]) for part in parts)
    assert total == 50
    empty = report_tables.empty()
    said_of_empty = words.verdict_counts(empty)
    assert said_of_empty == "0 runs"


def test_where_nobody_could_judge_a_large_margin_predicts_nothing() -> None:
    unjudged = row(
        run="unjudged", mismatch_margin=7.9, predicted_stable=None, evidence="cannot judge"
    )
    table = pd.DataFrame([unjudged])
    predictions = predicted_stable(table).tolist()
    assert predictions == [False]
