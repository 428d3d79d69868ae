"""The excitation that a run keeps is the one its model was trained on."""

import json
from pathlib import Path

import numpy as np

from ssm_study.data.coverage import persistency_order
from ssm_study.report.figures.excitation import figure
from ssm_study.report.study_folder import RunFolder


def test_the_training_inputs_are_kept_and_drawn(smoke_run: Path) -> None:
    record = json.loads((smoke_run / "record.json").read_text())
    kept = RunFolder(path=smoke_run).excitation
    assert kept is not None
    assert kept.records == "training records"
    assert [len(u) for u in kept.u] == [400, 400, 400]  # experiment=smoke: data.trajectories x data.samples
    assert min(persistency_order(u[:, None]) for u in kept.u) == record["excitation_order"]
    validation = RunFolder(path=smoke_run).validation
    assert validation is not None
    assert not any(np.array_equal(u, validation.u[:, 0]) for u in kept.u)


def test_the_figure_says_what_the_inputs_can_identify(smoke_run: Path) -> None:
    kept = RunFolder(path=smoke_run).excitation
    assert kept is not None
    facts = {"input_coverage": 0.85, "excitation_order": 8}
    told, warned = (figure(kept, facts | more).axes for more in ({}, {"excitation_warning": "2 levels only"}))
    assert told[0].get_title() == "Training records; 85 % of the range is trained on"
    assert told[1].get_title() == "Persistently exciting of order 8"
    assert "not identifiable" in warned[0].get_title()
