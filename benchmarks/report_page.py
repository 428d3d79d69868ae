"""How the report page answers a hand: frame times and long tasks in headless Chromium.

    python benchmarks/report_page.py [--runs 2000] [--rounds 3]

Mouse and keys are sent through the DevTools protocol, one event per 16 ms, to a page of made-up runs of every kind; no
graphics card. Per action, over all rounds: the time from one drawn frame to the next, and the tasks that held the page
for longer than 50 ms (W3C Long Tasks). Writes `results/reference/benchmarks/report_page.csv`. Needs chromium and
chromedriver.
"""

import argparse
import csv
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.report.page import write_page

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "results" / "reference" / "benchmarks" / "report_page.csv"
FRAME_S, REST_S = 0.016, 0.6
RECORDER = """
window.recorded = {frames: [], tasks: []};
new PerformanceObserver((list) => recorded.tasks.push(...list.getEntries().map((task) => task.duration)))
  .observe({type: 'longtask'});
let last = performance.now();
(function frame(now) { recorded.frames.push(now - last); last = now; requestAnimationFrame(frame); })(last);
"""


def mouse(driver: Any, kind: str, x: float, y: float, held: bool = False) -> None:
    button = "left" if held or kind == "mouseReleased" else "none"
    event = {"type": kind, "x": x, "y": y, "button": button, "buttons": int(held), "clickCount": 1}
    driver.execute_cdp_cmd("Input.dispatchMouseEvent", event)
    time.sleep(FRAME_S)


def plot(driver: Any) -> tuple[float, float, float, float]:
    """Left, top, width, height of the first plot, scrolled into view."""
    driver.execute_script("document.querySelector('#plots canvas').scrollIntoView({block: 'center'})")
    time.sleep(REST_S)
    box = driver.execute_script("return document.querySelector('#plots canvas').getBoundingClientRect().toJSON()")
    return box["left"], box["top"], box["width"], box["height"]


def path(box: tuple[float, float, float, float], steps: int) -> list[tuple[float, float]]:
    """A diagonal through the plot."""
    left, top, width, height = box
    share = np.linspace(0.3, 0.8, steps)
    return [(left + width * s, top + height * (s - 0.1)) for s in share]


def brush(driver: Any) -> None:
    points = path(plot(driver), 60)
    mouse(driver, "mouseMoved", *points[0])
    mouse(driver, "mousePressed", *points[0], held=True)
    for point in points:
        mouse(driver, "mouseMoved", *point, held=True)
    mouse(driver, "mouseReleased", *points[-1])


def hover(driver: Any) -> None:
    for point in path(plot(driver), 120):
        mouse(driver, "mouseMoved", *point)


def sort(driver: Any) -> None:
    for name in ("fit_test_percent", "fit_test_percent", "mismatch_margin", "verdict", "run", "run"):
        driver.execute_script(f"document.querySelector('[data-column={name}]').click()")
        time.sleep(REST_S / 2)


def search(driver: Any) -> None:
    field = driver.find_element("id", "text")
    for letter in "riccati settles":
        field.send_keys(letter)
        time.sleep(0.06)


def tick(driver: Any) -> None:
    for _ in range(2):
        for box in driver.find_elements("css selector", "#verdicts input"):
            driver.execute_script("arguments[0].click()", box)
            time.sleep(REST_S / 4)


def choose(driver: Any) -> None:
    for _ in range(5):
        driver.execute_script("step(1)" if driver.execute_script("return state.chosen >= 0") else "choose(0)")
        time.sleep(REST_S / 2)


ACTIONS: dict[str, Callable[[Any], None]] = {
    "sort": sort,
    "search": search,
    "tick outcomes": tick,
    "brush": brush,
    "hover": hover,
    "open runs": choose,
}


def measured(driver: Any, act: Callable[[Any], None]) -> tuple[list[float], list[float]]:
    """Milliseconds between frames and of long tasks while it acts; the page is put back afterwards."""
    driver.execute_script("recorded.frames = []; recorded.tasks = []")
    act(driver)
    time.sleep(REST_S)
    found = driver.execute_script("return recorded")
    driver.execute_script("if (state.chosen >= 0) closeRun(); document.querySelector('#filters').reset()")
    driver.execute_script("state.sort = {column: null, descending: false}; changed()")
    time.sleep(REST_S)
    return found["frames"], found["tasks"]


def rows(page: Path, profile: Path, rounds: int) -> list[dict[str, object]]:
    from report_browser import chromium, wait_for

    found: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in ACTIONS}
    with chromium(profile) as driver:
        began = time.perf_counter()
        driver.get(page.as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'", 120)
        load_s = time.perf_counter() - began
        driver.execute_script(RECORDER)
        for _ in range(rounds):
            for name, act in ACTIONS.items():
                for kept, new in zip(found[name], measured(driver, act), strict=True):
                    kept += new
    table = [{"action": name, **told(*times)} for name, times in found.items()]
    return [*table, {"action": "load", "worst_frame_ms": f"{1000 * load_s:.0f}"}]


def told(frames: list[float], tasks: list[float]) -> dict[str, object]:
    middle, late = np.percentile(frames, [50, 99])
    return {
        "frames": len(frames),
        "median_frame_ms": f"{middle:.0f}",
        "frame_99_percent_ms": f"{late:.0f}",
        "worst_frame_ms": f"{max(frames):.0f}",
        "long_tasks": len(tasks),
        "longest_task_ms": f"{max(tasks, default=0):.0f}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    sys.path.insert(0, str(ROOT / "tests"))
    import report_tables

    with tempfile.TemporaryDirectory() as folder:
        page = write_page(report_tables.write_study(Path(folder) / "study", report_tables.table(asked.runs)))
        table = rows(page, Path(folder) / "profile", asked.rounds)
    with OUT.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    print(OUT.read_text())


if __name__ == "__main__":
    main()
