"""The notebooks run from top to bottom without a display or a network, on the smoke
configuration."""

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from docs_commands import FEW

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted(
    path for path in (ROOT / "experiments").glob("*.py") if "# %%" in path.read_text()
)


# The same cells with less work in them: of a notebook's words those that make its copy short.
FEW_WORDS = ", ".join(f'"+synthesis.{name}={values}"' for name, values in FEW.items())
SHORTER = {
    "your_own_data": {
        "STEP_S, **SETTINGS": 'STEP_S, "training.max_epochs=4", **SETTINGS',
        "st.control(model)": f"st.control(model, {FEW_WORDS})",
    },
    "reading_a_sweep": {
        '"progress=false"]': '"progress=false", "hydra/launcher=basic"]',
        '"model.slope_lower=0.01,0.2"': '"model.slope_lower=0.2", "training.max_epochs=2"',
    },
    "strange_log": {'"training.max_epochs=10"': '"training.max_epochs=2"'},
}


@pytest.fixture(scope="module")
def shell(
    tmp_path_factory: pytest.TempPathFactory,
    smoke_store: Path,
    made_once: None,  # noqa: ARG001
) -> Iterator[Any]:
    """The shell of a Jupyter kernel, in this process, one for all notebooks: a process of its own
    loads the libraries for longer than a short notebook takes.

    Their results are shared too: what one has trained the next one finds.
    """
    shells = pytest.importorskip(
        "IPython.core.interactiveshell", reason="the extra `notebooks` is not installed"
    )
    history = {"HistoryManager": {"enabled": False}}
    config = pytest.importorskip("traitlets.config").Config(history)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SSM_STUDY_EXPERIMENT", "smoke")
        results_path = tmp_path_factory.mktemp("notebooks") / "results"
        results_path.mkdir()
        (results_path / ".store").symlink_to(smoke_store)
        patch.setenv("SSM_STUDY_RESULTS", str(results_path))
        patch.setattr("ssm_study.cli.summary.RUN_FIGURES", ())  # each is drawn where it is shown
        patch.chdir(ROOT)
        notebook = ModuleType("notebook")
        running = shells.InteractiveShell.instance(user_module=notebook, config=config)
        yield running
        running.restore_sys_module_state()
        shells.InteractiveShell.clear_instance()


def test_there_are_five() -> None:
    assert len(NOTEBOOKS) == 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path: Path, shell: Any) -> None:
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    capture = pytest.importorskip("IPython.utils.capture").capture_output
    script = path.read_text()
    for whole, short in SHORTER.get(path.stem, {}).items():
        assert whole in script
        script = script.replace(whole, short)
    shell.reset(new_session=False)
    data: list[dict[str, Any]] = []
    texts = []
    for cell in jupytext.reads(script, fmt="py:percent").cells:
        if cell.cell_type == "markdown":
            data.append({"text/markdown": cell.source})
            continue
        with capture() as captured:
            done = shell.run_cell(cell.source)
        done.raise_error()
        texts.append(captured.stdout)
        data += [output.data for output in captured.outputs]
        if done.result is not None:
            data.append(shell.display_formatter.format(done.result)[0])
    assert any(one.get("image/png") for one in data), texts
    assert "Traceback" not in "".join(texts)
    markdown = "".join(one.get("text/markdown", "") for one in data)
    assert "$" not in markdown, "exported to HTML, a formula between $ needs a network to be shown"


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
def test_the_jupyter_file_is_the_same_notebook_without_helpers(path: Path) -> None:
    """`python benchmarks/notebooks_rendered.py --ipynb` writes it; a plant may be a function."""
    jupytext = pytest.importorskip("jupytext", reason="the extra `notebooks` is not installed")
    places = (path, path.with_suffix(".ipynb"))
    ours, written = (
        [(cell.cell_type, cell.source) for cell in jupytext.read(place).cells] for place in places
    )
    assert ours == written
    helpers = set(re.findall(r"^(?:def|class) (\w+)", path.read_text(), re.M))
    assert helpers <= {"warmer"}
