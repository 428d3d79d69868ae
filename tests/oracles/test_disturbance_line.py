"""A measured load from log to device: fit, verification, loops from Python, exported code."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from disturbance_cases import STEP_S, differences_of_loops, far_disturbance, motor_log, random_model
from export_cases import compiled

import ssm_study as st
from ssm_study.cli.main import main
from ssm_study.export.c import render_c_files
from ssm_study.export.device import DeviceController
from ssm_study.export.targets import as_python_control, load_controller
from ssm_study.loop.certified_bound import count_bound_violations
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.refusal import BadRequest
from ssm_study.study.verify import verify
from ssm_study.systems import Gains

pytestmark = pytest.mark.usefixtures("made_once", "without_baselines")

LOG = ["data=recorded", "data.input=voltage", "data.output=speed", f"data.step_s={STEP_S}"]


QUICK = ["model=ssm", "model.order=2", "model.hidden_width=4", "training.max_epochs=8"]


WEIGHTS = ["synthesis=riccati", "synthesis.rate_controller=0.4", "synthesis.rate_observer=0.5"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command on that log, the torque named as a disturbance."""
    folder = tmp_path_factory.mktemp("motor")
    place = [f"results_dir={folder}", "study=load", "progress=false"]
    words = [*LOG, f"data.path={motor_log(folder)}", "data.disturbance=torque", *QUICK, *WEIGHTS]
    assert main(["run", *words, *place]) == 0
    (record,) = (folder / "load").glob("*/record.json")
    return record.parent


def test_the_fit_with_the_load_beats_the_fit_without_it(run: Path, tmp_path: Path) -> None:
    """Two routes to the same plant: the command with the column, and arrays without it."""
    log = pd.read_csv(motor_log(tmp_path))
    without = st.fit(
        log.voltage, log.speed, STEP_S, *QUICK[3:], model="ssm", order=2, progress=False
    )
    text = (run / "record.json").read_text()
    record = json.loads(text)
    assert record["disturbances"] == "torque"
    assert record["fit_test_percent"] > 90.0
    lower_limit = without.result_columns["fit_test_percent"] + 30.0
    assert record["fit_test_percent"] > lower_limit
    assert "torque" in record["evidence_reasons"]


def test_from_arrays_as_from_the_command(run: Path, tmp_path: Path) -> None:
    log = pd.read_csv(motor_log(tmp_path))
    settings = {"model": "ssm", "order": 2, "progress": False}
    words = ["model.hidden_width=4", QUICK[3]]
    model = st.fit(log.voltage, log.speed, STEP_S, *words, disturbance=log.torque, **settings)
    text = (run / "model.json").read_text()
    stored = json.loads(text)
    actual = model.simulator.to_json()["b_d"]
    np.testing.assert_array_equal(actual, stored["b_d"])
    assert model.summary()["measured disturbances"] == "torque"
    fit = model.score(log.voltage, log.speed, log.torque)
    assert fit > 90.0 > 70.0 > model.score(log.voltage, log.speed)
    driven = st.simulate(model, log.voltage, disturbance=log.torque)
    expected = model.predict(log.voltage, log.torque).speed
    np.testing.assert_array_equal(driven.speed, expected)
    errors = model.simulation_errors(log.voltage, log.speed, log.torque, start_up_samples=0)
    expected = log.speed - driven.speed
    np.testing.assert_array_equal(errors.speed, expected)
    with pytest.raises(BadRequest, match="the input has 900 samples"):
        model.predict(log.voltage, log.torque[:-1])


def test_verify_makes_the_fit_again_with_the_load(run: Path, tmp_path: Path) -> None:
    """It holds as stored, and a model whose load acts otherwise is found out."""
    claims = {finding.claim for finding in verify(run) if not finding.holds}
    assert claims == set()
    name = run.parent.name
    copy = Path(shutil.copytree(run, tmp_path / name / run.name))
    text = (copy / "model.json").read_text()
    content = json.loads(text)
    content["b_d"] = (2 * np.array(content["b_d"])).tolist()
    text = json.dumps(content)
    (copy / "model.json").write_text(text)
    wrong = {finding.claim for finding in verify(copy) if not finding.holds}
    assert {"fit_train_percent", "test.mcap /simulated", "validation.mcap /simulated"} <= wrong


def test_loops_contract_at_the_certified_rate_under_any_load(run: Path) -> None:
    """The bound of the certificate, between two loops in the place of loop and rest."""
    design = st.load(run)
    feedback, observer = design.certificate.controller_and_observer()
    for seed in range(3):
        load = far_disturbance(design.model, 80, seed)
        gains = design.certificate.gain_pair
        apart = differences_of_loops(design.model, load, gains=gains)
        n = design.model.order
        x = apart[None, :, :n]
        x_hat = apart[None, :, n:]
        assert count_bound_violations(x, x_hat, feedback, observer) == 0
    parts = (feedback, observer)
    both = (replace(part, rate=0.9999) for part in parts)
    assert count_bound_violations(x, x_hat, *both) > 0  # of rates that these gains do not have


def test_a_loop_from_python_lasts_as_long_as_the_load(run: Path) -> None:
    design = st.load(run)
    disturbance_equilibrium = design.model.scale.disturbance_equilibrium
    torque = np.full(40, disturbance_equilibrium[0])
    at_mean = st.simulate(design, [1.0], disturbance=torque)
    assert len(at_mean) == 40
    alone = st.simulate(design, [1.0], f"loop.horizon_s={40 * STEP_S}")
    np.testing.assert_array_equal(at_mean, alone)
    pushed = st.simulate(design, [1.0], disturbance=torque + 1.0)
    difference = np.abs(pushed.iloc[-1, -1] - alone.iloc[-1, -1])
    assert difference > 0.1  # the law does not compensate it


@pytest.mark.parametrize("real", ["double", "float"])
def test_c_with_a_load_is_the_law_to_the_last_digit(run: Path, tmp_path: Path, real: str) -> None:
    assert main(["export", str(run), "--to", str(tmp_path), "--real", real]) == 0
    header = (tmp_path / "controller.h").read_text()
    assert (
        f"controller_step(controller_state *state, const {real} y[1], {real} u[1], "
        f"const {real} d[1])" in header
    )
    assert "disturbance 0: torque" in header
    assert compiled(tmp_path, "-std=c99").startswith("0 of 200 inputs differ")


def test_c_with_neurons_and_two_loads(tmp_path: Path) -> None:
    """And the law in NumPy is the loop's own; the python-control script too."""
    model = random_model(2, neurons=True, kind="relu")
    k = -0.1 * np.ones((1, 3))
    l_z = np.zeros((2, 1))
    gains = {"k": k, "l": -0.1 * np.ones((3, 1)), "l_z": l_z}
    from ssm_study.export.portable import PortableController, _convert_neurons

    e = np.zeros((3, 1))
    s_in = model.scaffold_in.as_portable()
    s_out = model.scaffold_out.as_portable()
    neurons = _convert_neurons(model, gains["l_z"], 0)
    controller = PortableController(
        a=model.a, b=model.b, c=model.c, d=model.d, k=gains["k"], l=gains["l"],
        e=e, s_in=s_in, s_out=s_out,
        scale=model.scale, step_s=model.step_s, neurons=neurons,
        b_d=model.b_d,
    )  # fmt: skip
    device = DeviceController.from_controller(
        controller, "double", np.array([-9.0]), np.array([9.0])
    )
    for name, text in render_c_files(device, origin_text="test").items():
        (tmp_path / name).write_text(text)
    sources = ("controller_replay.c", "-lm")
    assert compiled(tmp_path, "-std=c99", sources=sources).startswith("0 of 200 inputs differ")

    observer_feedback_gains = Gains(**gains)
    law = ObserverFeedback(model=model, gains=observer_feedback_gains)
    reference = model.scale.output_equilibrium[None]
    plan = law.target_trajectory(reference)
    target = plan[0]
    memory = law.initial_memory(1)
    x = np.zeros(3)
    y = np.array([3.2])
    for d in far_disturbance(model, 20):
        r = model.scale.output_equilibrium
        u, x = device.compute_step(x, y, r, d)
        memory = law.next_memory(memory, u[None], y[None], target, d)
        np.testing.assert_allclose(x, memory[0], atol=1e-9)


def test_the_script_takes_the_load_behind_the_output(run: Path) -> None:
    system = as_python_control(run)
    assert system.input_labels == ["y[0]", "d[0]"]
    controller = load_controller(run)
    x = np.array([0.3] * len(controller.a))
    rest = controller.scale.output_equilibrium
    mean = controller.scale.disturbance_equilibrium
    pushed = system.updfcn(0, x, np.concatenate([rest, mean + 1.0]), {})
    alone = system.updfcn(0, x, np.concatenate([rest, mean]), {})
    disturbance_scale = controller.scale.disturbance_scale
    expected = controller.b_d[:, 0] / disturbance_scale[0]
    np.testing.assert_allclose(pushed - alone, expected, atol=1e-12)
