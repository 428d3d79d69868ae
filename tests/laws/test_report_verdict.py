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
    return good | {"settling_time_mean_s": 0.1, "fit_test_percent": 90.0} | values


def test_a_fast_loop_without_certificate_never_beats_a_certified_one() -> None:
    slow = row(run="slow", settling_time_mean_s=0.3)
    quick = row(run="quick", settling_time_mean_s=0.2)
    bare = row(run="bare", settling_time_mean_s=0.01, controller_certified=False)
    lost = row(run="lost", settling_time_mean_s=0.02, stable_fraction=0.9)
    failed = {"run": "failed", "status": "failed"}
    table = pd.DataFrame([failed, bare, slow, lost, quick])
    run = sort_best_first(table)["run"]
    order = run.tolist()
    expected = ["quick", "slow", "lost", "bare", "failed"]
    assert order == expected


def test_a_baseline_that_is_only_scored_is_identified_not_uncertified() -> None:
    baseline = {"run": "gru", "status": "ok", "fit_test_percent": 95.0}
    table = pd.DataFrame([baseline, row(run="ours")])
    expected = ["identified", "certified, settles"]
    assert words.verdict_words(table).tolist() == expected


def test_a_certified_run_without_a_loop_is_not_said_to_miss_a_start() -> None:
    untried = {
        "status": "ok",
        "controller_certified": True,
        "observer_certified": True,
        "fit_test_percent": 95.0,
    }
    table = pd.DataFrame([untried])
    assert words.verdict_words(table).tolist() == ["certified, not tried"]
    table = pd.DataFrame([untried, row(stable_fraction=0.5)])
    expected = words.LOST.word
    assert words.verdict_words(table).tolist()[1] == expected


def test_an_unknown_status_counts_as_failed_not_as_fine() -> None:
    for status in ("failed", "lost", "corrupt", "running", None):
        table = pd.DataFrame([row(status=status)])
        expected = [words.FAILED.word]
        assert words.verdict_words(table).tolist() == expected


def test_counts_add_up() -> None:
    table = report_tables.table(50)
    parts = words.verdict_counts(table).split(": ")[1].split("; ")
    assert sum(int(part.split()[0]) for part in parts) == 50
    assert words.verdict_counts(report_tables.empty()) == "0 runs"


def test_where_nobody_could_judge_a_large_margin_predicts_nothing() -> None:
    unjudged = row(
        run="unjudged", mismatch_margin=7.9, predicted_stable=None, evidence="cannot judge"
    )
    table = pd.DataFrame([unjudged])
    assert predicted_stable(table).tolist() == [False]
