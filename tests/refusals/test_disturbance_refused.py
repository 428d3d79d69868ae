"""Columns that are no measured disturbance, and models that have no path for one."""

from pathlib import Path

import pandas as pd
import pytest
from disturbance_cases import STEP_S, motor_log, recorded

import ssm_study as st
from ssm_study.refusal import BadRequest

INPUT_TOO = {"disturbance": "voltage"}
OUTPUT_TOO = {"disturbance": ["speed"]}
CLOCK_TOO = {"disturbance": "torque", "time": "torque"}
TWICE = {"disturbance": ["torque", "torque"]}
SET_POINT_TOO = {"disturbance": "torque", "reference": "torque"}
UNKNOWN = {"disturbance": "load"}
NO_DISTURBANCES = [
    (INPUT_TOO, "is an input too"),
    (OUTPUT_TOO, "is an output too"),
    (CLOCK_TOO, "is the clock too"),
    (TWICE, "the same column twice"),
    (SET_POINT_TOO, "is the set point too"),
    (UNKNOWN, "load"),
]


@pytest.mark.parametrize(("fields", "sentence"), NO_DISTURBANCES)
def test_a_column_that_is_no_disturbance_is_refused(
    tmp_path: Path, fields: dict[str, object], sentence: str
) -> None:
    with pytest.raises(BadRequest, match=sentence):
        recorded(tmp_path, **fields).build(0)


MODELS = ["arx", "narx", "output_error", "gru"]


@pytest.mark.parametrize("model", MODELS)
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
