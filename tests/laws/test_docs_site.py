"""The documentation builds with warnings as errors, lists every module, and asks nothing of the network to be read."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_module_is_in_the_reference(site: Path) -> None:
    text = "".join(page.read_text() for page in (site / "reference").rglob("index.html"))
    modules = [path for path in (ROOT / "ssm_study").glob("*/**/*.py") if path.name != "__init__.py"]
    for module in modules:
        name = ".".join(module.relative_to(ROOT).with_suffix("").parts)
        assert name in text, f"{name} is not in the reference"


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        for tag in re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text()):
            assert not re.search(r'(?:src|href)="(?:https?:)?//', tag), f"{page.name}: {tag}"


def test_formulas_are_drawn_without_script(site: Path) -> None:
    page = (site / "howto_export" / "index.html").read_text()
    assert "<math" in page
    assert "arithmatex" not in page, "a formula was left as LaTeX"
