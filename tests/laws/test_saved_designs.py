"""Designs that are saved and read again say what they said before, wherever they lie."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import ssm_study as st
from ssm_study.api.scratch import program_scratch_folder
from ssm_study.api.summaries import summarise_prediction
from ssm_study.certificates.certificate import certificate_digest
from ssm_study.refusal import BadRequest

QUICK = ("model.hidden_width=4", "training.max_epochs=3")


def fit_random_levels() -> st.Model:
    """A model trained briefly on arrays."""
    rng = np.random.default_rng(0)
    levels = rng.uniform(-3, 3, 60)
    u = np.repeat(levels, 8)
    y = lfilter([0, 0.2], [1, -0.9], np.tanh(u))
    kind = {"model": "ssm", "order": 2, "slopes": (0.5, 1.0)}
    return st.fit(u, y, 0.1, *QUICK, progress=False, **kind)


def test_a_saved_design_takes_the_log_of_its_arrays_along(tmp_path: Path) -> None:
    """The file that the program deletes at its end is needed no more: `verify` reads the copy."""
    model = fit_random_levels()
    design = st.control(model, method="riccati", rate=0.3, observer_rate=0.5)
    saved = design.save(tmp_path / "saved")
    (copied,) = (saved / "logs").iterdir()
    settings_file = saved / ".hydra" / "config.yaml"
    settings = settings_file.read_text()
    assert str(copied) in settings
    assert str(program_scratch_folder()) not in settings
    loaded = st.load(saved)
    assert repr(loaded) == repr(design), "evidence and prediction are not lost"
    record_file = saved / "record.json"
    written_record = record_file.read_text()
    improved_record = written_record.replace(
        '"predicted_stable":', '"predicted_stable":true,"was":'
    )
    assert improved_record != written_record
    record_file.write_text(improved_record)
    with pytest.raises(BadRequest, match=r"record\.json is not as it was written"):
        st.load(saved)
    record_file.write_text(written_record)
    certificate_file = saved / "certificate.json"
    content = json.loads(certificate_file.read_text())
    for part in content.values():
        if "k" in part:
            larger_gain = -4 * np.array(part["k"])
            part["k"] = larger_gain.tolist()
            part["digest"] = certificate_digest(part)
    certificate_file.write_text(json.dumps(content))
    with pytest.raises(BadRequest, match="in exact arithmetic the inequality fails"):
        st.load(saved)


def test_a_saved_model_takes_the_log_of_its_arrays_along_and_may_be_moved(tmp_path: Path) -> None:
    """A design of the loaded model was not saved: its log had been deleted with the program."""
    model = fit_random_levels()
    saved = model.save(tmp_path / "saved")
    moved = saved.rename(tmp_path / "moved")
    loaded = st.load(moved)
    (log,) = (moved / "logs").iterdir()
    overrides = " ".join(loaded.overrides)
    assert str(log) in overrides
    assert str(program_scratch_folder()) not in overrides


def test_coverage_of_an_error_that_the_records_do_not_show_is_withheld() -> None:
    facts = {"predicted_stable": None, "evidence": "cannot judge", "coverage": 2740.0}
    line = summarise_prediction(facts)["covered by the proof"]
    assert line == "withheld: the records do not show the model error"
