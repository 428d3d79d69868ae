"""The first screen of the report page in a real browser, and pages of studies of every kind."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import report_tables
from report_browser import complaints, count_shown_runs, groups_shown, wait_for
from report_runs import random_run, write_recordings

from ssm_study.report.page.amplitudes import coverage_reference_text
from ssm_study.report.page.data import mask_meaningless_values, slider_settings
from ssm_study.report.page.first_screen import outcome_remarks
from ssm_study.report.page.provenance import configuration_text, log_source_text, provenance_lines
from ssm_study.report.page.writing import write_page
from ssm_study.report.study_folder import RunFolder, StudyFolder
from ssm_study.report.words import SETTLED
from ssm_study.table.rank import sort_best_first


def test_runs_whose_rate_auto_chose_are_one_group(browser: Any, tmp_path: Path) -> None:
    table = report_tables.table(12).assign(
        synthesis_method="auto", rates_chosen="controller, observer"
    )
    table.loc[::2, ["rate_controller", "rates_chosen"]] = [0.1, "observer"]
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    browser.execute_script("state.group.by = ['rate_controller']; changed(true)")
    wait_for(browser, "document.querySelectorAll('#groups tbody tr').length === 2")
    expected = {"0.1": "6", "auto": "6"}
    assert {label: row[0] for label, row in groups_shown(browser).items()} == expected


def test_the_first_screen_says_what_is_proved_predicted_seen_and_how_sound_the_records_are(
    browser: Any, tmp_path: Path
) -> None:
    table = report_tables.table(60)
    table = (
        table[table["status"] == "ok"]
        .head(1)
        .assign(predicted_stable=True, resolved_margin=2.04, evidence="doubt")
    )
    reasons = "note: One amplitude: the record shows no other. doubt: The record is short."
    table = table.assign(stable_fraction=1.0, stable_count=10, evidence_reasons=reasons)
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text_of = "return [...document.querySelectorAll(arguments[0])].map((c) => c.innerText)"
    cards = browser.execute_script(text_of, ".card")
    assert (
        "Predicted for the plant\n2.04\nstability margin (above 1 is needed): it stays stable, "
        "with doubts; the controller is stable by itself: spectral radius 0.9 (below 1 is needed)"
    ) in cards
    assert cards[-1].startswith("Seen on the simulated plant\n10 of 10\nstarts settle, in 0.")
    (evidence,) = browser.execute_script(text_of, ".evidence li")
    doubts = "The records leave a doubt. The record is short."
    text = " ".join(evidence.split())
    assert text == f"Evidence: doubt {doubts} 1 note", "what matters first"
    note = browser.execute_script(
        "return document.querySelector('.evidence details p').textContent"
    )
    assert note == "Note: One amplitude: the record shows no other."
    absent = "return ['compare', 'filters', 'beside'].map((id) => document.getElementById(id))"
    expected = [None] * 3
    assert browser.execute_script(absent) == expected, "a single run has nothing to compare"
    boxes = browser.execute_script("return document.querySelectorAll('.picker').length")
    assert boxes == 0, "nor to tick"
    assert "No run failed." in browser.execute_script("return document.body.innerText")


@pytest.mark.parametrize(
    ("loop_on", "said"),
    [("plant", "simulated plant"), ("device", "device"), ("identified model", "model")],
)
def test_the_first_screen_says_what_the_loop_was_closed_on(
    browser: Any, tmp_path: Path, loop_on: str, said: str
) -> None:
    """A trial on a device was said to have settled on the model."""
    table = report_tables.table(60).assign(loop_on=loop_on)
    table = table[table["stable_count"] > 0].head(1)
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text = browser.execute_script("return document.getElementById('lead').innerText")
    assert f"Seen on the {said}\n" in text
    assert "\nstarts settle" in text
    assert f"Predicted for the {'model' if said == 'model' else 'plant'}\n" in text


def test_every_run_that_came_to_less_than_a_certified_loop_is_listed_with_its_reason(
    browser: Any, tmp_path: Path
) -> None:
    """A run without certificate must be listed: the page said that nothing failed and that every
    certified controller settled."""
    table = report_tables.table(60)
    run = ["bare", "untried"]
    table = pd.concat([table[table["status"] == "ok"].head(1)] * 2, ignore_index=True).assign(
        run=run
    )
    table["uncertified_reason"] = ["observer: not positive definite", None]
    table["observer_certified"], table["stable_fraction"] = [False, True], [1.0, None]
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text = browser.execute_script("return document.getElementById('failures').textContent")
    assert "not certified: observer: not positive definite" in text
    assert (
        "certified, not tried: both certificates hold; the model answers its input at once" in text
    )
    assert "Nothing failed" not in text


def test_a_name_shows_what_not_all_runs_share_and_the_best_run_has_a_ring(
    browser: Any, tmp_path: Path
) -> None:
    table = sort_best_first(report_tables.table(4)).reset_index(drop=True)
    digits = [f"{k:010x}" for k in range(4)]
    table["run"] = [f"order{4 + k // 2}-width8-seed0-{digits[k]}" for k in range(4)]
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    links = browser.execute_script(
        "return [...document.querySelectorAll('#body tr th button')].map(b => b.textContent)"
    )
    expected = [f"order{4 + k // 2}-{digits[k]}" for k in range(4)]
    assert links == expected
    rings = """return VIEWS.map((view) => {
      const ring = (item) => item.strokeWidth === 1.3 ? [item.datum.i] : [];
      const around = (item) => item.items ? item.items.flatMap(around) : ring(item);
      return around(view.scenegraph().root); })"""
    drawn = browser.execute_script(rings)
    assert all(found in ([0], []) for found in drawn)
    assert [0] in drawn
    wait_for(browser, "VIEWS[DATA.panels.length + 1]")
    groups = browser.execute_script(rings)[-1]
    assert groups in ([0], []), "in the strips of the groups, too"


def test_an_infeasible_run_says_on_the_first_screen_why_and_what_is_possible(
    browser: Any, tmp_path: Path
) -> None:
    table = report_tables.table(60)
    table = table[table["status"] == "infeasible"].head(1)
    table = table.assign(
        rate_controller=0.6, controller_rate_limit=0.359, infeasible_reason="rate 0.6 is infeasible"
    )
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text = browser.execute_script("return document.getElementById('lead').innerText")
    assert "0.359\nlargest rate that can be certified; requested: 0.6" in text
    assert (
        "Infeasible: no certificate exists at the requested rate. Rate 0.6 is infeasible." in text
    )


def test_a_run_that_requested_no_rate_and_is_not_certified_has_a_first_screen(
    browser: Any, tmp_path: Path
) -> None:
    """A controller's own rate without the observer's certificate: the page stopped at a number that
    is not there."""
    table = report_tables.table(60)
    table = table[table["status"] == "ok"].head(1)
    table = table.assign(
        rate_controller=None, controller_certified_rate=0.1, observer_certified=False
    )
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'", 5)
    text = browser.execute_script("return document.getElementById('lead').innerText")
    assert "largest rate that can be certified\n" in text


def test_of_runs_at_one_point_the_lines_lie_within_the_plots(browser: Any, tmp_path: Path) -> None:
    """An axis around the runs alone would leave the plant's own time, a limit or margin one far
    outside the figure."""
    one = report_tables.table(60)
    one = one[one["settling_time_open_loop_s"].notna() & one["settling_time_mean_s"].notna()].head(
        1
    )
    one = pd.concat([one, one.assign(run="again")], ignore_index=True)
    study_folder = report_tables.write_study(tmp_path / "one", one)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    heights = browser.execute_script(
        "return [...document.querySelectorAll('.chart canvas')].map((c) => c.clientHeight)"
    )
    assert len(heights) >= len(browser.execute_script("return DATA.panels"))
    assert max(heights) < 400
    bars = (
        "const n = DATA.panels.findIndex((panel) => panel.tick); return "
        "VIEWS[n].scale('x').domain()"
    )
    assert browser.execute_script(bars)[0] > 0, "the bars stand on the axis of the points"


@pytest.mark.parametrize(
    "table", [report_tables.empty(), report_tables.failures()], ids=["empty", "failures"]
)
def test_a_study_without_results_still_has_a_page(browser: Any, tmp_path: Path, table: Any) -> None:
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    entries = browser.get_log("browser")
    assert [entry for entry in entries if entry["level"] == "SEVERE"] == []
    assert browser.execute_script("return RUNS") == len(table)
    assert not len(table) or count_shown_runs(browser) == len(table)


def test_two_studies_stand_on_one_page(browser: Any, tmp_path: Path) -> None:
    for name, runs in (("first", 5), ("second", 3)):
        table = report_tables.table(runs).assign(study=name)
        report_tables.write_study(tmp_path / name, table)
    others = (tmp_path / "second",)
    path = write_page(tmp_path / "first", others)
    assert path.name == "report_with_second.html"
    browser.get(path.as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    assert count_shown_runs(browser) == 8
    wait_for(browser, "document.querySelector('#groups tbody tr') !== null")
    assert browser.execute_script("return state.group.by") == ["study"], (
        "studies against each other first"
    )
    names = browser.execute_script("return COLUMNS.run")
    assert sum(name.startswith("../second/") for name in names) == 3


def test_the_provenance_says_in_words_whether_the_code_was_as_committed(tmp_path: Path) -> None:
    for dirty, told in (
        ([False], "clean"),
        ([True], "with uncommitted changes"),
        ([False, True, None], "clean or with"),
    ):
        table = report_tables.table(6).assign(git_dirty=pd.array((dirty * 6)[:6], dtype="boolean"))
        folder = report_tables.write_study(tmp_path / str(len(told)), table)
        study = StudyFolder(folder=folder)
        assert dict(provenance_lines(study, study.table))["working tree"].startswith(told)


def test_a_log_names_its_file_and_signals_and_no_plant(tmp_path: Path) -> None:
    table = report_tables.table(60)
    table = table[table["status"] == "ok"].head(1).assign(loop_on="identified model")
    folder = report_tables.write_study(tmp_path / "study", table)
    run = folder / table["run"].iloc[0]
    (run / ".hydra").mkdir(parents=True)
    (run / "model.json").write_text("{}")
    data = "data:\n  path: log.csv\n  input: power\n  output: temperature\n  step_s: 1\n"
    plant = "plant:\n  _target_: Motor\n  list:\n  - 1\nexcitation:\n  clock_s: null\n"
    (run / ".hydra" / "config.yaml").write_text(f"seed: 0\n{plant}{data}loop: null\n")
    study = StudyFolder(folder=folder)
    assert log_source_text(study) == "Log: log.csv, power to temperature, 1 s. "
    assert configuration_text(study) == f"seed: 0\n{data}loop: null\n"
    command = dict(provenance_lines(study, study.table))["to check the best run"]
    assert command == f"ssm-study verify results/study/{run.name}", "the folder's whole name"
    remarks = list(outcome_remarks({"verdict": SETTLED.word, "evidence": "sound"}))
    assert "No plant was tried" not in remarks[-1].text
    log = {"verdict": SETTLED.word, "evidence": "sound", "loop_on": "identified model"}
    (remark,) = outcome_remarks(log | {"evidence_reasons": "note: One. note: Two."})
    assert remark.title == "Evidence: sound, 2 notes (below)"
    assert remark.text.endswith("No plant was tried: the loop was closed on the model alone.")


def test_a_run_that_ended_early_has_no_evidence_and_a_log_no_distance_of_a_plant() -> None:
    values = {"verdict": ["infeasible", SETTLED.word], "evidence": ["sound", "sound"]}
    values |= {"loop_on": [None, "identified model"], "certified_bound_excess_plant": [None, 0.0]}
    table = mask_meaningless_values(pd.DataFrame(values))
    assert table["evidence"].isna()[0]
    assert table["evidence"][1] == "sound"
    assert table["certified_bound_excess_plant"].isna().all()


def test_the_record_that_decides_a_coverage_is_named_in_the_unit_of_the_input(
    tmp_path: Path,
) -> None:
    content = '{"input_scale": [2.86], "step_s": 0.01}'
    (tmp_path / "model.json").write_text(content)
    run = RunFolder(path=tmp_path)
    assert coverage_reference_text("input of rms 0.1, in total", run, "V") == (
        "input of rms 0.29 V, in total"
    )
    angle = coverage_reference_text("input of rms 0.1, 0.00 to 0.63 rad/sample", run, "V")
    assert angle == "input of rms 0.29 V, 0 to 10 Hz"
    unread = coverage_reference_text("input of rms 0.1, in total", None, "V")
    assert unread == "input of rms 0.1 input scales, in total"
    assert coverage_reference_text("trials in closed loop", run, "V") == "trials in closed loop"


def write_sweep_page(folder: Path) -> Path:
    """A page of three runs that differ in their rate; the third left no recording."""
    table = report_tables.table(60)
    table = table[table["status"] == "ok"].head(3).reset_index(drop=True)
    table = pd.concat([table.head(1)] * 3, ignore_index=True)
    run = ["a", "b", "c"]
    rate_controller = [0.1, 0.3, 0.2]
    table = table.assign(run=run, rate_controller=rate_controller, rates_chosen=None)
    study = report_tables.write_study(folder / "study", table)
    for seed, name in enumerate(("a", "b"), start=1):
        run = random_run(study / name, kind="mlp", channels=1, seed=seed)
        write_recordings(run, seed=seed)
    return write_page(study)


CHART = "document.querySelector('#responses .chart').view"
APPLIED = "document.querySelectorAll('#responses .chart')[2].view"
MOVE = (
    "const slide = document.querySelector('.slider input'); slide.value = arguments[0];"
    "slide.dispatchEvent(new Event('input')); const words = slide.ariaValueText;"
    f"return [words.split(':')[0], {CHART}.data('rows').length,"
    f" {APPLIED}.data('rows').reduce((sum, row) => sum + row.value ** 2, 0)]"
)


def move_through(browser: Any, values: tuple[float, ...]) -> tuple[list[int], list[float]]:
    """Move the slider through its places: how many rows are drawn there, and the inputs' energy."""
    wait_for(browser, APPLIED)
    rate = browser.execute_script("return DATA.slider.title")
    counts = []
    energies = []
    for place, value in enumerate(values):
        words, count, energy = browser.execute_script(MOVE, place)
        assert words == f"{rate} {value}"
        counts.append(count)
        energies.append(energy)
    return counts, energies


def test_a_slider_moves_the_responses_through_a_sweep_and_one_start_plays(
    browser: Any, tmp_path: Path
) -> None:
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get(write_sweep_page(tmp_path).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    expected = [0.1, 0.2, 0.3]
    assert browser.execute_script("return DATA.slider.values") == expected
    wait_for(browser, CHART)
    counts, inputs = move_through(browser, (0.1, 0.2, 0.3))
    assert counts[1] == 0 < min(counts[0], counts[2])
    assert inputs[1] == 0
    assert inputs[0] != inputs[2], "the input moves with the responses"
    player = "document.querySelectorAll('#responses .chart')[3]"
    wait_for(browser, f"{player}.view")
    assert browser.execute_script(f"return {player}.view.signal('moment') === {player}.end")
    shown = f"return {player}.view.signal('start')"
    assert browser.execute_script(shown) >= 1, "starts are counted from one"
    browser.execute_script("document.querySelector('[aria-pressed]').click()")
    wait_for(browser, f"{player}.view.signal('moment') < {player}.end")
    browser.execute_script("document.querySelector('[aria-pressed]').click()")
    assert browser.execute_script("return document.querySelector('[aria-pressed]').innerText") == (
        "Play"
    )
    browser.execute_script(MOVE, 1)  # no recording: charts that say so, and no complaint about them
    empty = "return [...document.querySelectorAll('#responses .chart')].map(c => c.dataset.empty)"
    assert browser.execute_script(empty)[0].startswith("No response: ")
    browser.execute_async_script(
        f"const done = arguments[0]; {CHART}.runAsync().then(() => done())"
    )
    assert complaints(browser) == []


def test_the_slider_says_why_a_run_is_infeasible_and_what_all_its_runs_share() -> None:
    table = pd.DataFrame(
        {
            "verdict": [SETTLED.word, "infeasible", "infeasible", SETTLED.word],
            "rate_controller": [0.2, 0.4, 0.1, 0.2],
            "controller_rate_limit": [0.219, 0.2191, 0.2191, 0.3],
            "infeasible_reason": [None, "rate 0.4 is infeasible", "the solver failed", None],
            "seed": [1, 1, 1, 0],
        }
    )
    slider = slider_settings(table)
    assert slider is not None
    assert slider["runs"] == [2, 0, 1]
    assert slider["notes"] == [
        "infeasible at this rate, with seed 1: the solver failed",
        f"{SETTLED.word}, with seed 1",
        "infeasible at this rate, with seed 1: the largest possible is 0.219",
    ]


def test_a_reason_does_not_say_once_more_that_the_run_is_infeasible() -> None:
    reason = "rate 0.4 is infeasible: the slopes allow only rates below 0.219"
    record = {"verdict": "infeasible", "infeasible_reason": reason}
    (outcome,) = outcome_remarks(record)
    assert outcome.text.endswith(" Rate 0.4: the slopes allow only rates below 0.219.")
    assert outcome.text.lower().count("infeasible") == 1


FRESH = {"verdict": SETTLED.word, "coverage": 1.068, "coverage_needed": 12.047, "fresh_sets": 3}


def test_fresh_data_beyond_the_proof_are_a_warning() -> None:
    """The proof covers the run's own records; data that nobody has used show more."""
    (remark,) = outcome_remarks(FRESH)
    assert remark.is_warning
    assert remark.text.endswith("3 fresh data sets show at most 12.05 times, more than is covered.")
    for harmless in ({"coverage_needed": 1.0}, {"coverage_needed": None}, {"coverage": None}):
        assert list(outcome_remarks(FRESH | harmless)) == []
