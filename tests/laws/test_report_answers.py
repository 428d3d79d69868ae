"""The page's words must say the same as the table's numbers."""

import pandas as pd
import pytest
import report_tables
import scipy

from ssm_study.report.answers import question_answers, swept_settings_line
from ssm_study.report.page.charts import (
    RATE_COSTS,
    scatter_plot_contents,
    scatter_plot_specification,
    unplotted_answers,
)
from ssm_study.report.page.data import comparable_columns, page_title
from ssm_study.report.page.failures import shorten_numbers
from ssm_study.table.alike_sentences import merge_number_ranges
from ssm_study.table.columns import swept_settings

QUESTIONS = ("Where does feasibility end", "better fit", "prediction hold")


def said(table: pd.DataFrame, about: str) -> str:
    return next(" ".join(a.sentences) for a in question_answers(table) if about in a.question)


def row(**values: object) -> dict[str, object]:
    known = {"run": "a", "status": "ok", "controller_certified": True, "observer_certified": True}
    known |= {"stable_fraction": 1.0, "settling_time_mean_s": 0.1, "settling_time_open_loop_s": 0.2}
    return (
        known
        | {"fit_test_percent": 90.0, "rate_controller": 0.1, "controller_rate_limit": 0.3}
        | values
    )


def test_every_question_that_the_table_has_numbers_for_is_answered() -> None:
    for words in QUESTIONS:
        assert said(report_tables.table(40), words)
    table = report_tables.empty()
    assert question_answers(table) == []
    table = report_tables.failures()
    questions = [answer.question for answer in question_answers(table)]
    assert questions == ["Does a better fit mean a better loop?"]


def test_a_log_has_no_question_about_a_plant() -> None:
    on_model = row(loop_on="identified model", predicted_stable=True)
    table = pd.DataFrame([on_model])
    questions = [answer.question for answer in question_answers(table)]
    assert not any("prediction" in question for question in questions), "it has no plant to ask"
    run_on_plant = row(loop_on="plant", predicted_stable=True)
    on_plant = question_answers(pd.DataFrame([run_on_plant]))
    assert "Does the prediction hold on the plant?" in [answer.question for answer in on_plant]


def test_what_a_study_can_show_of_the_prediction_is_counted_by_model() -> None:
    """Ten loops of each of N models are N trials, not ten times as many."""
    foretold = {
        "predicted_stable": True,
        "resolved_margin": 1.3,
        "controller_radius": 0.9,
        "stage_synthesis_key": "k",
    }
    runs = [
        row(run=f"{m}-{k}", stage_bounds_key=f"m{m}", **foretold)
        for m in range(20)
        for k in range(10)
    ]
    table = pd.DataFrame(runs)
    text = said(table, "prediction hold")
    assert (
        "of 20 models none had a predicted loop that does not settle, so with 95 % confidence"
        in text
    )
    assert text.endswith(f"below {1 - 0.05 ** (1 / 20):.2g}.")
    runs[7]["stable_fraction"] = runs[8]["stable_fraction"] = 0.5
    table = pd.DataFrame(runs)
    text = said(table, "prediction hold")
    words = text.split("below ")[1]
    bound = float(words.rstrip("."))
    assert "of 20 models 1 had" in text
    probability = scipy.stats.binom.cdf(1, 20, bound)
    assert probability == pytest.approx(0.05, abs=0.01)
    table = pd.DataFrame(runs[10:20])
    assert "confidence" not in said(table, "prediction hold")  # one model shows nothing
    two_models = pd.DataFrame(runs[10:30])
    two = said(two_models, "prediction hold")
    assert two.endswith("2 models are too few to say how often a prediction fails.")


def test_an_answer_stands_once_with_its_plot_or_in_words_where_it_has_none() -> None:
    table = report_tables.table(40)
    answered = question_answers(table)
    plots = scatter_plot_contents(table, answered)
    titles = [panel["question"] for panel in plots]
    assert "What does a faster rate buy?" in titles
    with_plot = [sentence for panel in plots for sentence in panel["sentences"]]
    alone = [
        sentence for answer in unplotted_answers(table, answered) for sentence in answer.sentences
    ]
    everything = [sentence for answer in answered for sentence in answer.sentences]
    assert sorted(with_plot + alone) == sorted(everything)
    assert with_plot
    alike = table.assign(fit_test_percent=90.0)
    unplotted = unplotted_answers(alike, question_answers(alike))
    left = [answer.question for answer in unplotted]
    assert "Does a better fit mean a better loop?" in left
    one = table.head(1)
    assert unplotted_answers(one, question_answers(one)) == question_answers(one), (
        "a single run has no plots"
    )


@pytest.mark.parametrize(("largest", "kind"), [(9.9, None), (10.1, "log")])
def test_an_axis_over_more_than_a_decade_is_logarithmic(largest: float, kind: str | None) -> None:
    gains = [1.0, largest]
    rates = [0.1, 0.2]
    columns = {"rate_controller": rates, "controller_gain_norm": gains}
    table = pd.DataFrame(columns)
    spec = scatter_plot_specification(RATE_COSTS, table)
    scales = [layer["encoding"]["y"]["scale"] for layer in spec["layer"]]
    kinds = {scale.get("type") for scale in scales}
    assert kinds == {kind}


def test_numbers_in_total_leave_the_page_where_one_by_frequency_decides() -> None:
    runs = report_tables.table(40)
    table = runs.assign(coverage=1.1, certified_tolerance=0.05)
    weaker = {"mismatch_margin", "mismatch_gain", "certified_tolerance"}
    assert weaker.isdisjoint(comparable_columns(table))
    assert "resolved_margin" in comparable_columns(table)
    bare = table.assign(coverage=None, resolved_margin=None)
    assert weaker <= set(comparable_columns(bare)), "else they are all that there is"


def test_plants_are_answered_one_by_one_since_their_seconds_do_not_compare() -> None:
    motor_run = row(run="m", plant="DCMotor")
    tanks_run = row(run="t", plant="CascadedTanks")
    runs = [motor_run, tanks_run]
    table = pd.DataFrame(runs)
    text = said(table, "better fit")
    assert "DC motor: This study" in text
    assert "Cascaded tanks: This study" in text


def test_requests_beyond_the_frontier_and_those_a_method_missed_are_told_apart() -> None:
    beyond = row(status="infeasible", rate_controller=0.4, controller_certified=None)
    missed = row(status="infeasible", rate_controller=0.2, controller_certified=None)
    table = pd.DataFrame([row(), beyond, missed])
    text = said(table, "feasibility")
    assert "1 of 3 requests lie beyond it, and none of those was certified" in text
    assert "certified for is 0.3 per sample" in text
    within_limit = missed | {"controller_rate_limit": 0.25}
    table = pd.DataFrame([row(), beyond, within_limit])
    two = said(table, "feasibility")
    assert "certified for is from 0.25 to 0.3 per sample" in two
    assert "Inside it, 1 got no certificate" in text


def test_the_observers_frontier_is_told_where_a_request_went_beyond_it() -> None:
    inside = row(rate_observer=0.1, observer_rate_limit=0.5)
    beyond = row(rate_observer=0.7, observer_rate_limit=0.5, observer_certified=None)
    table = pd.DataFrame([inside])
    assert "observer" not in said(table, "feasibility")
    table = pd.DataFrame([inside, beyond])
    assert "any observer can be certified for is 0.5" in said(table, "feasibility")


def test_where_all_settle_fit_is_held_against_time() -> None:
    runs = [row(fit_test_percent=80.0 + k, settling_time_mean_s=0.3 - 0.01 * k) for k in range(5)]
    table = pd.DataFrame(runs)
    assert "fit and settling time have a rank correlation of -1.00" in said(table, "better fit")


def test_the_prediction_is_scored_on_both_sides() -> None:
    shares = (1, 0)
    missed = [
        row(mismatch_margin=2.0, predicted_stable=False, stable_fraction=share) for share in shares
    ]
    at_the_edge = row(mismatch_margin=0.5, predicted_stable=True)
    table = pd.DataFrame([at_the_edge, *missed])
    text = said(table, "prediction hold")
    assert text.startswith(
        "Where the loop was predicted to stay stable, every start settles in 1 of 1 runs. Where it"
    )
    assert "Where it was not, every start settles in 1 of 2 runs" in text


def test_what_differs_between_runs_is_named_with_its_values() -> None:
    rows = [row(order=4, seed=0), row(order=8, seed=0)]
    table = pd.DataFrame(rows)
    assert swept_settings(table) == ["order"]
    assert swept_settings_line(table) == "Swept: model order (4, 8)."
    seeds = [row(seed=k) for k in range(3, 12)]
    many = pd.DataFrame(seeds)
    assert swept_settings_line(many) == "Swept: seed (9 values, 3 to 11)."


def test_a_rate_is_swept_where_it_was_requested_and_auto_is_one_of_its_values() -> None:
    by_auto = {
        "synthesis_method": "auto",
        "rates_chosen": "controller, observer",
        "rate_observer": 0.2,
    }
    requested = by_auto | {"rates_chosen": "observer"}
    rows = [
        row(**by_auto) | {"rate_controller": rate, "seed": k} for k, rate in enumerate((0.22, 0.31))
    ]
    assert swept_settings(pd.DataFrame(rows)) == ["seed"], "what auto chose is a result"
    rates = (0.1, 0.3)
    rows += [
        row(**requested) | {"rate_controller": rate, "seed": 0, "rate_observer": rate}
        for rate in rates
    ]
    table = pd.DataFrame(rows)
    assert swept_settings_line(table) == "Swept: controller rate, ρ (0.1, 0.3, auto); seed (0, 1)."
    assert page_title(table) == "What changes with the controller rate?"


def test_reasons_have_short_numbers_that_are_never_above_the_limit() -> None:
    reason = "the slopes allow only rates below {}; request 12345 of 2.5e-07"
    sentences = [reason.format(value) for value in ("0.219102", "0.359482")]
    merged = merge_number_ranges([shorten_numbers(sentence) for sentence in sentences])
    assert merged == "the slopes allow only rates below 0.2191 to 0.3594; request 12345 of 2.5e-07"
    assert shorten_numbers("a gain of 123.456789") == "a gain of 123.4"
    assert shorten_numbers("a gain of -0.00012349") == "a gain of -0.0001234"
