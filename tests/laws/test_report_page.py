"""The report page in a real browser: it loads from disk without a request, sorts, filters, brushes,
is accessible."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import report_tables
from report_browser import axe_script, chromium, wait_for
from report_runs import random_run, write_recordings

from ssm_study.report.page.data import provenance
from ssm_study.report.page.writing import write_page
from ssm_study.report.study_folder import StudyFolder
from ssm_study.table.rank import best_first

RUNS = 150
HOSTILE = '</script><script>hacked = 1</script><img src=x onerror="window.hacked = 1">'


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    table = report_tables.table(RUNS)
    table["error_message"] = None
    table.loc[table.status == "failed", "error_message"] = HOSTILE
    table["run"] = table["run"].where(
        table.index != best_first(table).index[0], "order8-width8-seed0-0123456789"
    )
    folder = report_tables.write_study(tmp_path_factory.mktemp("study") / "sweep", table)
    best, second = best_first(table)["run"].head(2)
    write_recordings(random_run(folder / best, kind="mlp", channels=1, seed=1))
    designs = [f"{k},{0.3 + 0.2 * k},{int(k > 2)}.0" for k in range(6)]
    (folder / second / "comparison.csv").write_text(
        "design,mismatch_margin,stable_fraction\n" + "\n".join(designs)
    )
    return write_page(folder)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


def complaints(driver: Any) -> list[Any]:
    """Warnings and errors that the browser has logged since it was last asked."""
    return [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


@pytest.fixture
def opened(browser: Any, page: Path) -> Any:
    browser.get("about:blank")
    browser.get_log("browser")  # what earlier pages logged
    browser.get(page.as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    return browser


def shown(driver: Any) -> int:
    return int(
        driver.execute_script("return document.getElementById('count').textContent").split()[0]
    )


def column(driver: Any, name: str) -> list[Any]:
    script = (
        "return [...document.querySelectorAll('#body tr')].map(row => "
        "COLUMNS[arguments[0]][row.dataset.run])"
    )
    return driver.execute_script(script, name)


def test_it_loads_from_disk_without_error_or_request_and_runs_nothing_from_a_record(
    opened: Any,
) -> None:
    assert complaints(opened) == []
    assert opened.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert opened.execute_script("return window.hacked ?? null") is None
    assert shown(opened) == RUNS
    text = opened.execute_script("return document.getElementById('failures').textContent")
    assert "<img src=x" in text, "the message is shown as text"


def test_the_table_sorts_both_ways_by_click(opened: Any) -> None:
    button = "[data-column=fit_test_percent]"
    for direction in ("ascending", "descending"):
        opened.find_element("css selector", button).click()
        wait_for(
            opened, f"document.querySelector('{button}').parentElement.ariaSort === '{direction}'"
        )
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
    drag = (
        ActionChains(opened, duration=60)
        .move_to_element_with_offset(canvas, -60, -60)
        .click_and_hold()
    )
    drag.move_by_offset(60, 50).move_by_offset(60, 50).release().perform()
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{RUNS} ')")
    low, high = opened.execute_script("return state.brushes[0].fit_test_percent")
    assert 0 < shown(opened) < RUNS
    assert all(low <= fit <= high for fit in column(opened, "fit_test_percent"))
    wait_for(opened, "STALE.size === 0 || [...STALE].every(n => !VISIBLE.has(n))")
    seen = opened.execute_script(
        "const n = [...VISIBLE].find(n => n > 0); return "
        "VIEWS[n].signal('mask').filter(Boolean).length"
    )
    assert seen == shown(opened)
    opened.find_element("css selector", "#filters button[type=reset]").click()
    wait_for(opened, f"document.getElementById('count').textContent.startsWith('{RUNS} ')")


def test_every_dashed_line_that_a_note_speaks_of_is_drawn(opened: Any) -> None:
    script = """
      const dashed = (item) => item.items ? item.items.some(dashed) : Boolean(item.strokeDash);
      const drawn = (n) => dashed(VIEWS[n].scenegraph().root);
      return DATA.panels.map((panel, n) => [panel.note.startsWith("Dashed"), drawn(n)])"""
    found = opened.execute_script(script)
    assert sum(told for told, _ in found) >= 2
    assert all(told == drawn for told, drawn in found)


def test_an_axis_of_whole_numbers_has_whole_ticks(browser: Any, tmp_path: Path) -> None:
    """Between orders 2 and 4 stood 2.2, 2.6 and 3.4."""
    table = report_tables.table(12).assign(order=[2, 4] * 6)
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    change = "menu.value = 'order'; menu.dispatchEvent(new Event('change'))"
    browser.execute_script(f"const menu = document.querySelector('[data-axis=across]'); {change}")
    labels = """const labels = (item) => item.role === 'axis-label'
      ? item.items.map((one) => one.text)
      : (item.items || []).flatMap(labels);
      return labels(VIEWS[DATA.panels.length].scenegraph().root)"""
    domain = "VIEWS[DATA.panels.length].scale('x').domain()"
    wait_for(browser, f"{domain}[0] > 1 && {domain}[1] < 5")
    assert [text for text in browser.execute_script(labels) if float(text) < 5] == ["2", "3", "4"]


def test_a_run_opens_and_closes_from_the_keyboard(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    link = opened.find_element("css selector", "#body tr th button")
    name = link.text
    link.send_keys(Keys.ENTER)
    wait_for(opened, "document.querySelectorAll('#run canvas').length >= 3")
    assert opened.execute_script("return document.activeElement.textContent") == name
    opened.switch_to.active_element.send_keys(Keys.ESCAPE)
    wait_for(opened, "document.getElementById('run').hidden")
    assert opened.execute_script("return document.activeElement.textContent") == name, (
        "focus returns to where it was"
    )


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


def groups_shown(driver: Any) -> dict[str, list[str]]:
    """The cells of each group's row by its label."""
    cells = "row => Array.from(row.children, c => c.textContent)"
    rows = driver.execute_script(
        f"return Array.from(document.querySelectorAll('#groups tbody tr'), {cells})"
    )
    return {row[0]: row[1:] for row in rows}


def test_groups_by_any_settings_show_the_mean_over_their_runs(opened: Any) -> None:
    wait_for(opened, "document.querySelector('#groups tbody tr') !== null")
    for name in ("synthesis_method", "order", *opened.execute_script("return DATA.parameters")):
        box = opened.find_element("css selector", f"#group-form input[value={name}]")
        if box.is_selected() != (name in ("synthesis_method", "order")):
            opened.execute_script("arguments[0].click()", box)
    wait_for(
        opened,
        "[...document.querySelectorAll('#groups tbody th')].every((c) => "
        "c.textContent.includes(' · '))",
    )
    head = opened.execute_script(
        "return [...document.querySelectorAll('#groups thead th')].map(c => c.textContent)"
    )
    by, metric = opened.execute_script("return [state.group.by, state.group.metric]")
    table = opened.execute_script("return COLUMNS")
    place = head.index(opened.execute_script("return DATA.words[arguments[0]]", metric))
    groups = groups_shown(opened)
    assert head[0] == " · ".join(
        opened.execute_script("return arguments[0].map((n) => DATA.words[n])", by)
    )
    assert sum(int(row[0]) for row in groups.values()) == RUNS
    assert len(groups) >= 9, "three orders by three methods"
    for label, row in groups.items():
        here = [
            " · ".join(f"{table[n][i]:g}" if n != "synthesis_method" else table[n][i] for n in by)
            for i in range(RUNS)
        ]
        own = [v for v, s in zip(table[metric], here, strict=True) if s == label and v is not None]
        assert int(row[0]) == here.count(label)
        if own:
            assert float(row[place - 1].split(" ")[0]) == pytest.approx(
                sum(own) / len(own), rel=6e-3
            )
    every = [v for v in table[metric] if v is not None]
    last = opened.execute_script(
        "return [...document.querySelectorAll('#groups tfoot tr > *')].map(c => c.textContent)"
    )
    assert (last[0], int(last[1])) == ("All", RUNS)
    assert float(last[place].split(" ")[0]) == pytest.approx(sum(every) / len(every), rel=6e-3)


def test_runs_whose_rate_auto_chose_are_one_group(browser: Any, tmp_path: Path) -> None:
    table = report_tables.table(12).assign(
        synthesis_method="auto", rates_chosen="controller, observer"
    )
    table.loc[::2, ["rate_controller", "rates_chosen"]] = [0.1, "observer"]
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    browser.execute_script("state.group.by = ['rate_controller']; changed(true)")
    wait_for(browser, "document.querySelectorAll('#groups tbody tr').length === 2")
    assert {label: row[0] for label, row in groups_shown(browser).items()} == {
        "0.1": "6",
        "auto": "6",
    }


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
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text_of = "return [...document.querySelectorAll(arguments[0])].map((c) => c.innerText)"
    cards = browser.execute_script(text_of, ".card")
    assert (
        "Predicted for the plant\n2.04\nstability margin (above 1 is needed): it stays stable, "
        "with doubts; spectral radius of the controller 0.9 (below 1 is needed)"
    ) in cards
    assert cards[-1].startswith("Seen on the simulated plant\n10 of 10\nstarts settle, in 0.")
    (evidence,) = browser.execute_script(text_of, ".evidence li")
    doubts = "The records leave a doubt. The record is short."
    assert " ".join(evidence.split()) == f"Evidence: doubt {doubts} 1 note", "what matters first"
    note = browser.execute_script(
        "return document.querySelector('.evidence details p').textContent"
    )
    assert note == "Note: One amplitude: the record shows no other."
    absent = "return ['compare', 'filters', 'beside'].map((id) => document.getElementById(id))"
    assert browser.execute_script(absent) == [None] * 3, "a single run has nothing to compare"


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
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
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
    table = pd.concat([table[table["status"] == "ok"].head(1)] * 2, ignore_index=True).assign(
        run=["bare", "untried"]
    )
    table["uncertified_reason"] = ["observer: not positive definite", None]
    table["observer_certified"], table["stable_fraction"] = [False, True], [1.0, None]
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    text = browser.execute_script("return document.getElementById('failures').textContent")
    assert "not certified: observer: not positive definite" in text
    assert (
        "certified, not tried: both certificates hold; the model answers its input at once" in text
    )
    assert "Nothing failed" not in text


def test_a_link_keeps_what_was_chosen(opened: Any, page: Path) -> None:
    boxes = opened.find_elements("css selector", "#body input[type=checkbox]")
    for box in boxes[:2]:
        opened.execute_script("arguments[0].click()", box)
    opened.find_element("css selector", "[data-column=fit_test_percent]").click()
    wait_for(opened, "document.querySelectorAll('#side thead th').length === 3")
    wait_for(opened, "location.hash.includes('fit_test_percent')")
    link = opened.current_url
    picked = opened.execute_script("return [...state.picked].sort()")
    opened.get("about:blank")
    opened.get(link)
    wait_for(opened, "document.body.dataset.ready === 'yes'")
    assert opened.execute_script("return [...state.picked].sort()") == picked
    assert opened.execute_script("return state.sort.column") == "fit_test_percent"
    assert opened.execute_script("return document.querySelectorAll('#side thead th').length") == 3
    opened.get(page.as_uri())


def test_menus_list_what_varies_by_the_part_that_it_describes(opened: Any) -> None:
    script = (
        "return [...document.querySelectorAll('#range-column optgroup')].map(g => [g.label, "
        "g.children.length])"
    )
    groups = dict(opened.execute_script(script))
    filled = [
        "Settings",
        "Model",
        "Slopes and linear part",
        "Design",
        "Closed loop",
        "Circumstances",
    ]
    assert list(groups) == filled, "no empty group"
    listed = (
        "return [...document.querySelectorAll('#range-column option')].map(o => "
        "o.value).filter(Boolean)"
    )
    names = opened.execute_script(listed)
    varied = "name => new Set(COLUMNS[name].filter(v => v !== null)).size"
    assert min(opened.execute_script(f"return arguments[0].map({varied})", names)) > 1
    assert "slope_upper" not in names, "every run has the same"


def test_a_name_shows_what_not_all_runs_share_and_the_best_run_has_a_ring(
    browser: Any, tmp_path: Path
) -> None:
    table = best_first(report_tables.table(4)).reset_index(drop=True)
    digits = [f"{k:010x}" for k in range(4)]
    table["run"] = [f"order{4 + k // 2}-width8-seed0-{digits[k]}" for k in range(4)]
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    links = browser.execute_script(
        "return [...document.querySelectorAll('#body tr th button')].map(b => b.textContent)"
    )
    assert links == [f"order{4 + k // 2}-{digits[k]}" for k in range(4)]
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
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
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
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'", 5)
    text = browser.execute_script("return document.getElementById('lead').innerText")
    assert "largest rate that can be certified\n" in text


@pytest.mark.parametrize("where", ["desk", "phone", "dark"])
def test_axe_has_no_serious_finding_and_a_phone_need_not_scroll_sideways(
    tmp_path: Path, page: Path, where: str
) -> None:
    with chromium(tmp_path, phone=where == "phone", dark=where == "dark") as driver:
        driver.get(page.as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'")
        driver.execute_script("choose(0)")
        wait_for(driver, "document.querySelectorAll('#run canvas').length >= 3")
        driver.execute_script(axe_script())
        found = driver.execute_async_script(
            "const done = arguments[0]; axe.run().then(r => done(r.violations))"
        )
        assert [
            (v["id"], v["nodes"][0]["html"])
            for v in found
            if v["impact"] in ("serious", "critical")
        ] == []
        ground = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert ground == ("rgb(22, 24, 27)" if where == "dark" else "rgb(255, 255, 255)")
        painted = driver.execute_script("return VIEWS.map(view => view.background().toLowerCase())")
        assert set(painted) == {"#16181b" if where == "dark" else "white"}
        if where == "phone":
            told = driver.execute_script("return document.querySelector('#body .settings')")
            shown = driver.execute_script("return getComputedStyle(arguments[0]).display", told)
            assert shown == "none", "the digits alone tell runs apart"
            assert (
                driver.execute_script("return arguments[0].nextSibling.textContent", told)
                == "0123456789"
            )
            assert driver.execute_script("return document.documentElement.scrollWidth") <= 390


def test_an_error_without_a_place_to_break_fits_on_a_phone(tmp_path: Path) -> None:
    """The path of a file widened the whole page to 581 pixels."""
    table = report_tables.table(20)
    table["error_message"] = table["status"].map(
        {"failed": f"no such file: /{'folder/' * 12}log.csv"}
    )
    with chromium(tmp_path / "profile", phone=True) as driver:
        driver.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'")
        assert driver.execute_script("return document.documentElement.scrollWidth") <= 390


def test_of_runs_at_one_point_the_lines_lie_within_the_plots(browser: Any, tmp_path: Path) -> None:
    """An axis around the runs alone would leave the plant's own time, a limit or margin one far
    outside the figure."""
    one = report_tables.table(60)
    one = one[one["settling_time_open_loop_s"].notna() & one["settling_time_mean_s"].notna()].head(
        1
    )
    one = pd.concat([one, one.assign(run="again")], ignore_index=True)
    browser.get(write_page(report_tables.write_study(tmp_path / "one", one)).as_uri())
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
    browser.get(write_page(report_tables.write_study(tmp_path / "study", table)).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert browser.execute_script("return RUNS") == len(table)
    assert not len(table) or shown(browser) == len(table)


def test_two_studies_stand_on_one_page(browser: Any, tmp_path: Path) -> None:
    for name, runs in (("first", 5), ("second", 3)):
        table = report_tables.table(runs).assign(study=name)
        report_tables.write_study(tmp_path / name, table)
    path = write_page(tmp_path / "first", (tmp_path / "second",))
    assert path.name == "report_with_second.html"
    browser.get(path.as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    assert shown(browser) == 8
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
        study = StudyFolder(folder=report_tables.write_study(tmp_path / str(len(told)), table))
        assert dict(provenance(study, study.table))["working tree"].startswith(told)


def test_pictures_and_overlays_are_drawn_and_points_take_the_colours_of_a_setting(
    opened: Any,
) -> None:
    """The best run left recordings; two picked runs stand in one axis; a menu recolours."""
    names = opened.execute_script(
        "return [...document.querySelectorAll('#best-pictures figure')].map(f => f.dataset.picture)"
    )
    assert {"free_run", "loop_poles", "input_map"} <= set(names)
    figure = "#best-pictures [data-picture=free_run]"
    opened.execute_script(f"document.querySelector('{figure}').scrollIntoView()")
    wait_for(opened, f"document.querySelector('{figure} canvas')")
    script = "return coloured(DATA.panels[0].spec).layer.at(-1).encoding.color.field"
    opened.execute_script("state.colour = ''")
    assert opened.execute_script(script) == "verdict"
    opened.execute_script("state.colour = DATA.parameters[0]")
    assert opened.execute_script(script) == "colour"
    same = "const run = COLUMNS.run[0]; DATA.trajectories.twin = DATA.trajectories[run];"
    same += "COLUMNS.run[1] = 'twin'; const figures = overlayFigures([0, 1]);"
    same += "return figures.map(({ dataset }) => dataset.overlay)"
    assert opened.execute_script(same) == ["free-runs", "loops"]
    far = "return [printed(0.99998), printed(1.00001), printed(0.5)]"
    assert opened.execute_script(far) == ["0.99998", "1.00001", "0.5"]


def test_a_prediction_in_the_table_never_stands_without_its_doubt(opened: Any) -> None:
    script = (
        "COLUMNS.predicted_stable[0] = true; COLUMNS.evidence = COLUMNS.evidence || [];"
        "return ['doubt', 'cannot judge', 'sound'].map((word) => {"
        "COLUMNS.evidence[0] = word; return cellOf('predicted_stable', 0); })"
    )
    assert opened.execute_script(script) == ["yes, doubt", "cannot judge", "yes"]


def test_a_slider_moves_the_responses_through_a_sweep_and_one_start_plays(
    browser: Any, tmp_path: Path
) -> None:
    table = report_tables.table(60)
    table = table[table["status"] == "ok"].head(3).reset_index(drop=True)
    table = pd.concat([table.head(1)] * 3, ignore_index=True)
    table = table.assign(run=["a", "b", "c"], rate_controller=[0.1, 0.3, 0.2], rates_chosen=None)
    folder = report_tables.write_study(tmp_path / "study", table)
    for seed, name in enumerate(("a", "b"), start=1):  # the third left no recording
        write_recordings(random_run(folder / name, kind="mlp", channels=1, seed=seed))
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get(write_page(folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    assert browser.execute_script("return DATA.slider.values") == [0.1, 0.2, 0.3]
    chart = "document.querySelector('#responses .chart').view"
    wait_for(browser, chart)
    move = (
        "const slide = document.querySelector('.slider input'); slide.value = arguments[0];"
        "slide.dispatchEvent(new Event('input')); const words = slide.ariaValueText;"
        f"return [words.split(':')[0], {chart}.data('rows').length]"
    )
    rate = browser.execute_script("return DATA.slider.title")
    counts = []
    for place, value in enumerate((0.1, 0.2, 0.3)):
        words, count = browser.execute_script(move, place)
        assert words == f"{rate} {value}"
        counts.append(count)
    assert counts[1] == 0 < min(counts[0], counts[2])
    player = "document.querySelectorAll('#responses .chart')[3]"
    wait_for(browser, f"{player}.view")
    assert browser.execute_script(f"return {player}.view.signal('moment') === {player}.end")
    browser.execute_script("document.querySelector('[aria-pressed]').click()")
    wait_for(browser, f"{player}.view.signal('moment') < {player}.end")
    browser.execute_script("document.querySelector('[aria-pressed]').click()")
    assert browser.execute_script("return document.querySelector('[aria-pressed]').innerText") == (
        "Play"
    )
    browser.execute_script(move, 1)  # no recording: empty charts, and no complaint about them
    browser.execute_async_script(
        f"const done = arguments[0]; {chart}.runAsync().then(() => done())"
    )
    assert complaints(browser) == []
