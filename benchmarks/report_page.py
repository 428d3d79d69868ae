"""How the report page answers a hand: frame times and long tasks in headless Chromium.

    python benchmarks/report_page.py [--runs 2000] [--rounds 3]

Mouse and keys are sent through the DevTools protocol to a page of made-up runs of every kind; no
graphics card. Per action, over all rounds: the time from a click to the frame that answers it;
processor time of the page's main thread per step (one click, key or mouse move), which a busy
machine does not inflate; the time from one drawn frame to the next, and the tasks that held the
page for longer than 50 ms (W3C Long Tasks). Writes `results/reference/benchmarks/report_page.csv`.
Needs chromium and chromedriver.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from common import REFERENCE, ROOT, write

from ssm_study.report.page.writing import write_page

OUT = REFERENCE / "benchmarks" / "report_page.csv"
FRAME_S = 0.016
REST_S = 0.6
RECORDER = """
window.recorded = {frames: [], tasks: []};
new PerformanceObserver((list) =>
  recorded.tasks.push(...list.getEntries().map((task) => task.duration)))
  .observe({type: 'longtask'});
let last = performance.now();
(function frame(now) {
  recorded.frames.push(now - last); last = now; requestAnimationFrame(frame);
})(last);
"""
ANSWER = """const done = arguments[arguments.length - 1], begun = performance.now();
%s;
// in the same frame
requestAnimationFrame(() => setTimeout(() => done(performance.now() - begun)));"""


@dataclass
class Hand:
    """Clicks, types and drags.

    `cpu_ms` holds what the page's main thread computed for each step, `answer_ms` the time until a
    click was answered.
    """

    driver: Any
    cpu_ms: list[float] = field(default_factory=list)
    answer_ms: list[float] = field(default_factory=list)

    def thread_s(self) -> float:
        metrics = self.driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        return float(
            next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration")
        )

    @contextmanager
    def step(self, rest_s: float) -> Iterator[None]:
        before = self.thread_s()
        yield
        time.sleep(rest_s)
        self.cpu_ms.append(1000 * (self.thread_s() - before))

    def mouse(self, kind: str, point: tuple[float, float], held: bool = False) -> None:
        button = "left" if held or kind == "mouseReleased" else "none"
        event = {
            "type": kind,
            "x": point[0],
            "y": point[1],
            "button": button,
            "buttons": int(held),
            "clickCount": 1,
        }
        with self.step(FRAME_S):
            self.driver.execute_cdp_cmd("Input.dispatchMouseEvent", event)

    def script(self, script: str, *arguments: object, rest_s: float = REST_S / 2) -> None:
        with self.step(rest_s):
            self.answer_ms.append(self.driver.execute_async_script(ANSWER % script, *arguments))

    def plot(self, steps: int) -> list[tuple[float, float]]:
        """A diagonal through the first plot, scrolled into view."""
        found = "document.querySelector('#plots canvas')"
        self.driver.execute_script(f"{found}.scrollIntoView({{block: 'center'}})")
        time.sleep(REST_S)
        box = self.driver.execute_script(f"return {found}.getBoundingClientRect().toJSON()")
        shares = np.linspace(0.3, 0.8, steps)
        return [
            (box["left"] + box["width"] * s, box["top"] + box["height"] * (s - 0.1)) for s in shares
        ]


def brush(hand: Hand) -> None:
    points = hand.plot(60)
    hand.mouse("mouseMoved", points[0])
    hand.mouse("mousePressed", points[0], held=True)
    for point in points:
        hand.mouse("mouseMoved", point, held=True)
    hand.mouse("mouseReleased", points[-1])


def hover(hand: Hand) -> None:
    for point in hand.plot(120):
        hand.mouse("mouseMoved", point)


def sort(hand: Hand) -> None:
    hand.driver.execute_script("document.getElementById('runs').scrollIntoView()")
    for name in (
        "fit_test_percent",
        "fit_test_percent",
        "settling_time_mean_s",
        "verdict",
        "run",
        "run",
    ):
        hand.script(f"document.querySelector('[data-column={name}]').click()")


def select(hand: Hand) -> None:
    for setting in range(2):
        for k in (1, 2, 0):
            change = "s.selectedIndex = arguments[1]; s.dispatchEvent(new Event('change'))"
            hand.script(
                f"const s = document.querySelectorAll('[data-select]')[arguments[0]]; {change}",
                setting,
                k,
            )


def search(hand: Hand) -> None:
    text = hand.driver.find_element("id", "text")
    for letter in "riccati settles":
        with hand.step(0.06):
            text.send_keys(letter)


def tick(hand: Hand) -> None:
    for box in 2 * hand.driver.find_elements("css selector", "#verdicts input"):
        hand.script("arguments[0].click()", box, rest_s=REST_S / 4)


def choose(hand: Hand) -> None:
    for _ in range(5):
        hand.script("if (state.chosen >= 0) step(1); else choose(0)")


ACTIONS: dict[str, Callable[[Hand], None]] = {
    "sort": sort,
    "select": select,
    "search": search,
    "tick outcomes": tick,
    "brush": brush,
    "hover": hover,
    "open runs": choose,
}


def measured(driver: Any, act: Callable[[Hand], None]) -> tuple[list[float], ...]:
    """Frames, long tasks, processor time and answer per step, in milliseconds; the page is put back
    afterwards."""
    hand = Hand(driver)
    driver.execute_script("recorded.frames = []; recorded.tasks = []")
    act(hand)
    time.sleep(REST_S)
    found = driver.execute_script("return recorded")
    driver.execute_script(
        "if (state.chosen >= 0) closeRun(); document.querySelector('#filters').reset()"
    )
    driver.execute_script("state.sort = {column: null, descending: false}; changed()")
    time.sleep(REST_S)
    return found["frames"], found["tasks"], hand.cpu_ms, hand.answer_ms


def rows(page: Path, profile: Path, rounds: int) -> list[dict[str, object]]:
    from report_browser import chromium, wait_for

    found: dict[str, tuple[list[float], ...]] = {name: ([], [], [], []) for name in ACTIONS}
    with chromium(profile) as driver:
        driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
        driver.get(page.as_uri())
        wait_for(driver, "document.body.dataset.ready === 'yes'", 120)
        driver.execute_script(RECORDER)
        for _ in range(rounds):
            for name, act in ACTIONS.items():
                for kept, new in zip(found[name], measured(driver, act), strict=True):
                    kept += new
    return [{"action": name, **told(*times)} for name, times in found.items()]


def told(
    frames: list[float], tasks: list[float], cpu_ms: list[float], answer_ms: list[float]
) -> dict[str, object]:
    answers = {
        "answer_ms_median": np.median,
        "answer_ms_90_percent": lambda a: np.percentile(a, 90),
        "answer_ms_worst": max,
    }
    numbers = {name: of(answer_ms) if answer_ms else np.nan for name, of in answers.items()} | {
        "cpu_ms_per_step_median": np.median(cpu_ms),
        "cpu_ms_per_step_worst": max(cpu_ms),
        "frame_ms_median": np.median(frames),
        "frame_ms_99_percent": np.percentile(frames, 99),
        "longest_task_ms": max(tasks, default=0.0),
    }
    counts = {"steps": len(cpu_ms), "frames": len(frames), "long_tasks": len(tasks)}
    return counts | {
        name: "" if np.isnan(value) else f"{value:.0f}" for name, value in numbers.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    sys.path.insert(0, str(ROOT / "tests"))
    import report_tables

    with tempfile.TemporaryDirectory() as folder:
        page = write_page(
            report_tables.write_study(Path(folder) / "study", report_tables.table(asked.runs))
        )
        table = rows(page, Path(folder) / "profile", asked.rounds)
    write(OUT, table)
    print(OUT.read_text())


if __name__ == "__main__":
    main()
