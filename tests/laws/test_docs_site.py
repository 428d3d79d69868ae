"""The documentation builds with warnings as errors, lists every module, and asks nothing of the
network to be read."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock
from report_browser import chromium

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(shared_folder: Path) -> Path:
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    folder = shared_folder / "site"
    built = shared_folder / "site.built"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    with FileLock(f"{folder}.lock"):
        if not built.exists():
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            built.touch()
    return folder


def test_every_module_is_in_the_reference(site: Path) -> None:
    pages = (site / "reference").rglob("index.html")
    text = "".join(page.read_text() for page in pages)
    paths = (ROOT / "ssm_study").glob("*/**/*.py")
    modules = [path for path in paths if path.name != "__init__.py"]
    for module in modules:
        parts = module.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts)
        assert name in text, f"{name} is not in the reference"


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text()
        for tag in re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", text):
            assert not re.search(r'(?:src|href)="(?:https?:)?//', tag), f"{page.name}: {tag}"


def test_formulas_are_drawn_without_script(site: Path) -> None:
    index_path = site / "howto_export" / "index.html"
    page = index_path.read_text()
    assert "<math" in page
    assert "arithmatex" not in page, "a formula was left as LaTeX"


def test_every_image_and_link_of_the_site_leads_somewhere(site: Path) -> None:
    dead = []
    for page in site.rglob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="([^"]+)"', text):
            if re.match(r"[a-z]+:|#|//", target):
                continue
            place = site / target.lstrip("/") if target.startswith("/") else page.parent / target
            place = Path(str(place).split("#")[0].split("?")[0])
            if not (place.is_file() or (place / "index.html").is_file()):
                dead.append(f"{page.relative_to(site)}: {target}")
    assert not dead, dead


def test_formulas_tables_and_names_are_legible_on_a_phone(site: Path, tmp_path: Path) -> None:
    """No page is wider than the phone, and the name of a column is not broken into two lines."""
    with chromium(tmp_path, phone=True) as driver:
        for page in ("howto_export", "engine", "notebooks/reading_a_sweep"):
            index_path = site / page / "index.html"
            driver.get(index_path.as_uri())
            assert driver.execute_script("return document.documentElement.scrollWidth") <= 390, page
        index_path = site / "engine" / "index.html"
        driver.get(index_path.as_uri())
        names = "[...document.querySelectorAll('td:first-child code')]"
        assert driver.execute_script(f"return {names}.length") > 50
        assert (
            driver.execute_script(
                f"return {names}.filter((name) => name.getClientRects().length > 1).length"
            )
            == 0
        )


def test_every_page_says_at_its_top_who_needs_it() -> None:
    paths = (ROOT / "docs").glob("*.md")
    for page in sorted(paths):
        if page.name != "index.md":
            text = page.read_text()
            assert text.split("\n")[2].startswith("*For "), page.name
