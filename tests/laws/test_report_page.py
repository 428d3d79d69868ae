"""The report page in a real browser: it loads from disk without a request, sorts, filters, brushes,
is accessible."""

from pathlib import Path
from typing import Any

import pytest
import report_tables
from report_browser import (
    axe_script,
    chromium,
    complaints,
    count_shown_runs,
    groups_shown,
    wait_for,
)
from report_runs import random_run, write_recordings

from ssm_study.report.page.writing import write_page
from ssm_study.table.rank import sort_best_first

RUNS = 60


HOSTILE = '</script><script>hacked = 1</script><img src=x onerror="window.hacked = 1">'


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    table = report_tables.table(RUNS)
    table["error_message"] = None
    table.loc[table.status == "failed", "error_message"] = HOSTILE
    index = sort_best_first(table).index
    table["run"] = table["run"].where(table.index != index[0], "order8-width8-seed0-0123456789")
    sweep_path = tmp_path_factory.mktemp("study") / "sweep"
    folder = report_tables.write_study(sweep_path, table)
    run = sort_best_first(table)["run"]
    best, second = run.head(2)
    run = random_run(folder / best, kind="mlp", channels=1, seed=1)
    write_recordings(run)
    designs = [f"{k},{0.3 + 0.2 * k},{int(k > 2)}.0" for k in range(6)]
    comparison_path = folder / second / "comparison.csv"
    text = "\n".join(designs)
    comparison_path.write_text("design,mismatch_margin,stable_fraction\n" + text)
    return write_page(folder)


@pytest.fixture
def opened(browser: Any, page: Path) -> Any:
    browser.get("about:blank")
    browser.get_log("browser")  # what earlier pages logged
    browser.get(page.as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    return browser


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
    assert count_shown_runs(opened) == RUNS
    text = opened.execute_script("return document.getElementById('failures').textContent")
    assert "<img src=x" in text, "the message is shown as text"


def test_the_table_sorts_both_ways_by_click(opened: Any) -> None:
    button = "[data-column=fit_test_percent]"
    for direction in ("ascending", "descending"):
        element = opened.find_element("css selector", button)
        element.click()
        wait_for(
            opened, f"document.querySelector('{button}').parentElement.ariaSort === '{direction}'"
        )
        values = column(opened, "fit_test_percent")
        expected = sorted(values, reverse=direction == "descending")
        assert values == expected
        assert None not in values, "missing values come last, whichever way"


def test_filters_combine_and_reset(opened: Any) -> None:
    opened.find_element("css selector", "#verdicts input[value='infeasible']").click()
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{RUNS} ')")
    without = count_shown_runs(opened)
    assert "infeasible" not in column(opened, "verdict")
    element = opened.find_element("id", "text")
    element.send_keys("riccati settles")
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{without} ')")
    assert set(column(opened, "synthesis_method")) == {"riccati"}
    assert set(column(opened, "verdict")) == {"certified, settles"}
    opened.find_element("css selector", "#filters button[type=reset]").click()
    wait_for(opened, f"document.getElementById('count').textContent.startsWith('{RUNS} ')")


def test_a_brush_in_one_plot_filters_the_table_and_every_other_plot(opened: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    canvas = opened.find_element("css selector", "#plots canvas")
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    action_chains = ActionChains(opened, duration=60)
    drag = action_chains.move_to_element_with_offset(canvas, -60, -60).click_and_hold()
    drag.move_by_offset(60, 50).move_by_offset(60, 50).release().perform()
    wait_for(opened, f"!document.getElementById('count').textContent.startsWith('{RUNS} ')")
    low, high = opened.execute_script("return state.brushes[0].fit_test_percent")
    assert 0 < count_shown_runs(opened) < RUNS
    fits = column(opened, "fit_test_percent")
    assert all(low <= fit <= high for fit in fits)
    wait_for(opened, "STALE.size === 0 || [...STALE].every(n => !VISIBLE.has(n))")
    seen = opened.execute_script(
        "const n = [...VISIBLE].find(n => n > 0); return "
        "VIEWS[n].signal('mask').filter(Boolean).length"
    )
    assert seen == count_shown_runs(opened)
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
    order = [2, 4] * 6
    table = report_tables.table(12).assign(order=order)
    study_folder = report_tables.write_study(tmp_path / "study", table)
    browser.get(write_page(study_folder).as_uri())
    wait_for(browser, "document.body.dataset.ready === 'yes'")
    change = "menu.value = 'order'; menu.dispatchEvent(new Event('change'))"
    browser.execute_script(f"const menu = document.querySelector('[data-axis=across]'); {change}")
    labels = """const labels = (item) => item.role === 'axis-label'
      ? item.items.map((one) => one.text)
      : (item.items || []).flatMap(labels);
      return labels(VIEWS[DATA.panels.length].scenegraph().root)"""
    domain = "VIEWS[DATA.panels.length].scale('x').domain()"
    wait_for(browser, f"{domain}[0] > 1 && {domain}[1] < 5")
    texts = browser.execute_script(labels)
    expected = ["2", "3", "4"]
    assert [text for text in texts if float(text) < 5] == expected


def test_a_run_opens_and_closes_from_the_keyboard(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    link = opened.find_element("css selector", "#body tr th button")
    name = link.text
    link.send_keys(Keys.ENTER)
    wait_for(opened, "document.querySelectorAll('#run canvas').length >= 3")
    assert opened.execute_script("return document.activeElement.textContent") == name
    active_element = opened.switch_to.active_element
    active_element.send_keys(Keys.ESCAPE)
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


def cell_texts(driver: Any, selector: str) -> list[str]:
    script = "return [...document.querySelectorAll(arguments[0])].map(c => c.textContent)"
    return driver.execute_script(script, selector)


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
    head = cell_texts(opened, "#groups thead th")
    by, metric = opened.execute_script("return [state.group.by, state.group.metric]")
    table = opened.execute_script("return COLUMNS")
    words = opened.execute_script("return DATA.words")
    place = head.index(words[metric])
    groups = groups_shown(opened)
    assert head[0] == " · ".join(words[name] for name in by)
    rows = groups.values()
    assert sum(int(row[0]) for row in rows) == RUNS
    assert len(groups) >= 9, "three orders by three methods"
    for label, row in groups.items():
        here = [
            " · ".join(f"{table[n][i]:g}" if n != "synthesis_method" else table[n][i] for n in by)
            for i in range(RUNS)
        ]
        own = [v for v, s in zip(table[metric], here, strict=True) if s == label and v is not None]
        expected = here.count(label)
        assert int(row[0]) == expected
        if 0 < len(own) < 4:
            shown = [float(text) for text in row[place - 1].split(", ")]
            assert shown == pytest.approx(sorted(set(own)), rel=6e-3), "few values stand themselves"
        elif own:
            expected = sum(own) / len(own)
            assert float(row[place - 1].split(" ")[0]) == pytest.approx(expected, rel=6e-3)
    assert_total_row(opened, table[metric], place)


def assert_total_row(driver: Any, values: list[float | None], place: int) -> None:
    """Assert that the last row of the groups is the mean over all runs."""
    every = [v for v in values if v is not None]
    last = cell_texts(driver, "#groups tfoot tr > *")
    assert last[0] == "All"
    assert int(last[1]) == RUNS
    expected = sum(every) / len(every)
    assert float(last[place].split(" ")[0]) == pytest.approx(expected, rel=6e-3)


def test_a_link_keeps_what_was_chosen(opened: Any, page: Path) -> None:
    boxes = opened.find_elements("css selector", "#body input[type=checkbox]")
    for box in boxes[:2]:
        opened.execute_script("arguments[0].click()", box)
    element = opened.find_element("css selector", "[data-column=fit_test_percent]")
    element.click()
    wait_for(opened, "document.querySelectorAll('#side thead th').length === 3")
    rows = "[...document.querySelectorAll('#side tbody th')].map(th => th.textContent)"
    first = "DATA.first.map(name => DATA.words[name])"
    is_first = opened.execute_script(f"return {rows}.map(word => {first}.includes(word))")
    assert True in is_first
    assert False in is_first
    assert is_first == sorted(is_first, reverse=True), "what the table shows stands first"
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
    smallest = min(opened.execute_script(f"return arguments[0].map({varied})", names))
    assert smallest > 1
    assert "slope_upper" not in names, "every run has the same"


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
            "const done = arguments[0];"
            "axe.run({resultTypes: ['violations']}).then(r => done(r.violations))"
        )
        assert [
            (v["id"], v["nodes"][0]["html"])
            for v in found
            if v["impact"] in ("serious", "critical")
        ] == []
        ground = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
        expected = "rgb(22, 24, 27)" if where == "dark" else "rgb(255, 255, 255)"
        assert ground == expected
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
        study_folder = report_tables.write_study(tmp_path / "study", table)
        driver.get(write_page(study_folder).as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'")
        assert driver.execute_script("return document.documentElement.scrollWidth") <= 390


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
    expected = ["free-runs", "loops"]
    assert opened.execute_script(same) == expected
    legend = opened.execute_script("return [titleOf(0), printed(setting(DATA.parameters[0], 0))]")
    assert legend[1] in legend[0], "a legend names what was swept"
    far = "return [printed(0.99998), printed(1.00001), printed(0.5)]"
    expected = ["0.99998", "1.00001", "0.5"]
    assert opened.execute_script(far) == expected


def test_a_prediction_in_the_table_never_stands_without_its_doubt(opened: Any) -> None:
    script = (
        "COLUMNS.predicted_stable[0] = true; COLUMNS.evidence = COLUMNS.evidence || [];"
        "return ['doubt', 'cannot judge', 'sound'].map((word) => {"
        "COLUMNS.evidence[0] = word; return cellOf('predicted_stable', 0); })"
    )
    expected = ["yes, doubt", "cannot judge", "yes"]
    assert opened.execute_script(script) == expected


def test_every_chart_obeys_the_schema_of_vega_lite() -> None:
    alt = pytest.importorskip("altair", reason="the extra `report` is not installed")
    from ssm_study.report.page import charts

    table = report_tables.table(12)
    contents = charts.scatter_plot_contents(table)
    specifications = [content["spec"] for content in contents]
    specifications.append(charts.scatter_plot_specification(charts.EXPLORER, table))
    specifications.append(charts.group_chart_specification())
    assert len(specifications) > 5
    for specification in specifications:
        alt.TopLevelSpec.validate(specification)
        specification["layer"][-1]["mark"]["type"] = "pointt"
        with pytest.raises(Exception, match="pointt"):
            alt.TopLevelSpec.validate(specification)
