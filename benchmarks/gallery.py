"""The gallery of figures, drawn from studies: docs/gallery.md and its pictures.

    ssm-study run experiment=paper
    ssm-study run -m experiment=smoke study=rates synthesis=riccati \
        synthesis.rate_controller=0.03,0.1,0.2,0.3,0.9 seed=0,1
    python benchmarks/gallery.py results/paper results/rates

Each figure comes from the first of the studies that has what it shows; half a minute. Below each
stand its caption and the lines that draw it. `tests/laws/test_gallery.py` keeps the page complete.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ssm_study import style
from ssm_study.report import figures
from ssm_study.report.study_folder import NothingToDraw, StudyFolder

DOCS = Path(__file__).resolve().parents[1] / "docs"
PICTURES = DOCS / "pictures" / "gallery"
DPI = 110
# What draws the same from Python; `model` and `design` are what st.fit and st.control return.
PYTHON = {
    "free_run": "model.plot()",
    "frequency_response": "model.bode()",
    "residual_correlation": "model.residuals()",
    "input_map": "model.input_map()",
    "loop_poles": "design.poles()",
    "margin_by_frequency": "design.margin_plot()",
    "coverage_by_band": "design.coverage_plot()",
    "nyquist": "design.nyquist()",
    "set_point_step": "design.step()",
    "closed_loop_responses": "design.plot()",
}
# Drawn from tables that take long to make.
REFERENCE = {
    "peers": "../results/reference/loop/peers.png",
    "robustness": "../results/reference/loop/robustness.png",
}
GROUPS = {
    "The model": (
        "free_run",
        "frequency_response",
        "residual_correlation",
        "input_map",
        "learned_dead_zone",
        "validation_trajectory",
        "hankel_spectrum",
        "training_curves",
        "excitation",
    ),
    "The design and what it is predicted to do": (
        "margin_by_frequency",
        "coverage_by_band",
        "nyquist",
        "loop_poles",
        "set_point_step",
        "certified_decay",
    ),
    "The closed loop": ("closed_loop_responses", "peers", "robustness"),
    "A sweep": ("feasibility_map",),
}
OPENING = """# Gallery

*For everyone who looks for a picture: every figure, its caption, and the line that draws it.*

`ssm-study report STUDY` draws all figures below for the study's best run, each as PNG and PDF; with
`--only` and a name it draws one. The page of a study shows the figures of its best runs. From
Python, `model = st.fit(...)` and `design = st.control(model)` draw the same, and every picture is a
Matplotlib figure ([Python](howto_python.md)). Several models on one record:
`ssm-study overlay RUN RUN`, `st.compare([a, b], u, y).plot()`. A log before anything is fitted:
`ssm-study look FILE`.
"""


def draw_gallery(studies: Sequence[Path]) -> str:
    """Draw every figure into the folder of pictures; returns the text of the page."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    parts = [OPENING]
    for title, names in GROUPS.items():
        parts.append(f"## {title}\n")
        parts += [_entry(name, studies) for name in names]
    return "\n".join(parts)


def _entry(name: str, studies: Sequence[Path]) -> str:
    """One figure with its caption and the lines that draw it."""
    lines = [f"ssm-study report STUDY --only {name}"]
    picture = REFERENCE.get(name) or _drawn(name, studies)
    python = PYTHON.get(name)
    drawn_by = f"`{lines[0]}`" + (f" or `{python}`" if python else "")
    caption = figures.figure_caption(name)
    return f"### {name}\n\n![{name}]({picture})\n\n{caption}\n\n{drawn_by}\n"


def _drawn(name: str, studies: Sequence[Path]) -> str:
    """Draw a figure from the first study that has what it shows; returns its place."""
    reasons = []
    for folder in studies:
        try:
            figure = figures.draw_one_figure(name, StudyFolder(folder=folder))
        except NothingToDraw as reason:
            reasons.append(f"{folder}: {reason}")
            continue
        with style.paper_style():
            figure.savefig(PICTURES / f"{name}.png", dpi=DPI, metadata={"Software": None})
        return f"pictures/gallery/{name}.png"
    raise SystemExit(f"{name} is drawn by none of these studies. {'; '.join(reasons)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("studies", nargs="+", type=Path, metavar="STUDY")
    options = parser.parse_args()
    (DOCS / "gallery.md").write_text(draw_gallery(options.studies), encoding="utf-8")
