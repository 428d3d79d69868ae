"""Every figure draws on the smoke study, on runs of every kind, on an empty study and on one with
failures only."""

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import report_tables
import structured_cases
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from report_runs import random_run, write_recordings

from ssm_study import style
from ssm_study.cli import summary as endings
from ssm_study.data.mcap import SignalGroup
from ssm_study.refusal import BadRequest
from ssm_study.report import figures
from ssm_study.report.figures import learned_dead_zone, robustness, validation_trajectory
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder, StudyFolder
from ssm_study.signals import Channel
from ssm_study.study.recordings import RecordedCases
from ssm_study.table.rank import sort_best_first

STUDIES = {
    "runs": report_tables.table(40),
    "empty": report_tables.empty(),
    "failures": report_tables.failures(),
}


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("studies")
    folders = {
        name: report_tables.write_study(root / name, table) for name, table in STUDIES.items()
    }
    best = sort_best_first(STUDIES["runs"]).iloc[0]["run"]
    folder = folders["runs"] / best
    random_run(folder, kind="mlp", channels=1, seed=1)
    write_recordings(folders["runs"] / best)
    return folders


@pytest.fixture(scope="session")
def smoke_copy(smoke_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished smoke study, its run and its table as they are, in a folder of one's own to draw
    into."""
    smoke_path = tmp_path_factory.mktemp("figures") / "smoke"
    return Path(shutil.copytree(smoke_study, smoke_path))


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    savefig = style._PAPER["savefig"]
    monkeypatch.setitem(savefig, "dpi", 40)  # rendering pixels is most of the time


# A certificate of the coverage, and a model whose input acts after its sample: of the smoke run.
OF_A_REAL_RUN = {"coverage_by_band", "set_point_step"}


@pytest.mark.parametrize("name", figures.figure_names())
def test_a_figure_is_saved_twice_has_a_paper_width_and_a_unit_on_every_axis(
    studies: dict[str, Path], smoke_copy: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawn once, saved as PNG and as PDF, with its caption beside them."""
    saved: list[Figure] = []
    save_figure = style.save_figure

    def keep_and_save(figure: Figure, folder: Path, name: str) -> list[Path]:
        saved.append(figure)
        return save_figure(figure, folder, name)

    monkeypatch.setattr(style, "save_figure", keep_and_save)
    study = smoke_copy if name in OF_A_REAL_RUN else studies["runs"]
    png, pdf = figures.draw_figures([name], study)
    assert png.read_bytes().startswith(b"\x89PNG")
    assert pdf.read_bytes().startswith(b"%PDF")
    entry = f"![{name}]({name}.png)\n\n**{name}.** {figures.figure_caption(name)}"
    assert entry in png.with_name("captions.md").read_text()
    (figure,) = saved
    assert figure.get_size_inches()[0] in (style.COLUMN_IN, style.PAGE_IN)
    for axes in figure.axes:
        assert axes.axison, "the study has what this figure needs, yet it says there is nothing"
        for label in labels_to_read(axes, figure):
            is_unitless = label in UNITLESS or (label == "" and name == "peers")
            assert "(" in label or is_unitless, f"{label!r} has no unit"


def labels_to_read(axes: Axes, figure: Figure) -> list[str]:
    """Labels that a panel must have: of panels over one x axis, only the lowest names it."""
    place = axes.get_subplotspec()
    if place is None:  # a colour bar, which has one axis
        return [axes.get_ylabel()]
    shares_axis = axes.get_shared_x_axes().joined(axes, figure.axes[-1])
    if place.is_last_row() or not shares_axis:
        return [axes.get_ylabel(), axes.get_xlabel()]
    return [axes.get_ylabel()]


def test_the_faster_a_controller_settles_the_darker_is_its_cell(studies: dict[str, Path]) -> None:
    study_folder = StudyFolder(folder=studies["runs"])
    figure = robustness.draw(study_folder)
    (image,) = figure.axes[0].images
    shares_of_open_loop = np.array([[0.25, 0.5, 0.9]])
    colours = image.to_rgba(shares_of_open_loop)
    brightness = colours[0, :, :3].sum(axis=1)
    assert (np.diff(brightness) > 0).all()


@pytest.mark.parametrize("kind", ["empty", "failures"])
def test_nothing_is_drawn_of_what_a_study_has_not_and_each_reason_is_a_sentence(
    studies: dict[str, Path], kind: str
) -> None:
    told: list[str] = []
    assert figures.draw_figures(None, studies[kind], told.append) == []
    assert [sentence.split(" ")[2].strip(".") for sentence in told] == figures.figure_names()
    assert all(sentence.endswith(".") for sentence in told)
    figures_path = studies[kind] / "figures"
    assert not (figures_path).exists()


NEEDS_SEVERAL = {"robustness", "peers", "feasibility_map"}  # runs or controllers


def test_of_a_single_run_every_figure_is_drawn_but_those_that_compare_runs(
    smoke_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawn alone: each is rendered in a test above."""
    (smoke_copy / "figures").mkdir(exist_ok=True)
    monkeypatch.setattr(style, "save_figure", lambda _, folder, name: [folder / f"{name}.png"])
    paths = figures.draw_figures(None, smoke_copy)
    drawn = {path.stem for path in paths}
    expected = set(figures.figure_names()) - NEEDS_SEVERAL
    assert drawn == expected


def test_the_pictures_of_a_run_say_the_numbers_of_its_record(smoke_copy: Path) -> None:
    """Margin and coverage are computed again from the recordings, and are those of the record."""
    paths = smoke_copy.glob("*/record.json")
    (run,) = [path.parent for path in paths]
    text = (run / "record.json").read_text()
    record = json.loads(text)
    folder = RunFolder(path=run)
    margin = picture_of_run("margin_by_frequency", folder)
    assert f"{record['resolved_margin']:.3g}" in margin.title
    coverage = picture_of_run("coverage_by_band", folder)
    assert f"{np.floor(100 * record['coverage']) / 100:.2f}" in coverage.title
    name, _, place = record["coverage_reference"].partition(", ")
    assert coverage.title.endswith(f" V, {place}")
    in_scales = float(name.removeprefix("input of rms "))
    volts = float(coverage.title.partition("input of rms ")[2].partition(" V")[0])
    scale = float(folder.any_model.scale.input_scale[0])
    assert volts == pytest.approx(in_scales * scale, rel=0.06), "both are printed in two digits"
    title = picture_of_run("free_run", folder).title
    assert f"{record['fit_test_percent']:.1f} %" in title


def test_a_picture_of_what_a_run_did_not_leave_is_a_sentence(tmp_path: Path) -> None:
    run = RunFolder(path=tmp_path)
    for name in PICTURES:
        with pytest.raises(NothingToDraw, match=r"^The run left no [a-z ]+\.$"):
            picture_of_run(name, run)


def test_one_situation_is_no_robustness(
    monkeypatch: pytest.MonkeyPatch, studies: dict[str, Path]
) -> None:
    """The peers are compared in the nominal one alone: what would be drawn is a wall of one
    colour."""
    study_folder = StudyFolder(folder=studies["runs"])
    whole = study_folder.controller_comparison
    nominal = whole[whole["situation"] == "nominal"]
    assert len(nominal) < len(whole)
    monkeypatch.setattr(StudyFolder, "controller_comparison", nominal)
    told: list[str] = []
    assert figures.draw_figures(["robustness"], studies["runs"], told.append) == []
    assert "several situations" in told[0]


def test_the_figure_of_the_fit_shows_the_test_record_first_and_validation_below(
    smoke_copy: Path,
) -> None:
    panels = drawn("validation_trajectory", smoke_copy).axes
    records = [panels[0], panels[2]]  # the error of the test record stands between them
    labels = [panel.lines[0].get_label() for panel in records]
    assert labels == ["test record", "validation record"]
    assert len(panels) == 4


def test_the_figures_after_a_run_are_its_own_and_not_the_bests(
    studies: dict[str, Path], monkeypatch
) -> None:
    """Until another run's stand in their place: then the run is told again, and drawn again."""
    folder = studies["runs"]
    names = ("closed_loop_responses",)
    runs = STUDIES["runs"]
    best = sort_best_first(runs).iloc[0]["run"]
    record = (
        runs[(runs["status"] == "ok") & (runs["run"] != best)]
        .astype(object)
        .iloc[0]
        .dropna()
        .to_dict()
    )
    random_run(folder / record["run"], kind="mlp", channels=1, seed=2)
    run = folder / record["run"]
    write_recordings(run, seed=1)
    others = figures.draw_figures(names, folder)[0].read_bytes()
    monkeypatch.setattr("ssm_study.table.gather.gather", lambda *_, **__: runs)
    kinds = ("png", "pdf")
    pictures = [folder / "figures" / f"{names[0]}.{kind}" for kind in kinds]
    told = folder / "told.json"
    assert str(pictures[0].relative_to(folder)) in endings._outcome_text(
        folder, record, names, pictures, 80
    )
    told.write_text("[1]")
    own = pictures[0].read_bytes()
    expected = figures.draw_figures(names, folder, run=record["run"])[0].read_bytes()
    assert own == expected
    assert own != others
    later = time.time_ns() + 10**9
    os.utime(told, ns=(later, later))
    assert endings._read_cached_list(told, folder, pictures) == [1]
    os.utime(pictures[1], ns=(later + 1, later + 1))
    assert endings._read_cached_list(told, folder, pictures) == []


@pytest.mark.parametrize("name", ["feasibility_map", "closed_loop_responses"])
def test_the_same_files_give_the_same_bytes(studies: dict[str, Path], name: str) -> None:
    paths = figures.draw_figures([name], studies["runs"])
    first = [path.read_bytes() for path in paths]
    paths = figures.draw_figures([name], studies["runs"])
    expected = [path.read_bytes() for path in paths]
    assert first == expected


@pytest.mark.parametrize("name", sorted(OF_A_REAL_RUN))
def test_what_needs_a_loop_or_a_proof_is_not_drawn_of_runs_without(
    studies: dict[str, Path], name: str
) -> None:
    """The made-up runs have no plant to move and no covered proof."""
    with pytest.raises(NothingToDraw):
        drawn(name, studies["runs"])


def test_a_rate_without_certificate_is_no_bound(studies: dict[str, Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(studies["runs"], tmp_path / "runs"))
    path = folder / sort_best_first(STUDIES["runs"]).iloc[0]["run"] / "certificate.json"
    text = path.read_text()
    content = json.loads(text)
    content["state_feedback"]["certified"] = False
    text = json.dumps(content)
    path.write_text(text)
    said = [axes.lines[0].get_label() for axes in drawn("certified_decay", folder).axes]
    assert said == ["not certified, r = 0.894", "bound, r = 0.894"]


def test_of_a_model_with_neurons_it_is_not_said_that_there_is_none(
    studies: dict[str, Path], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(studies["runs"], tmp_path / "runs"))
    path = folder / sort_best_first(STUDIES["runs"]).iloc[0]["run"] / "model.json"
    text = json.dumps(structured_cases.model().to_json())
    path.write_text(text)
    told: list[str] = []
    assert (
        figures.draw_figures(
            ["certified_decay", "hankel_spectrum", "learned_dead_zone"], folder, told.append
        )
        == []
    )
    assert all(sentence.endswith("model without neurons.") for sentence in told)


UNITLESS = {"Sample", "Epoch", "Balanced state", "Controller", "Situation"}


def test_every_figure_has_a_caption() -> None:
    for name in figures.figure_names():
        assert figures.figure_caption(name).endswith("."), name


def test_an_unknown_figure_is_refused_with_the_choices(studies: dict[str, Path]) -> None:
    with pytest.raises(
        BadRequest, match=r"only = pie_chart: there is no such figure; choose among .*peers"
    ):
        figures.draw_figures(["pie_chart"], studies["runs"])


def test_a_folder_that_is_no_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match=r"it has no runs\.parquet; run `ssm-study gather`"):
        figures.draw_figures(None, tmp_path)


def drawn(name: str, folder: Path) -> Figure:
    study_folder = StudyFolder(folder=folder)
    return figures.draw_one_figure(name, study_folder)


def test_the_settling_band_is_that_of_the_loop_and_not_of_the_plant_that_was_configured(
    tmp_path: Path,
) -> None:
    """Beside recorded data the loop runs on the identified model, whose band is another than the
    group's default."""
    run = RunFolder(path=write_recordings(tmp_path))
    (tmp_path / ".hydra").mkdir()
    config_path = tmp_path / ".hydra" / "config.yaml"
    config_path.write_text("plant: {settling_band: 9.0}")
    assert run.closed_loop is not None
    assert run.closed_loop.settling_band == 0.5
    assert 0.1 < run.closed_loop.time_after_settling_s < 0.5


def test_a_recording_has_no_true_dead_zone() -> None:
    """The plant's group has a default beside recorded data too; its curve is nobody's truth
    there."""
    names = ("SimulatedData", "Rehearsal")
    simulated, recorded = (
        {"data": {"_target_": f"x.{name}"}, "plant": {"dead_zone_v": 0.4}} for name in names
    )
    expected = (0.4, 0.0)
    assert learned_dead_zone.known_dead_zone(simulated) == expected
    expected = (None, 0.0)
    assert learned_dead_zone.known_dead_zone(recorded) == expected


@pytest.mark.parametrize(("unit", "label"), [("m/s", "Wheel speed (m/s)"), ("", "Wheel speed")])
def test_a_unit_that_nobody_stated_is_not_printed(unit: str, label: str) -> None:
    channel = Channel(name="wheel_speed", unit=unit)
    times = np.array([0.0, 0.1])
    values = np.zeros((2, 1))
    signal = SignalGroup(topic="/measured", time_s=times, channels=(channel,), values=values)
    cases = {"": {"measured": signal}}
    recording = RecordedCases(path=Path("test.mcap"), cases=cases, about={})
    assert recording.labels("measured") == [label]
    figure = Figure()
    axes = figure.subplots()
    recording.cases[""]["simulated"] = signal
    validation_trajectory.draw_error(axes, recording)
    assert axes.get_ylabel() == label.replace("Wheel speed", "Error")


LONGEST_SENTENCE = 30  # words


@pytest.mark.parametrize("name", figures.figure_names())
def test_a_caption_says_one_thing_a_sentence(name: str) -> None:
    """certified_decay had one sentence of five clauses."""
    text = figures.figure_caption(name)
    for sentence in text.removesuffix(".").split(". "):
        words = sentence.split()
        assert len(words) <= LONGEST_SENTENCE, sentence
        assert sentence.count(",") + sentence.count(";") <= 3, sentence
        assert sentence[:1].isupper(), sentence


def test_a_console_without_pictures_prints_the_caption(tmp_path: Path) -> None:
    figure = figures.CaptionedFigure(png=b"bytes of a picture", caption="Poles of the model.")
    assert repr(figure) == "CaptionedFigure('Poles of the model.'; save it with .save(FILE))"
    path = figure.save(str(tmp_path / "poles.png"))
    assert path.read_bytes() == figure.png
