"""The way from a log to a device, as its page tells it: every file and command of the page, and
what comes of them."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
from docs_numbers import assert_outcome_holds, outcome_on_page, printed_outcome

from benchmarks.log_to_device import told
from ssm_study.report.run_facts import RunFacts

SETTLED = 100  # samples after a new set point


def test_the_page_holds(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    said = told(tmp_path)
    device_path = tmp_path / "results" / "device"
    (path,) = device_path.glob("*/record.json")
    text = path.read_text()
    record = json.loads(text)
    assert record["evidence"] == "sound"
    assert record["predicted_stable"] is True
    assert record["controller_certified"] is True
    on_page = outcome_on_page("log_to_device.md", "MODEL")
    assert_outcome_holds(on_page, printed_outcome(record, RunFacts.from_run_folder(path.parent)))
    assert record["coverage"] > record["coverage_needed"] > 1
    assert said["replay"].startswith("0 of 200 inputs differ, the largest by 0")
    trial = pd.read_csv(tmp_path / "first_trial.csv")
    largest = trial["volts"].abs().max()
    assert largest < 3  # what the log visited, and so what the drive can do
    difference = trial["speed"] - trial["set_point"]
    error = difference.groupby(trial.index // 300)
    assert (error.apply(lambda one: one.iloc[SETTLED:].mean()).abs() < 0.1).all()
    assert (error.apply(lambda one: one.iloc[SETTLED:].std()) < 0.2).all()
    assert (
        "the loop comes to rest, so it shows nothing that makes it swing;" in capfd.readouterr().out
    )
