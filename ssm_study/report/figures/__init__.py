"""Figures of a study, each drawn by the module that bears the figure's name. Each module has
`draw(study) -> Figure` and a docstring that is the caption of the figure.

A new figure is a new file here: `figure_names()` finds it, and every command and test with it.
"""

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from importlib import import_module
from io import BytesIO
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import TYPE_CHECKING

from ssm_study import style
from ssm_study.durable import write_atomically
from ssm_study.extensions import extension_modules
from ssm_study.refusal import require
from ssm_study.report.study_folder import NothingToDraw, StudyFolder

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_names() -> list[str]:
    """Names of all figures that can be drawn of a study."""
    ours = (module.name for module in iter_modules(__path__) if not module.name.startswith("_"))
    return sorted({*extension_modules("figures"), *ours})


def _figure_module(name: str) -> ModuleType:
    """Import the module that draws the figure of a given name."""
    ours = any((Path(place) / f"{name}.py").is_file() for place in __path__)
    return import_module(f"{__name__}.{name}" if ours else extension_modules("figures")[name])


def figure_caption(name: str) -> str:
    """Caption of a figure, taken from the docstring of the file that draws the figure."""
    return " ".join((_figure_module(name).__doc__ or "").split())


def draw_one_figure(name: str, study: StudyFolder, width: style.Width = "page") -> "Figure":
    """Draw a single figure of a study in the style of the paper. Raises `NothingToDraw` with the
    reason where it would be empty."""
    with style.paper_style(width):
        figure: Figure = _figure_module(name).draw(study)
    return figure


@dataclass(frozen=True)
class CaptionedFigure:
    """Matplotlib figure with its caption, in the form that a notebook displays."""

    png: bytes
    caption: str

    def __repr__(self) -> str:
        """Caption of a figure, as a console without pictures displays it."""
        return f"CaptionedFigure({self.caption!r}; save it with .save(FILE))"

    def save(self, path: str | Path) -> Path:
        """Write the figure to a PNG file and return its path."""
        file = Path(path)
        file.write_bytes(self.png)
        return file

    def _repr_mimebundle_(self, **_: object) -> dict[str, object]:
        """Image and caption of a figure, as a notebook displays them."""
        source = f"data:image/png;base64,{base64.b64encode(self.png).decode()}"
        caption = f"<figcaption>{escape(self.caption)}</figcaption>"
        return {
            "text/html": f'<figure><img src="{source}" alt="" width="720">{caption}</figure>',
            "image/png": base64.b64encode(self.png).decode(),
            "text/markdown": f"*{self.caption}*",
        }


def captioned_figure(name: str, study: StudyFolder, width: style.Width = "page") -> CaptionedFigure:
    """Draw a figure of a study for a notebook, with its caption. Raises `NothingToDraw` with the
    reason where it would be empty."""
    content = BytesIO()
    with style.paper_style(width):
        draw_one_figure(name, study, width).savefig(content, format="png")
    return CaptionedFigure(png=content.getvalue(), caption=figure_caption(name))


def draw_figures(
    wanted: Sequence[str] | None,
    study_folder: Path,
    tell: Callable[[str], object] = lambda _: None,
    run: str | None = None,
    width: style.Width = "page",
) -> list[Path]:
    """Draw and save several figures of a study, or all of them.

    Those of a single run show `run`, else the study's best. Pure functions of the gathered table
    and the run folders' files: the same files give the same bytes. A figure of what the study does
    not have is not drawn, and `tell` hears why. Raises `BadRequest` for a figure nobody wrote.
    `captions.md` beside them has the caption of each.
    """
    study = StudyFolder(folder=study_folder, shown=run)
    paths = []
    for name in wanted or ():
        require(
            name in figure_names(),
            "only",
            name,
            "there is no such figure",
            f"choose among {', '.join(figure_names())}",
        )
    for name in wanted or figure_names():
        with style.paper_style(width):  # what is saved asks for the settings once more
            try:
                figure = draw_one_figure(name, study, width)
                paths += style.save_figure(figure, study.folder / "figures", name)
            except NothingToDraw as reason:
                tell(f"not drawn: {name}. {reason}")
    if paths:
        there = {path.stem for path in (study.folder / "figures").glob("*.png")} & set(
            figure_names()
        )
        remarks = "".join(
            f"![{name}]({name}.png)\n\n**{name}.** {figure_caption(name)}\n\n"
            for name in sorted(there)
        )
        captions = study.folder / "figures" / "captions.md"
        write_atomically(captions, remarks.encode(), durable=False)
    return paths
