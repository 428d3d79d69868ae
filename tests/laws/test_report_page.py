"""The report page in a real browser: it loads from disk without a request, sorts, filters, brushes, is accessible."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import report_tables
from report_browser import axe_script, chromium, wait_for
from report_runs import random_run, write_recordings

from ssm_study.report.page import write_page
from ssm_study.report.verdict import best_first

RUNS = 150
HOSTILE = '</script><script>hacked = 1</script><img src=x onerror="window.hacked = 1">'


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    table = report_tables.table(RUNS)
    table["error_message"] = None
    table.loc[table.status == "failed", "error_message"] = HOSTILE
    folder = report_tables.write_study(tmp_path_factory.mktemp("study") / "sweep", table)
    best, second = best_first(table)["run"].head(2)
    write_recordings(random_run(folder / best, kind="mlp", channels=1, seed=1))
    designs = [f"{k},{0.3 + 0.2 * k},{int(k > 2)}.0" for k in range(6)]
    (folder / second / "comparison.csv").write_text("design,mismatch_margin,stable_fraction\n" + "\n".join(designs))
    return write_page(folder)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture
def opened(browser: Any, page: Path) -> Any:
    browser.get(page.as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    return browser


def shown(driver: Any) -> int:
    return int(driver.execute_script("return document.getElementById('count').textContent").split()[0])


def column(driver: Any, name: str) -> list[Any]:
    script = "return [...document.querySelectorAll('#body tr')].map(row => COLUMNS[arguments[0]][row.dataset.run])"
    return driver.execute_script(script, name)


def test_it_loads_from_disk_without_error_or_request_and_runs_nothing_from_a_record(opened: Any) -> None:
    assert [entry for entry in opened.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")] == []
    assert opened.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert opened.execute_script("return window.hacked ?? null") is None
    assert shown(opened) == RUNS
    text = opened.execute_script("return document.getElementById('failures').textContent")
    assert "<img src=x" in text, "the message is shown as text"


def test_the_table_sorts_both_ways_by_click(opened: Any) -> None:
    button = "[data-column=fit_test_percent]"
    for direction in ("ascending", "descending"):
        opened.find_element("css selector", button).click()
        wait_for(opened, f"document.querySelector('{button}').parentElement.ariaSort === '{direction}'")
        values = column(opened, "fit_test_percent")
        assert values == sorted(values, reverse=direction == "descending")
        assert None not in values, "missing values come last, whichever way"


def test_filters_combine_and_reset(opened: Any) -> None:
    opened.find_element("css selector", "#verdicts input[value='infeasible']").click()
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{RUNS} ')")
    without = shown(opened)
    assert "infeasible" not in column(opened, "verdict")
    opened.find_element("id", "text").send_keys("riccati settles")
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{without} ')")
    assert set(column(opened, "synthesis_method")) == {"riccati"}
    assert set(column(opened, "verdict")) == {"certified, settles"}
    opened.find_element("css selector", "#filters button[type=reset]").click()
    wait_for(opened, f"document.getElementById('count').textContent.startsWith('{RUNS} ')")


def test_a_brush_in_one_plot_filters_the_table_and_every_other_plot(opened: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    canvas = opened.find_element("css selector", "#plots canvas")
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    drag = ActionChains(opened, duration=60).move_to_element_with_offset(canvas, -60, -60).click_and_hold()
    drag.move_by_offset(60, 50).move_by_offset(60, 50).release().perform()
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{RUNS} ')")
    low, high = opened.execute_script("return state.brushes[0].fit_test_percent")
    assert 0 < shown(opened) < RUNS
    assert all(low <= fit <= high for fit in column(opened, "fit_test_percent"))
    wait_for(opened, "STALE.size === 0 || [...STALE].every(n => !VISIBLE.has(n))")
    seen = opened.execute_script(
        "const n = [...VISIBLE].find(n => n > 0); return VIEWS[n].signal('mask').filter(Boolean).length"
    )
    assert seen == shown(opened)
    opened.find_element("css selector", "#filters button[type=reset]").click()
    wait_for(opened, f"document.getElementById('count').textContent.startsWith('{RUNS} ')")


def test_every_dashed_line_that_a_note_speaks_of_is_drawn(opened: Any) -> None:
    script = """
      const dashed = (item) => item.items ? item.items.some(dashed) : Boolean(item.strokeDash);
      return DATA.panels.map((panel, n) => [panel.note.startsWith("Dashed"), dashed(VIEWS[n].scenegraph().root)])"""
    found = opened.execute_script(script)
    assert sum(told for told, _ in found) >= 2
    assert all(told == drawn for told, drawn in found)


def test_a_run_opens_and_closes_from_the_keyboard(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    link = opened.find_element("css selector", "#body tr th button")
    name = link.text
    link.send_keys(Keys.ENTER)
    wait_for(opened, "document.querySelectorAll('#run canvas').length === 4")
    assert opened.execute_script("return document.activeElement.textContent") == name
    opened.switch_to.active_element.send_keys(Keys.ESCAPE)
    wait_for(opened, "document.getElementById('run').hidden")
    assert opened.execute_script("return document.activeElement.textContent") == name, "focus returns to where it was"


def test_a_run_shows_the_controllers_and_the_designs_that_it_compared(opened: Any) -> None:
    opened.execute_script("choose(0)")
    wait_for(opened, "document.querySelectorAll('#run .compared tbody tr').length === 2")
    text = opened.execute_script("return document.querySelector('#run .compared').textContent")
    for words in ("PI", "auto", "delay", "90 %", "0.1 s"):
        assert words in text
    opened.execute_script("choose(1)")
    wait_for(opened, "document.querySelectorAll('#run canvas').length === 1")
    text = opened.execute_script("return document.querySelector('#run-content').textContent")
    assert "6 certified designs for this model" in text
    assert "Above margin one 2 of 2 bring every start to rest, at or below it 1 of 4" in text


def test_the_best_run_of_the_answers_opens_by_its_name(opened: Any) -> None:
    button = opened.find_element("css selector", "#answers button")
    name = button.text
    opened.execute_script("arguments[0].click()", button)
    wait_for(opened, "!document.getElementById('run').hidden")
    assert opened.execute_script("return document.getElementById('run-title').textContent") == name


def test_two_thousand_runs_follow_a_drag(browser: Any, tmp_path: Path) -> None:
    """Median of what a frame costs: filter, table and one plot. The bound leaves room for a loaded machine."""
    study = report_tables.write_study(tmp_path / "large", report_tables.table(2000))
    browser.get(write_page(study).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    times = browser.execute_async_script(
        """const done = arguments[0]; (async () => {
             const times = [];
             for (let k = 0; k < 20; k++) {
               state.brushes[0] = {fit_test_percent: [70 + k / 2, 90]};
               const start = performance.now();
               drawTable(mask());
               await VIEWS[0].signal('mask', mask()).runAsync();
               times.push(performance.now() - start);
             }
             state.brushes = {}; changed(); done(times);
           })()"""
    )
    assert sorted(times)[10] < 400


@pytest.mark.parametrize("where", ["desk", "phone", "dark"])
def test_axe_has_no_serious_finding_and_a_phone_need_not_scroll_sideways(
    tmp_path: Path, page: Path, where: str
) -> None:
    with chromium(tmp_path, phone=where == "phone", dark=where == "dark") as driver:
        driver.get(page.as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'")
        driver.execute_script("choose(0)")
        wait_for(driver, "document.querySelectorAll('#run canvas').length === 4")
        driver.execute_script(axe_script())
        found = driver.execute_async_script("const done = arguments[0]; axe.run().then(r => done(r.violations))")
        assert [(v["id"], v["nodes"][0]["html"]) for v in found if v["impact"] in ("serious", "critical")] == []
        ground = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert ground == ("rgb(22, 24, 27)" if where == "dark" else "rgb(255, 255, 255)")
        painted = driver.execute_script("return VIEWS.map(view => view.background().toLowerCase())")
        assert set(painted) == {"#16181b" if where == "dark" else "white"}
        if where == "phone":
            assert driver.execute_script("return document.documentElement.scrollWidth") <= 390


def test_of_a_single_run_the_lines_lie_within_the_plots(browser: Any, tmp_path: Path) -> None:
    """An axis around the run alone would leave the plant's own time, a limit or margin one far outside the figure."""
    one = report_tables.table(60)
    one = one[one["settling_time_open_loop_s"].notna() & one["settling_time_mean_s"].notna()].head(1)
    browser.get(write_page(report_tables.write_study(tmp_path / "one", one)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    heights = browser.execute_script(
        "return [...document.querySelectorAll('.chart canvas')].map((c) => c.clientHeight)"
    )
    assert len(heights) >= len(browser.execute_script("return DATA.panels"))
    assert max(heights) < 400


@pytest.mark.parametrize("table", [report_tables.empty(), report_tables.failures()], ids=["empty", "failures"])
def test_a_study_without_results_still_has_a_page(browser: Any, tmp_path: Path, table: Any) -> None:
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert shown(browser) == len(table)
