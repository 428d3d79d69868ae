"""One file per figure, named as printed. Each has `draw(study) -> Figure` and a docstring that is its caption.

A new figure is a new file here: `names()` finds it, and every command and test with it.
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

from ssm_study.refusal import require
from ssm_study.report import style
from ssm_study.report.study_folder import Study


def names() -> list[str]:
    """Every figure that can be asked for."""
    return sorted(module.name for module in iter_modules(__path__) if not module.name.startswith("_"))


def caption(name: str) -> str:
    """What the figure shows, in a sentence or two: the docstring of its file."""
    return " ".join((_module(name).__doc__ or "").split())


def draw(wanted: Sequence[str] | None, study_folder: Path) -> list[Path]:
    """Draw the named figures (None: all) of a study into `study_folder/figures`, each as PNG and PDF.

    Pure functions of the gathered table and the run folders' files: the same files give the same bytes. Raises
    `BadRequest` for a figure nobody wrote.
    """
    for name in wanted or ():
        require(name in names(), "only", name, "there is no such figure", f"choose among {', '.join(names())}")
    study = Study(folder=study_folder)
    return [path for name in wanted or names() for path in _drawn(name, study)]


def _drawn(name: str, study: Study) -> list[Path]:
    with style.paper():
        return style.save(_module(name).draw(study), study.folder / "figures", name)


def _module(name: str) -> ModuleType:
    return import_module(f"{__name__}.{name}")
