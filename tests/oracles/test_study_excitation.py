"""The excitation that a run keeps is the one its model was trained on."""

import json
from pathlib import Path

import numpy as np

from ssm_study.data.coverage import persistency_order
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
