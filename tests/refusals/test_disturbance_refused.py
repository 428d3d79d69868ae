"""Columns that are no measured disturbance, and models that have no path for one."""

from pathlib import Path

import pandas as pd
import pytest
from disturbance_cases import STEP_S, motor_log, recorded

import ssm_study as st
from ssm_study.refusal import BadRequest


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"disturbance": "voltage"}, "is an input too"),
        ({"disturbance": ["speed"]}, "is an output too"),
        ({"disturbance": "torque", "time": "torque"}, "is the clock too"),
        ({"disturbance": ["torque", "torque"]}, "the same column twice"),
        ({"disturbance": "torque", "reference": "torque"}, "is the set point too"),
        ({"disturbance": "load"}, "load"),
    ],
)
def test_a_column_that_is_no_disturbance_is_refused(
    tmp_path: Path, fields: dict[str, object], sentence: str
) -> None:
    with pytest.raises(BadRequest, match=sentence):
        recorded(tmp_path, **fields).build(0)


@pytest.mark.parametrize("model", ["arx", "narx", "output_error", "gru"])
def test_a_model_without_a_path_for_it_is_refused(tmp_path: Path, model: str) -> None:
    log = pd.read_csv(motor_log(tmp_path))
    with pytest.raises(BadRequest, match="has no path for measured disturbances"):
        st.fit(log.voltage, log.speed, STEP_S, disturbance=log.torque, model=model, progress=False)


def test_a_load_that_the_model_does_not_know_is_refused(tmp_path: Path) -> None:
    log = pd.read_csv(motor_log(tmp_path))
    words = ["model.hidden_width=2", "training.max_epochs=1"]
    model = st.fit(log.voltage, log.speed, STEP_S, *words, model="ssm", order=1, progress=False)
    with pytest.raises(BadRequest, match="fitted without measured disturbances"):
        model.predict(log.voltage, log.torque)
