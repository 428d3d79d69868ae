"""The notebooks run from top to bottom without a display or a network, on the smoke
configuration."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from docs_commands import FEW

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted(
    path for path in (ROOT / "experiments").glob("*.py") if "# %%" in path.read_text()
)


# One trains on logs of its own, with settings of its own: the same, shorter, and of the designs'
# grid as of commands'.
WHOLE = '"training.max_epochs=60")'
SHORT = ['"training.max_epochs=12"', '"model.starts=1"', '"model.draws=1"']
SHORT += [f'"+synthesis.{name}={values}"' for name, values in FEW.items()]


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One for all notebooks, emptied before each: to load the libraries takes longer than a short
    notebook.

    Their results are shared too: what one has trained the next one finds.
    """
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebooks` is not installed")
    nbformat = pytest.importorskip("nbformat", reason="the extra `notebooks` is not installed")
    first = nbclient.NotebookClient(nbformat.v4.new_notebook(), kernel_name="python3")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SSM_STUDY_EXPERIMENT", "smoke")
        results_path = str(tmp_path_factory.mktemp("notebooks") / "results")
        patch.setenv("SSM_STUDY_RESULTS", results_path)
        with first.setup_kernel(cwd=str(ROOT)):
            yield first.km


def test_there_are_five() -> None:
    assert len(NOTEBOOKS) == 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path: Path, kernel: Any) -> None:
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebooks` is not installed")
    script = "# %%\n%reset -f\n" + path.read_text()
    expected = path.stem == "your_own_data"
    assert (WHOLE in script) == expected
    notebook = jupytext.reads(script.replace(WHOLE, ", ".join(SHORT) + ")"), fmt="py:percent")
    notebook_client = nbclient.NotebookClient(notebook, timeout=300, km=kernel)
    notebook_client.execute()
    assert pictures(notebook) >= 1, text(notebook)
    assert "Traceback" not in text(notebook), text(notebook)
    assert "$" not in shown_as_markdown(notebook), (
        "exported to HTML, a formula between $ needs a network to be shown"
    )


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_page_that_the_site_shows_is_of_this_notebook(path: Path) -> None:
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    notebooks_path = ROOT / "docs" / "notebooks"
    page = (notebooks_path / f"{path.stem}.md").read_text()
    cells = jupytext.read(path).cells
    code = [cell.source for cell in cells if cell.cell_type == "code"]
    assert re.findall(r"```python\n(.*?)\n```", page, re.S) == code, (
        "run python benchmarks/notebooks_rendered.py"
    )
    shown = re.findall(r"!\[[^]]*\]\(([^)]+)\)", page)
    assert shown
    assert all((ROOT / "docs" / "notebooks" / name).is_file() for name in shown)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_jupyter_file_is_the_same_notebook(path: Path) -> None:
    """`python benchmarks/notebooks_rendered.py --ipynb` writes it."""
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    places = (path, path.with_suffix(".ipynb"))
    ours, written = (
        [(cell.cell_type, cell.source) for cell in jupytext.read(place).cells] for place in places
    )
    assert ours == written


def pictures(notebook: Any) -> int:
    return sum(
        "image/png" in output.get("data", {})
        for cell in notebook.cells
        for output in cell.get("outputs", [])
    )


def shown_as_markdown(notebook: Any) -> str:
    outputs = [
        output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])
    ]
    written = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    return "".join(written + [data.get("text/markdown", "") for data in outputs])


def text(notebook: Any) -> str:
    return "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", [])
    )
