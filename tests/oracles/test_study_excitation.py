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
    record = json.loads((smoke_run / "record.json").read_text())
    kept = RunFolder(path=smoke_run).excitation
    validation = RunFolder(path=smoke_run).validation
    assert kept is not None
    assert validation is not None
    inputs = kept["input"]
    assert inputs.shape == (3, 400, 1)  # experiment=smoke: data.trajectories x data.samples
    assert min(persistency_order(u) for u in inputs) == record["excitation_order"]
    assert not any(np.array_equal(u, validation["input"][0]) for u in inputs)


def test_the_figure_says_what_the_inputs_can_identify(smoke_run: Path, tmp_path: Path) -> None:
    study = shutil.copytree(smoke_run.parent, tmp_path / "smoke")
    record = json.loads((smoke_run / "record.json").read_text()) | {
        "input_coverage": 0.85,
        "excitation_order": 8,
    }

    def drawn(**more: str) -> list[Axes]:
        (study / smoke_run.name / "record.json").write_text(json.dumps(record | more))
        return figures.drawn("excitation", StudyFolder(folder=study)).axes

    told = drawn()
    warned = drawn(excitation_warning="2 levels only")
    assert told[0].get_title(loc="left") == "Training records; 85 % of the range is trained on"
    assert told[1].get_title(loc="left") == "Persistently exciting of order 8"
    assert "not identifiable" in warned[0].get_title(loc="left")
