"""The notebooks run from top to bottom without a display or a network, on the smoke configuration."""

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted(path for path in (ROOT / "experiments").glob("*.py") if "# %%" in path.read_text())


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("notebooks") / "results"  # shared: what one has trained the next one finds


def test_there_are_four() -> None:
    assert len(NOTEBOOKS) == 4


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path: Path, results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebooks` is not installed")
    monkeypatch.setenv("SSM_STUDY_EXPERIMENT", "smoke")
    monkeypatch.setenv("SSM_STUDY_RESULTS", str(results))
    notebook = jupytext.read(path)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute(cwd=str(ROOT))
    assert pictures(notebook) >= 1, text(notebook)
    assert "Traceback" not in text(notebook), text(notebook)
    assert "$" not in shown_as_markdown(notebook), "exported to HTML, a formula between $ needs a network to be shown"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_page_that_the_site_shows_is_of_this_notebook(path: Path) -> None:
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    page = (ROOT / "docs" / "notebooks" / f"{path.stem}.md").read_text()
    code = [cell.source for cell in jupytext.read(path).cells if cell.cell_type == "code"]
    assert re.findall(r"```python\n(.*?)\n```", page, re.S) == code, "run python benchmarks/notebooks_rendered.py"
    shown = re.findall(r"!\[[^]]*\]\(([^)]+)\)", page)
    assert shown
    assert all((ROOT / "docs" / "notebooks" / name).is_file() for name in shown)


def pictures(notebook: Any) -> int:
    return sum("image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))


def shown_as_markdown(notebook: Any) -> str:
    outputs = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    written = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    return "".join(written + [data.get("text/markdown", "") for data in outputs])


def text(notebook: Any) -> str:
    return "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))
