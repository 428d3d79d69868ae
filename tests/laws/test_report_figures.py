"""Every figure draws on the smoke study, on runs of every kind, on an empty study and on one with failures only."""

import shutil
from pathlib import Path

import pytest
import report_tables
from matplotlib.figure import Figure
from report_runs import random_run, write_recordings

from ssm_study.refusal import BadRequest
from ssm_study.report import figures, style
from ssm_study.report.figures import learned_dead_zone
from ssm_study.report.study_folder import Study
from ssm_study.report.verdict import best_first

STUDIES = {"runs": report_tables.table(40), "empty": report_tables.empty(), "failures": report_tables.failures()}


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("studies")
    folders = {name: report_tables.write_study(root / name, table) for name, table in STUDIES.items()}
    best = best_first(STUDIES["runs"]).iloc[0]["run"]
    random_run(folders["runs"] / best, kind="mlp", channels=1, seed=1)
    write_recordings(folders["runs"] / best)
    return folders


@pytest.fixture(scope="session")
def smoke_copy(smoke_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished smoke study, its run and its table as they are, in a folder of one's own to draw into."""
    return Path(shutil.copytree(smoke_study, tmp_path_factory.mktemp("figures") / "smoke"))


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(style._PAPER, "savefig.dpi", 40)  # rendering pixels is most of the time


@pytest.mark.parametrize("kind", STUDIES)
@pytest.mark.parametrize("name", figures.names())
def test_every_figure_draws_png_and_pdf(studies: dict[str, Path], name: str, kind: str) -> None:
    png, pdf = figures.draw([name], studies[kind])
    assert png.read_bytes().startswith(b"\x89PNG")
    assert pdf.read_bytes().startswith(b"%PDF")


NEEDS_A_COMPARISON = {"robustness"}  # which experiment=smoke does not make


@pytest.mark.parametrize("name", figures.names())
def test_every_figure_draws_what_the_smoke_study_found(smoke_copy: Path, name: str) -> None:
    png, pdf = figures.draw([name], smoke_copy)
    assert png.read_bytes().startswith(b"\x89PNG")
    assert pdf.read_bytes().startswith(b"%PDF")
    drawn_something = any(axes.axison for axes in drawn(name, smoke_copy).axes)
    assert drawn_something == (name not in NEEDS_A_COMPARISON), "the study holds what this figure needs"


@pytest.mark.parametrize("name", ["rates", "closed_loop_responses"])
def test_the_same_files_give_the_same_bytes(studies: dict[str, Path], name: str) -> None:
    first = [path.read_bytes() for path in figures.draw([name], studies["runs"])]
    assert first == [path.read_bytes() for path in figures.draw([name], studies["runs"])]


@pytest.mark.parametrize("name", figures.names())
def test_a_full_figure_has_a_paper_width_and_a_unit_on_every_axis(studies: dict[str, Path], name: str) -> None:
    figure = drawn(name, studies["runs"])
    assert figure.get_size_inches()[0] in (style.COLUMN_IN, style.PAGE_IN)
    for axes in figure.axes:
        assert axes.axison, "the study has what this figure needs, yet it says there is nothing to draw"
        place = axes.get_subplotspec()  # None: a colour bar, which has one axis
        lowest = place and (place.is_last_row() or not axes.get_shared_x_axes().joined(axes, figure.axes[-1]))
        for label in [axes.get_ylabel()] + ([axes.get_xlabel()] if lowest else []):
            assert "(" in label or label in UNITLESS or (label == "" and name == "peers"), f"{label!r} has no unit"


UNITLESS = {"Sample", "Epoch", "Balanced state", "Controller", "Situation"}


def test_every_figure_has_a_caption() -> None:
    for name in figures.names():
        assert figures.caption(name).endswith("."), name


def test_an_unknown_figure_is_refused_with_the_choices(studies: dict[str, Path]) -> None:
    with pytest.raises(BadRequest, match=r"only = pie_chart: there is no such figure; choose among .*rates"):
        figures.draw(["pie_chart"], studies["runs"])


def test_a_folder_that_is_no_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match=r"it has no runs\.parquet; run `ssm-study gather`"):
        figures.draw(None, tmp_path)


def test_figures_of_failures_say_why_they_are_empty(studies: dict[str, Path]) -> None:
    (axes,) = drawn("rates", studies["failures"]).axes
    assert "4 runs: 4 failed" in axes.texts[0].get_text()


def drawn(name: str, folder: Path) -> Figure:
    with style.paper():
        return figures._module(name).draw(Study(folder=folder))


def test_a_recording_has_no_true_dead_zone() -> None:
    """The plant's group has a default beside recorded data too; its curve is nobody's truth there."""
    plant = {"dead_zone_v": 0.4}
    simulated, recorded = (
        {"data": {"_target_": f"x.{name}"}, "plant": plant} for name in ("SimulatedData", "Rehearsal")
    )
    assert learned_dead_zone._known_plant(simulated) == plant
    assert learned_dead_zone._known_plant(recorded) == {}
