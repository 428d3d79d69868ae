"""A headless Chromium for the tests of the report page; they skip with a reason where there is
none."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

SWITCHES = (
    "headless",
    "no-sandbox",
    "disable-gpu",
    "disable-quic",
    "no-first-run",
    "disable-background-networking",
    "disable-component-update",
    "disable-sync",
    "hide-scrollbars",
)
PHONE = {"deviceMetrics": {"width": 390, "height": 844, "pixelRatio": 2, "touch": True}}


@contextmanager
def chromium(profile: Path, *, phone: bool = False, dark: bool = False) -> Iterator[Any]:
    """A Selenium driver with a fresh profile, its console kept."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    names = ("chromium", "chromedriver")
    found = {name: shutil.which(name) for name in names}
    if not all(found.values()):
        pytest.skip(
            "no chromium with chromedriver on this machine (Debian: chromium, chromium-driver)"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = found["chromium"]
    for switch in (*SWITCHES, f"user-data-dir={profile}", "window-size=1400,1000"):
        options.add_argument(f"--{switch}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    if phone:
        options.add_experimental_option("mobileEmulation", PHONE)
    service = webdriver.ChromeService(found["chromedriver"])
    driver = webdriver.Chrome(options=options, service=service)
    try:
        driver.set_script_timeout(60)
        if dark:
            features = [{"name": "prefers-color-scheme", "value": "dark"}]
            asked = {"features": features}
            driver.execute_cdp_cmd("Emulation.setEmulatedMedia", asked)
        yield driver
    finally:
        driver.quit()


def wait_for(driver: Any, condition: str, seconds: float = 30) -> None:
    """Until the JavaScript expression holds."""
    from selenium.webdriver.support.ui import WebDriverWait

    web_driver_wait = WebDriverWait(driver, seconds, 0.05)
    web_driver_wait.until(lambda d: d.execute_script(f"return Boolean({condition})"), condition)


def axe_script() -> str:
    """The accessibility checker: `$AXE_CORE` (an axe.min.js), else the one in the package
    `axe-core-python`."""
    if path := os.environ.get("AXE_CORE"):
        return Path(path).read_text()
    package = pytest.importorskip(
        "axe_core_python", reason="axe-core-python is not installed and AXE_CORE is not set"
    )
    return Path(package.__file__).with_name("axe.min.js").read_text()


def count_shown_runs(driver: Any) -> int:
    """How many runs the page says that its table shows."""
    text = driver.execute_script("return document.getElementById('count').textContent")
    return int(text.split()[0])


def groups_shown(driver: Any) -> dict[str, list[str]]:
    """The cells of each group's row by its label."""
    cells = "row => Array.from(row.children, c => c.textContent)"
    rows = driver.execute_script(
        f"return Array.from(document.querySelectorAll('#groups tbody tr'), {cells})"
    )
    return {row[0]: row[1:] for row in rows}


def complaints(driver: Any) -> list[Any]:
    """Warnings and errors that the browser has logged since it was last asked."""
    return [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
