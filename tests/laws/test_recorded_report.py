"""Page, pictures, figures and printed outcome of made-up studies are those that were recorded."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_tables
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from recorded import assert_as_recorded
from report_runs import random_run, write_recordings
from rich.console import Console

from ssm_study.engine.records import read_record
from ssm_study.report import figures
from ssm_study.report.answers import question_answers
from ssm_study.report.page.charts import (
    EXPLORER,
    group_chart_specification,
    scatter_plot_contents,
    scatter_plot_specification,
    unplotted_answers,
)
from ssm_study.report.page.data import page_data, page_texts, sort_for_page
from ssm_study.report.page.templates import chart_templates
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.run_record import print_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder, StudyFolder
from ssm_study.table.rank import sort_best_first

TABLE = report_tables.table(40)
BEST = sort_best_first(TABLE).iloc[0]["run"]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyFolder:
    root = tmp_path_factory.mktemp("recorded")
    folder = report_tables.write_study(root / "sweep", TABLE)
    random_run(folder / BEST, kind="mlp", channels=1, seed=1)
    write_recordings(folder / BEST)
    return StudyFolder(folder=folder)


def test_the_page_has_the_recorded_data_and_texts(study: StudyFolder) -> None:
    table = sort_for_page(study.table)
    answered = question_answers(table)
    unplotted = unplotted_answers(table, answered)
    page = {
        "data": page_data(study),
        "texts": page_texts(study, table, unplotted),
        "panels": scatter_plot_contents(table, answered),
        "explorer": scatter_plot_specification(EXPLORER, table),
        "groups": group_chart_specification(),
        "templates": chart_templates(table),
    }
    of_every_table = ("known_columns", "folder")
    for name in of_every_table:
        page["data"].pop(name)
    assert_as_recorded("page", page)


def test_the_pictures_of_a_run_have_the_recorded_curves(study: StudyFolder) -> None:
    run = RunFolder(path=study.folder / BEST)
    pictures: dict[str, Any] = {}
    for name in PICTURES:
        try:
            pictures[name] = picture_of_run(name, run)
        except NothingToDraw as reason:
            pictures[name] = str(reason)
    assert_as_recorded("pictures", pictures)


def figure_content(figure: Figure) -> list[dict[str, Any]]:
    """Curves, areas, limits and words of every panel of a figure."""
    panels = []
    for axes in figure.axes:
        lines = [line_content(line) for line in axes.lines]
        shapes = [np.round(shape.get_extents().bounds, 6) for shape in axes.patches]
        faces = [to_hex(shape.get_facecolor()) for shape in axes.patches]
        clouds = [np.asarray(cloud.get_offsets()) for cloud in axes.collections]
        images = [np.asarray(image.get_array()) for image in axes.images]
        words = [text.get_text() for text in axes.texts]
        legend = axes.get_legend()
        entries = [text.get_text() for text in legend.get_texts()] if legend else []
        labels = [axes.get_xlabel(), axes.get_ylabel(), axes.get_title()]
        limits = [*axes.get_xlim(), *axes.get_ylim()]
        scales = [axes.get_xscale(), axes.get_yscale()]
        content = {"lines": lines, "shapes": shapes, "faces": faces, "clouds": clouds}
        content |= {"images": images, "words": words, "legend": entries, "labels": labels}
        panels.append(content | {"limits": limits, "scales": scales})
    return panels


def line_content(line: Any) -> dict[str, Any]:
    """Points and looks of a curve."""
    x = np.asarray(line.get_xdata(), dtype=float)
    y = np.asarray(line.get_ydata(), dtype=float)
    looks = [to_hex(line.get_color()), line.get_linestyle(), line.get_marker()]
    return {"x": x, "y": y, "looks": looks, "width": line.get_linewidth()}


def test_the_figures_of_a_study_have_the_recorded_curves(study: StudyFolder) -> None:
    content: dict[str, Any] = {}
    for name in figures.figure_names():
        try:
            figure = figures.draw_one_figure(name, study)
            content[name] = figure_content(figure)
        except NothingToDraw as reason:
            content[name] = str(reason)
    assert_as_recorded("figures", content)


@pytest.mark.parametrize("status", ["ok", "infeasible", "failed"])
def test_a_run_is_printed_as_recorded(study: StudyFolder, status: str) -> None:
    run = TABLE.loc[TABLE["status"] == status, "run"].iloc[0]
    folder: Path = study.folder / run
    assert read_record(folder)
    printed = io.StringIO()
    print_run(folder, Console(width=100, file=printed))
    lines = printed.getvalue().splitlines()
    assert_as_recorded(f"printed_{status}", lines)
