"""The gallery shows every figure with its caption and a line that draws it."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from ssm_study.api.design import Design
from ssm_study.api.model import Model
from ssm_study.report import figures
from ssm_study.report.run_pictures import PICTURES

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "gallery.md").read_text()
ENTRIES = dict(re.findall(r"^### (\w+)\n\n!\[\w+\]\((.+)\)$", PAGE, re.M))
PICTURE_METHODS = {
    "model": ("plot", "bode", "residuals", "poles", "input_map"),
    "design": ("plot", "step", "margin_plot", "coverage_plot", "nyquist", "poles"),
}


@pytest.fixture
def gallery(monkeypatch: pytest.MonkeyPatch):
    benchmarks_path = str(ROOT / "benchmarks")
    monkeypatch.setattr(sys, "path", [benchmarks_path, *sys.path])
    return importlib.import_module("gallery")


def test_every_figure_is_in_the_gallery_once() -> None:
    paths = Path(figures.__path__[0]).glob("[!_]*.py")
    ours = {path.stem for path in paths}
    assert set(ENTRIES) == ours
    assert set(PICTURES) <= ours


@pytest.mark.parametrize("name", ENTRIES)
def test_its_picture_lies_there_and_its_caption_is_todays(name: str) -> None:
    picture = (ROOT / "docs" / ENTRIES[name]).resolve()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert figures.figure_caption(name) in PAGE
    assert f"`ssm-study report STUDY --only {name}`" in PAGE


def test_every_python_line_is_a_method_that_exists(gallery) -> None:
    lines = dict(re.findall(r"--only (\w+)` or `([\w.()]+)`", PAGE))
    assert lines == gallery.PYTHON
    classes = {"model": Model, "design": Design}
    for line in lines.values():
        subject, method = line.removesuffix("()").split(".")
        assert callable(getattr(classes[subject], method))
    signals = lines.values()
    shown = {line.removesuffix("()") for line in signals}
    picture_methods = PICTURE_METHODS.items()
    missing = {
        f"{subject}.{name}"
        for subject, names in picture_methods
        for name in names
        if f"{subject}.{name}" not in shown
    }
    assert missing == {"model.poles"}, "design.poles() shows those of the model, too"
