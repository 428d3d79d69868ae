"""A load that is measured and not commanded: it drives model, observer and the exported step, and
cancels in every difference."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from disturbance_cases import STEP_S, motor_log, recorded
from export_cases import compiled
from structured_cases import drawn

import ssm_study as st
from ssm_study.bounds.reduction import Reduction
from ssm_study.cli.main import main
from ssm_study.data.splits import rest_segments
from ssm_study.export.c import render_c_files
from ssm_study.export.device import Device
from ssm_study.export.targets import as_python_control, load_controller
from ssm_study.loop.certified_bound import count_bound_violations
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale, Trajectory
from ssm_study.study.verify import verify
from ssm_study.systems import Gains, StateSpace
from ssm_study.training.structured_fit import StructuredFit

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


def random_model(seed: int, neurons: bool, kind: str = "tanh") -> SSM | StructuredSSM:
    """One input through a bent map, one output, two measured disturbances."""
    rng = np.random.default_rng(seed)
    system = drawn(seed, radius=0.8)
    bent = MonotoneScaffold(breakpoints=np.array([[-0.5, 0.7]]), slopes=np.array([[0.5, 1.0, 0.5]]))
    scale = Scale(
        input_scale=np.array([2.0]),
        output_scale=np.array([0.5]),
        input_equilibrium=np.array([1.0]),
        output_equilibrium=np.array([3.0]),
        disturbance_scale=np.array([0.3, 4.0]),
        disturbance_equilibrium=np.array([20.0, -1.0]),
    )
    shared = {
        "scaffold_in": bent,
        "scaffold_out": LinearScaffold.identity(1),
        "scale": scale,
        "step_s": 0.1,
        "b_d": rng.normal(size=(system.order, 2)),
    }
    if neurons:
        bias = rng.normal(size=system.neurons)
        return StructuredSSM(**vars(system), bias=bias, neurons=(kind, kind), **shared)
    linear = StateSpace(a=system.a, b=system.b, c=system.c, d=system.d)
    return SSM(linear=linear, **shared)


def far_disturbance(model: SSM | StructuredSSM, samples: int, seed: int = 1) -> np.ndarray:
    """Steps of several scales."""
    scale = model.scale
    levels = np.random.default_rng(seed).uniform(-5, 5, (samples // 5, scale.disturbances))
    return scale.disturbance_equilibrium + scale.disturbance_scale * levels.repeat(5, axis=0)


def test_the_fit_with_the_load_beats_the_fit_without_it(run: Path, tmp_path: Path) -> None:
    """Two routes to the same plant: the command with the column, and arrays without it."""
    log = pd.read_csv(motor_log(tmp_path))
    without = st.fit(
        log.voltage, log.speed, STEP_S, *QUICK[3:], model="ssm", order=2, progress=False
    )
    record = json.loads((run / "record.json").read_text())
    assert record["disturbances"] == "torque"
    assert record["fit_test_percent"] > 90.0
    assert record["fit_test_percent"] > without.facts["fit_test_percent"] + 30.0
    assert "torque" in record["evidence_reasons"]


def test_from_arrays_as_from_the_command(run: Path, tmp_path: Path) -> None:
    log = pd.read_csv(motor_log(tmp_path))
    settings = {"model": "ssm", "order": 2, "progress": False}
    words = ["model.hidden_width=4", QUICK[3]]
    model = st.fit(log.voltage, log.speed, STEP_S, *words, disturbance=log.torque, **settings)
    stored = json.loads((run / "model.json").read_text())
    np.testing.assert_array_equal(model.simulator.to_json()["b_d"], stored["b_d"])
    assert model.summary()["measured disturbances"] == "torque"
    fit = model.score(log.voltage, log.speed, log.torque)
    assert fit > 90.0 > 70.0 > model.score(log.voltage, log.speed)
    driven = st.simulate(model, log.voltage, disturbance=log.torque)
    np.testing.assert_array_equal(driven.speed, model.predict(log.voltage, log.torque).speed)
    errors = model.simulation_errors(log.voltage, log.speed, log.torque)
    np.testing.assert_array_equal(errors.speed, log.speed - driven.speed)
    with pytest.raises(BadRequest, match="the input has 900 samples"):
        model.predict(log.voltage, log.torque[:-1])


def test_verify_makes_the_fit_again_with_the_load(run: Path, tmp_path: Path) -> None:
    """It holds as stored, and a model whose load acts otherwise is found out."""
    assert {finding.claim for finding in verify(run) if not finding.holds} == set()
    copy = Path(shutil.copytree(run, tmp_path / run.parent.name / run.name))
    content = json.loads((copy / "model.json").read_text())
    content["b_d"] = (2 * np.array(content["b_d"])).tolist()
    (copy / "model.json").write_text(json.dumps(content))
    wrong = {finding.claim for finding in verify(copy) if not finding.holds}
    assert {"fit_train_percent", "test.mcap /simulated", "validation.mcap /simulated"} <= wrong


@pytest.mark.parametrize("neurons", [False, True])
def test_the_difference_of_two_motions_does_not_know_the_load(neurons: bool) -> None:
    """`x+ = f(x, u) + B_d d`: one load in two motions under one input leaves their difference."""
    model = random_model(0, neurons)
    u = model.scale.physical_input(np.random.default_rng(2).normal(size=(60, 1)))
    x0 = np.random.default_rng(3).normal(size=(2, model.order))
    d = far_disturbance(model, 60)
    if neurons:  # neurons see the state that the load moved: what is left is their slope's share
        model = replace(model, e=0 * model.e)
    moved = [model.simulate(u, start, d) for start in x0]
    still = [model.simulate(u, start) for start in x0]
    difference = moved[0] - moved[1]
    np.testing.assert_allclose(difference, still[0] - still[1], atol=1e-12 * np.abs(moved).max())
    assert np.abs(moved[0] - still[0]).max() > 1.0


def test_the_difference_of_two_loops_does_not_know_the_load() -> None:
    """With linear maps the two loops' difference is the same to rounding, whatever the load."""
    model = replace(random_model(0, neurons=False), scaffold_in=LinearScaffold.identity(1))
    moved = differences_of_loops(model, far_disturbance(model, 80))
    still = differences_of_loops(model, None)
    np.testing.assert_allclose(moved, still, atol=1e-11)
    assert np.abs(still[0]).max() > 0.1


def test_loops_contract_at_the_certified_rate_under_any_load(run: Path) -> None:
    """The bound of the certificate, between two loops in the place of loop and rest."""
    design = st.load(run)
    feedback, observer = design.certificate.parts()
    for seed in range(3):
        load = far_disturbance(design.model, 80, seed)
        apart = differences_of_loops(design.model, load, gains=design.certificate.pair)
        n = design.model.order
        x = apart[None, :, :n]
        x_hat = apart[None, :, n:]
        assert count_bound_violations(x, x_hat, feedback, observer) == 0
    both = (replace(part, rate=0.9999) for part in (feedback, observer))
    assert count_bound_violations(x, x_hat, *both) > 0  # of rates that these gains do not have


def test_loops_with_neurons_contract_under_any_load() -> None:
    model = random_model(0, neurons=True)
    for seed in range(3):
        apart = differences_of_loops(model, far_disturbance(model, 300, seed), samples=300)
        assert np.linalg.norm(apart[-1]) < 1e-4 * np.linalg.norm(apart[0])


def differences_of_loops(
    model: SSM | StructuredSSM, d: np.ndarray | None, samples: int = 80, gains: Gains | None = None
) -> np.ndarray:
    """State and estimate of two loops, one minus the other, sample by sample."""
    rng = np.random.default_rng(4)
    k = -0.1 * rng.normal(size=(1, model.order))
    l_ = -0.1 * rng.normal(size=(model.order, 1))
    neurons = isinstance(model, StructuredSSM)
    gains = gains or Gains(k=k, l=l_, l_z=np.zeros((2, 1)) if neurons else None)
    law = ObserverFeedback(model=model, gains=gains)
    x = rng.normal(size=(2, model.order))
    memory = law.initial_memory(2)
    target = law.targets(np.tile(model.scale.output_equilibrium, (1, 1)))[0]
    rows = []
    for sample in range(samples):
        rows.append(np.concatenate([x[0] - x[1], memory[0] - memory[1]]))
        y = model.read(x, np.zeros((2, 1)))
        u = law.input(memory, y, target)
        load = () if d is None else (d[sample],)
        memory = law.advance(memory, u, y, target, *load)
        x = model.advance(x, model.lift(u)) + (0.0 if d is None else model.push(d[sample]))
    return np.array(rows)


def test_the_observer_is_told_the_load() -> None:
    """From the right state the estimate stays right under any load; untold, it errs."""
    model = random_model(1, neurons=False)
    law = ObserverFeedback(model=model, gains=Gains(k=np.zeros((1, 3)), l=-0.2 * np.ones((3, 1))))
    x = np.ones((1, 3))
    told = np.ones((1, 3))
    untold = np.ones((1, 3))
    target = law.targets(model.scale.output_equilibrium[None])[0]
    for d in far_disturbance(model, 30):
        y = model.read(x, np.zeros((1, 1)))
        u = model.scale.input_equilibrium[None]
        told = law.advance(told, u, y, target, d)
        untold = law.advance(untold, u, y, target)
        x = model.advance(x, model.lift(u)) + model.push(d)
    np.testing.assert_allclose(told, x, atol=1e-12)
    assert np.abs(untold - x).max() > 0.1


def test_a_loop_from_python_lasts_as_long_as_the_load(run: Path) -> None:
    design = st.load(run)
    torque = np.full(40, design.model.scale.disturbance_equilibrium[0])
    at_mean = st.simulate(design, [1.0], disturbance=torque)
    assert len(at_mean) == 40
    alone = st.simulate(design, [1.0], f"loop.horizon_s={40 * STEP_S}")
    np.testing.assert_array_equal(at_mean, alone)
    pushed = st.simulate(design, [1.0], disturbance=torque + 1.0)
    assert np.abs(pushed.iloc[-1, -1] - alone.iloc[-1, -1]) > 0.1  # the law does not compensate it


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
    gains = {"k": -0.1 * np.ones((1, 3)), "l": -0.1 * np.ones((3, 1)), "l_z": np.zeros((2, 1))}
    from ssm_study.export.portable import PortableController, _convert_neurons

    controller = PortableController(
        a=model.a, b=model.b, c=model.c, d=model.d, k=gains["k"], l=gains["l"],
        e=np.zeros((3, 1)), s_in=model.scaffold_in.portable(), s_out=model.scaffold_out.portable(),
        scale=model.scale, step_s=model.step_s, neurons=_convert_neurons(model, gains["l_z"], 0),
        b_d=model.b_d,
    )  # fmt: skip
    device = Device.from_controller(controller, "double", np.array([-9.0]), np.array([9.0]))
    for name, text in render_c_files(device, about="test").items():
        (tmp_path / name).write_text(text)
    assert compiled(tmp_path, "-std=c99", sources=("controller_replay.c", "-lm")).startswith(
        "0 of 200 inputs differ"
    )

    law = ObserverFeedback(model=model, gains=Gains(**gains))
    target = law.targets(model.scale.output_equilibrium[None])[0]
    memory = law.initial_memory(1)
    x = np.zeros(3)
    y = np.array([3.2])
    for d in far_disturbance(model, 20):
        u, x = device.compute_step(x, y, model.scale.output_equilibrium, d)
        memory = law.advance(memory, u[None], y[None], target, d)
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
    expected = controller.b_d[:, 0] / controller.scale.disturbance_scale[0]
    np.testing.assert_allclose(pushed - alone, expected, atol=1e-12)


def test_a_model_without_a_load_is_written_as_before() -> None:
    model = random_model(0, neurons=True)
    bare = Scale(
        input_scale=model.scale.input_scale,
        output_scale=model.scale.output_scale,
        input_equilibrium=model.scale.input_equilibrium,
        output_equilibrium=model.scale.output_equilibrium,
    )
    without = replace(model, scale=bare, b_d=np.zeros((0, 0)))
    assert set(model.to_json()) - set(without.to_json()) == {
        "b_d",
        "disturbance_scale",
        "disturbance_equilibrium",
    }
    for one in (model, without):
        again = model_from_json(json.loads(json.dumps(one.to_json())))
        assert again.to_json() == one.to_json()
    with pytest.raises(BadRequest, match="b_d"):
        replace(model, b_d=np.zeros((0, 0)))


def test_reduction_leaves_a_mode_that_only_the_load_moves() -> None:
    """The mode is unreachable for `(A, B)` alone, and would be dropped."""
    model = random_model(3, neurons=False)
    a = np.diag([0.9, 0.5, 0.3])
    linear = replace(model.linear, a=a, b=np.array([[0.0], [1.0], [1.0]]))
    model = replace(model, linear=linear, scaffold_in=LinearScaffold.identity(1))
    balanced = Reduction().reduce(model)
    u = np.random.default_rng(0).normal(size=(50, 1))
    d = far_disturbance(model, 50)
    assert balanced.order == 3
    np.testing.assert_allclose(balanced.simulate(u, d=d), model.simulate(u, d=d), atol=1e-9)
    assert (
        Reduction().reduce(replace(model, scale=no_load(model.scale), b_d=np.zeros((0, 0)))).order
        == 2
    )


def no_load(scale: Scale) -> Scale:
    """The scale without its disturbances."""
    return replace(scale, disturbance_scale=np.zeros(0), disturbance_equilibrium=np.zeros(0))


def test_a_load_acts_without_the_dead_time() -> None:
    model = replace(random_model(0, neurons=False), scaffold_in=LinearScaffold.identity(1))
    late = model.delayed(4)
    u = model.scale.input_equilibrium + np.random.default_rng(0).normal(size=(60, 1))
    d = far_disturbance(model, 60)
    rest = np.tile(model.scale.input_equilibrium, (4, 1))
    shifted = np.concatenate([rest, u[:-4]])
    np.testing.assert_allclose(late.simulate(u, d=d), model.simulate(shifted, d=d), atol=1e-10)


def test_a_structured_model_is_trained_with_the_load(tmp_path: Path) -> None:
    """Its Jacobian is that of finite differences, and the load reaches no output and no neuron."""
    data = recorded(tmp_path, disturbance="torque").build(0)
    spec = StructuredSpec(
        order=2, neurons=1, knots=3, input_path="free", feedthrough=True, starts=1, draws=1
    )
    fit = StructuredFit(spec, data, 0)
    fit.advance(4)
    theta = fit.theta
    free = fit._moving_blocks
    r, j, turn = fit.problem.linearised(theta, free)
    block = dict(
        zip(free, np.split(j @ turn, np.cumsum([theta[n].size for n in free])[:-1], 1), strict=True)
    )
    for name in ("b", "d", "g"):
        for entry in range(2):
            moved = theta[name].copy()
            moved.ravel()[entry] += 1e-6
            expected = (fit.problem.residual(theta | {name: moved}) - r) / 1e-6
            if name != "b" and entry == 1:
                assert not block[name][:, entry].any()
                assert theta[name].ravel()[entry] == 0.0
            else:
                np.testing.assert_allclose(block[name][:, entry], expected, atol=1e-5)
    model = fit.stored()
    x0 = theta["x0"][0]
    simulated = model.simulate(data.training[0].u, x0, data.training[0].d)
    residual = (simulated - data.training[0].y) / data.scale.output_scale
    weight = fit.problem.records.weight[0]
    np.testing.assert_allclose((weight * residual).ravel(), r, atol=1e-10)
    assert np.abs(model.b_d).max() > 0.0


def test_nothing_rests_while_the_load_moves() -> None:
    u = np.array([1.0] * 20 + [0.0] * 40)[:, None]
    y = np.zeros((60, 1))
    moving = Trajectory(u=u, y=y, step_s=1.0, d=np.arange(60.0)[:, None])
    held = replace(moving, d=np.ones((60, 1)))
    assert len(rest_segments(held)) == 1
    assert rest_segments(moving) == []
    np.testing.assert_array_equal(moving[10:20].d[:, 0], np.arange(10.0, 20.0))


def test_a_log_with_a_hole_and_a_set_point_keeps_its_load(tmp_path: Path) -> None:
    """Each piece has the load of its own samples, and the set point's column is no load."""
    log = pd.read_csv(motor_log(tmp_path))
    log.loc[450, "torque"] = np.nan
    log["wanted"] = np.roll(log.speed, 3)
    log.to_csv(tmp_path / "holes.csv", index=False)
    source = recorded(tmp_path, disturbance="torque", reference="wanted")
    data = replace(source, path=str(tmp_path / "holes.csv")).build(0)
    records = (*data.training, *data.validation, *data.test)
    assert [channel.name for channel in data.disturbances] == ["torque"]
    for record in records:
        first = record.first
        expected = log.torque.to_numpy()[first : first + len(record)]
        np.testing.assert_array_equal(record.d[:, 0], expected)
    assert data.scale.disturbance_equilibrium == pytest.approx(
        np.concatenate([record.d for record in data.training]).mean()
    )
