"""The short run that tests share has the recorded numbers: the whole way from simulated records to
the loop on the plant."""

import json
from pathlib import Path
from typing import Any

from recorded import assert_as_recorded

from ssm_study.models.stored import model_from_json
from ssm_study.report.page.data import page_data
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder, StudyFolder

OF_ITS_PLACE = ("version_", "machine", "stage_", "git_", "ended_utc", "started_utc", "sha256")
ALSO = ("run", "host", "pid", "threads", "attempt")
# What the proof of coverage finds is one of many solutions.
OF_A_PROGRAM = {"coverage_by_band"}
# Of a solver's last digits: what is left of an inequality that holds.
LAST_DIGITS = ("controller_margin", "observer_margin", "controllability_gramian_lower")


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_the_record_has_the_recorded_numbers(smoke_run: Path) -> None:
    record = read_json(smoke_run / "record.json")
    left_out = (*ALSO, *LAST_DIGITS)
    results = {}
    for name, value in record.items():
        if not name.startswith(OF_ITS_PLACE) and name not in left_out:
            results[name] = value
    assert_as_recorded("run_record", results, 1e-3)


def test_model_and_certificate_are_the_recorded_ones(smoke_run: Path) -> None:
    model = model_from_json(read_json(smoke_run / "model.json"))
    curve = read_json(smoke_run / "training_curve.json")
    folder = RunFolder(path=smoke_run)
    sides = [folder.design.state_feedback, folder.design.observer]
    assert_as_recorded("run_model", [model, curve, *sides], 1e-3)


def test_its_pictures_are_the_recorded_ones(smoke_run: Path) -> None:
    folder = RunFolder(path=smoke_run)
    pictures: dict[str, Any] = {}
    for name in PICTURES.keys() - OF_A_PROGRAM:
        try:
            pictures[name] = picture_of_run(name, folder)
        except NothingToDraw as reason:
            pictures[name] = str(reason)
    assert_as_recorded("run_pictures", pictures, 1e-3)


def test_its_page_has_the_recorded_data(smoke_study: Path) -> None:
    data = page_data(StudyFolder(folder=smoke_study))
    kept = ("trajectories", "slider", "first")
    shown = {name: data[name] for name in kept}
    assert_as_recorded("run_page", shown, 1e-3)
