"""The pictures of README and for a talk, drawn from the best run of a study.

    ssm-study run experiment=paper
    python benchmarks/readme_pictures.py results/paper

writes `docs/pictures/ten_speeds.gif` (below 1 MB: ten initial speeds under control beside the same
motor without control; the frames follow the recorded samples, ten times slower) and
`docs/pictures/study_line.png` (below 300 kB: the whole study in one picture, from the record over
the model and its certificate to the closed loop).
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.models.identified import SSM
from ssm_study.report.figures.certified_decay import controlled_step_function, relative_distances
from ssm_study.report.study_folder import RecordedCases, StudyFolder

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "pictures"
RECORD_S = 2.0
DECAY = 15  # seconds of the validation record, samples of the certified decay
SHOWN_S = 0.4
SLOWER = 10
PAUSE = 15  # seconds of motion, slow motion, frames at the end


def animation(loop: RecordedCases) -> FuncAnimation:
    """One frame per recorded sample; every line grows to the right, and its last point is
    marked."""
    with (
        style.paper_style(),
        mpl.rc_context({"font.size": 9, "axes.titlesize": 10, "axes.labelsize": 9}),
    ):
        figure = Figure(figsize=(7.2, 2.7), layout="constrained")
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2, sharey=True)
        pairs = [(left, "output", "Under control"), (right, "uncontrolled", "Without control")]
        drawn = [(lines_of(axes, loop, title), loop[name][:, :, 0]) for axes, name, title in pairs]
        left.set_ylabel(loop.label("output"))
    time_s = loop.time_s("output")
    step_s = loop.step_s("output")
    samples = int(SHOWN_S / step_s)

    def update(frame: int) -> list[Artist]:
        last = min(frame + 1, samples)
        for lines, y in drawn:
            for line, response in zip(lines, y, strict=True):
                line.set_data(time_s[:last], response[:last])
        return [line for lines, _ in drawn for line in lines]

    return FuncAnimation(figure, update, frames=samples + PAUSE, interval=1000 * step_s * SLOWER)


def lines_of(axes: Axes, loop: RecordedCases, title: str) -> list[mpl.lines.Line2D]:
    """Empty lines, dark for the lowest start, on axes that show the whole motion from the first
    frame on."""
    rank = loop["output"][:, 0, 0].argsort().argsort()
    colours = [mpl.colormaps[style.SEQUENCE](0.9 * value) for value in rank / len(rank)]
    goal = loop["reference"][0, -1, 0]
    band = loop.settling_band
    assert band is not None
    axes.axhspan(goal - band, goal + band, color=style.PALE, lw=0, zorder=0)
    axes.set(title=title, xlabel="Time (s)", xlim=(0, SHOWN_S), ylim=(-4.2, 4.2))
    return [
        axes.plot([], [], color=colour, lw=1.2, marker="o", markevery=[-1])[0] for colour in colours
    ]


def study_line(study: StudyFolder) -> Figure:
    """Record, model, certificate, closed loop: four panels in this order, each with the one number
    it adds."""
    parts = study.read_from_best(
        "validation",
        "model",
        "certificate",
        "closed_loop",
        "record",
        otherwise="No controlled run.",
    )
    validation, model, certificate, loop, record = parts
    with (
        style.paper_style(),
        mpl.rc_context({"font.size": 9, "axes.titlesize": 10, "axes.labelsize": 9}),
    ):
        figure = Figure(figsize=(7.6, 5.4), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 2).ravel()
        _record(panels[0], validation, record)
        _slopes(panels[1], model, record)
        _decay(panels[2], model, certificate, record)
        title = f"4  Closed loop on the {record['loop_on']}\n"
        lines = lines_of(
            panels[3],
            loop,
            title + f"{record['stable_count']} of {record['initial_conditions']} settle",
        )
        for line, response in zip(lines, loop["output"][:, :, 0], strict=True):
            line.set(data=(loop.time_s("output"), response), marker="")
        for response in loop["uncontrolled"][:, :, 0]:
            panels[3].plot(
                loop.time_s("output"), response, color=style.GREY, lw=0.6, ls=":", zorder=1
            )
        panels[3].plot([], [], color=style.GREY, lw=0.6, ls=":", label="without control")
        panels[3].set_ylabel(loop.label("output"))
        for axes in panels:
            axes.legend(
                loc={panels[0]: "lower right", panels[2]: "lower left"}.get(axes, "upper right"),
                fontsize=8,
                frameon=True,
                framealpha=0.9,
                edgecolor="none",
            )
    return figure


def _record(axes: Axes, validation: RecordedCases, record: dict[str, Any]) -> None:
    """The validation record, which training has not seen, and the model's free run of it."""
    time_s = validation.time_s("measured")
    shown = time_s < RECORD_S
    for name, look in (
        ("measured", {"color": style.INK, "lw": 0.9}),
        ("simulated", {"color": style.VERMILLION}),
    ):
        axes.plot(time_s[shown], validation[name][0, shown, 0], label=name, **look)
    fit = f"fit {record['fit_test_percent']:.1f} % on the test record"
    title = f"1  Validation record and free run\n{fit}"
    axes.set(title=title, xlabel="Time (s)", ylabel=validation.label("measured"))


def _slopes(axes: Axes, model: SSM, record: dict[str, Any]) -> None:
    """The local slope of the input map over the interval that the certificate covers."""
    scaled = np.linspace(-2, 2, 401)
    slope = [model.scaffold_in.jacobian(np.array([v]))[0, 0] for v in scaled]
    lower = record["input_slope_lower"]
    upper = record["input_slope_upper"]
    axes.axhspan(
        lower, upper, color=style.SKY, alpha=0.25, lw=0, label="covered by the certificate"
    )
    axes.step(
        scaled * model.scale.input_scale[0] + model.scale.input_equilibrium[0],
        slope,
        label="learned",
    )
    title = f"2  Model and its slopes\nevery slope of S$_u$ lies in [{lower:.3g}, {upper:.3g}]"
    axes.set(title=title, xlabel="Input (V)", ylabel="Slope of S$_u$ (–)", ylim=(0, 1.4 * upper))


def _decay(axes: Axes, model: SSM, certificate: dict[str, Any], record: dict[str, Any]) -> None:
    """Distances of pairs of trajectories of the model, which the theorem bounds by `r^k`."""
    side = certificate.get("state_feedback_deployed") or certificate["state_feedback"]
    a, b, k, p = (
        np.array({**certificate["state_feedback"], **side}[name]) for name in ("a", "b", "k", "p")
    )
    d = relative_distances(controlled_step_function(model, a, b, k), np.linalg.inv(p))[
        :, :DECAY
    ]  # the dual form: M = P^-1
    samples = np.arange(DECAY)
    axes.plot(
        samples,
        np.sqrt(1 - side["rate"]) ** samples,
        color=style.VERMILLION,
        ls="--",
        label="proved bound",
    )
    axes.fill_between(
        samples, d.min(axis=0), d.max(axis=0), color=style.BLUE, alpha=0.3, lw=0, label="200 pairs"
    )
    axes.plot(samples, d.max(axis=0), color=style.BLUE, label="worst of them")
    title = (
        f"3  Certificate\nrate {side['rate']:.3f} is proved, at most "
        f"{record['controller_rate_limit']:.3f} can be"
    )
    axes.set(title=title, xlabel="Sample", ylabel="Distance / first (–)", yscale="log")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path)
    study = StudyFolder(folder=parser.parse_args().study)
    (loop,) = study.read_from_best("closed_loop", otherwise="No run reached the closed loop.")
    PICTURES.mkdir(exist_ok=True)
    animation(loop).save(PICTURES / "ten_speeds.gif", writer=PillowWriter(fps=10), dpi=100)
    study_line(study).savefig(PICTURES / "study_line.png", dpi=200)
    for name in ("ten_speeds.gif", "study_line.png"):
        print(f"{PICTURES / name}: {(PICTURES / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
