"""The excitation that a run keeps is the one its model was trained on."""

import json
import shutil
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from ssm_study.data.metrics import persistency_order
from ssm_study.report import figures
from ssm_study.report.study_folder import RunFolder, StudyFolder


def test_the_training_inputs_are_kept_and_drawn(smoke_run: Path) -> None:
    text = (smoke_run / "record.json").read_text()
    record = json.loads(text)
    kept = RunFolder(path=smoke_run).excitation
    validation = RunFolder(path=smoke_run).validation
    assert kept is not None
    assert validation is not None
    inputs = kept["input"]
    expected = (3, 400, 1)
    assert inputs.shape == expected  # experiment=smoke: data.trajectories x data.samples
    smallest = min(persistency_order(u) for u in inputs)
    assert smallest == record["excitation_order"]
    assert not any(np.array_equal(u, validation["input"][0]) for u in inputs)


def test_the_figure_says_what_the_inputs_can_identify(smoke_run: Path, tmp_path: Path) -> None:
    study = shutil.copytree(smoke_run.parent, tmp_path / "smoke")
    content = json.loads((smoke_run / "record.json").read_text())
    record = content | {"input_coverage": 0.85, "excitation_order": 8}

    def drawn(**more: str) -> list[Axes]:
        record_path = study / smoke_run.name / "record.json"
        text = json.dumps(record | more)
        record_path.write_text(text)
        study_folder = StudyFolder(folder=study)
        return figures.draw_one_figure("excitation", study_folder).axes

    told = drawn()
    warned = drawn(excitation_warning="2 levels only")
    title = told[0].get_title(loc="left")
    assert title == "Training records; 85 % of the range is trained on"
    title = told[1].get_title(loc="left")
    assert title == "Persistently exciting of order 8"
    title = warned[0].get_title(loc="left")
    assert "not identifiable" in title
