"""What the page says in words must be what the table says in numbers."""

import pandas as pd
import report_tables

from ssm_study.report.answers import answers, parameters_line, swept

QUESTIONS = ("Which run is best", "Where does feasibility end", "better fit", "mismatch margin", "What failed")


def said(table: pd.DataFrame, about: str) -> str:
    return next(" ".join(a.sentences) for a in answers(table) if about in a.question)


def row(**values: object) -> dict[str, object]:
    known = {"run": "a", "status": "ok", "controller_certified": True, "observer_certified": True}
    known |= {"stable_fraction": 1.0, "settling_time_mean_s": 0.1, "settling_time_open_loop_s": 0.2}
    return known | {"fit_test_percent": 90.0, "rate_controller": 0.1, "controller_rate_limit": 0.3} | values


def test_every_question_is_answered_whatever_the_table() -> None:
    for table in (report_tables.table(40), report_tables.empty(), report_tables.failures()):
        for question in QUESTIONS:
            assert said(table, question)


def test_the_best_run_is_the_fastest_of_those_that_are_certified_and_settle() -> None:
    lost = row(run="lost", settling_time_mean_s=0.01, stable_fraction=0.5)
    text = said(pd.DataFrame([lost, row(run="slow", settling_time_mean_s=0.15), row(run="best")]), "best")
    assert text.startswith("best:")
    assert "0.50 of the plant left alone" in text
    assert "at most 0.3 can be certified" in text


def test_without_a_certified_run_that_settles_none_is_called_best() -> None:
    assert said(pd.DataFrame([row(stable_fraction=0.9)]), "best").startswith("No run is certified and brings")


def test_requests_beyond_the_frontier_and_those_a_method_missed_are_told_apart() -> None:
    beyond = row(status="infeasible", rate_controller=0.4, controller_certified=None)
    missed = row(status="infeasible", rate_controller=0.2, controller_certified=None)
    text = said(pd.DataFrame([row(), beyond, missed]), "feasibility")
    assert "1 of 3 requests lie beyond it, and 0 of those were certified" in text
    assert "Inside it, 1 got no certificate" in text


def test_the_margin_is_scored_on_both_sides_of_one() -> None:
    table = pd.DataFrame(
        [row(mismatch_margin=1.5), row(mismatch_margin=0.5), row(mismatch_margin=0.2, stable_fraction=0)]
    )
    text = said(table, "margin")
    assert "above one, 1 of 1 runs" in text
    assert "at or below one, 1 of 2 runs" in text


def test_what_differs_between_runs_is_named_with_its_values() -> None:
    table = pd.DataFrame([row(order=4, seed=0), row(order=8, seed=0)])
    assert swept(table) == ["order"]
    assert parameters_line(table) == "Swept: model order (4, 8)."
