"""Every export target computes what the Python loop computes, for every scaffolding, in one and
several channels."""

import json
import runpy
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_cases import compiled, products, written
from report_runs import KINDS, random_run, write_recordings
from structured_cases import model as structured

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.export.device import DeviceController
from ssm_study.export.targets import (
    find_input_limits,
    load_controller,
    prove_deployed_rates,
    render_c_sources,
    write_controller,
)
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.trajectory import scaled_equilibrium
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured import NEURONS, StructuredSSM
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis

SAMPLES = 300
Replay = Callable[[Path, np.ndarray], np.ndarray]

MAIN_C = """#include <stdio.h>
#include "controller.h"
int main(void) {
    controller_state state;
    double y[%d], u[%d];
    controller_reset(&state);
    for (;;) {
        for (int i = 0; i < %d; ++i) if (scanf("%%lf", &y[i]) != 1) return 0;
        controller_step(&state, y, u);
        for (int i = 0; i < %d; ++i) printf("%%.17g ", u[i]);
    }
}
"""

MAIN_LIMITED_C = MAIN_C.replace(
    "controller_step(&state, y, u);",
    """controller_input(&state, u);
        for (int i = 0; i < (int)(sizeof u / sizeof *u); ++i) u[i] = u[i] > 3 ? 3 : u[i] < -3 ? -3 :
        u[i];
        controller_advance(&state, y, u);""",
)


def python_loop(run: Path, y: np.ndarray, limit: float = np.inf) -> np.ndarray:
    text = (run / "model.json").read_text()
    content = json.loads(text)
    model = model_from_json(content)
    design = Design.load(run / "certificate.json")
    law = ObserverFeedback(model=model, gains=design.gain_pair)
    memory = law.initial_memory(1)
    m = model.scale.inputs
    output_equilibrium = model.scale.output_equilibrium
    target = np.concatenate([np.zeros(model.order + m), output_equilibrium])
    u = np.empty((len(y), m))
    for k, seen in enumerate(y):
        inputs = law.input(memory, seen[None], target)
        u[k] = np.clip(inputs[0], -limit, limit)
        memory = law.next_memory(memory, u[k][None], seen[None], target)
    return u


def c_replay(folder: Path, y: np.ndarray, main: str = MAIN_C) -> np.ndarray:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    numbers = json.loads((folder / "controller.json").read_text())
    m = len(numbers["input_scale"])
    p = len(numbers["output_scale"])
    (folder / "main.c").write_text(main % (p, m, p, m))
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2"]
    subprocess.run(["gcc", *strict, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    text = " ".join(repr(float(v)) for v in y.ravel())
    done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=float).reshape(len(y), m)


def onnx_replay(folder: Path, y: np.ndarray) -> np.ndarray:
    runtime = pytest.importorskip(
        "onnxruntime", reason="the extra `write_controller` is not installed"
    )
    session = runtime.InferenceSession(
        folder / "controller.onnx", providers=["CPUExecutionProvider"]
    )
    inputs = session.get_inputs()
    state = np.zeros((1, inputs[1].shape[1]))
    u = []
    for seen in y:
        given, state = session.run(["u", "next_state"], {"y": seen[None], "state": state})
        u.append(given[0])
    return np.array(u)


def control_replay(folder: Path, y: np.ndarray) -> np.ndarray:
    control = pytest.importorskip("control", reason="the extra `write_controller` is not installed")
    controller_path = str(folder / "controller.py")
    path = runpy.run_path(controller_path)
    system = path["controller"]
    outputs = control.input_output_response(
        system, np.arange(len(y)) * system.dt, y.T, squeeze=False
    ).outputs
    return outputs.T


# Tolerances.
REPLAYS: dict[Replay, float] = {c_replay: 1e-9, onnx_replay: 1e-6, control_replay: 1e-9}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("channels", "integral"), [(1, False), (2, False), (1, True), (2, True)])
def test_export_replays_the_python_loop(
    tmp_path: Path, kind: str, channels: int, integral: bool
) -> None:
    run = random_run(
        tmp_path / "run", kind=kind, channels=channels, seed=channels, integral=integral
    )
    write_controller(run, tmp_path / "out")
    rng = np.random.default_rng(7)
    white_noise = rng.standard_normal((SAMPLES, channels))
    y = 3 + 5 * white_noise
    expected = python_loop(run, y)
    assert np.ptp(expected) > 0.01  # a controller that does nothing would agree with anything
    for replay, tolerance in REPLAYS.items():
        replayed = replay(tmp_path / "out", y)
        largest = float(np.abs(expected).max())
        size = max(1.0, largest)
        difference = np.abs(replayed - expected)
        largest_difference = difference.max()
        assert largest_difference <= tolerance * size, replay.__name__


def test_integrators_in_c_rest_while_a_limit_holds_the_input(tmp_path: Path) -> None:
    integral = ["step", "sine(5Hz)"]
    run = random_run(tmp_path / "run", kind="mlp", channels=1, seed=3, integral=integral)
    write_controller(run, tmp_path / "out")
    sine = np.sin(2 * np.pi * np.arange(SAMPLES) / 60)
    y = 40 * np.sign(sine)[:, None]
    limited = python_loop(run, y, limit=3.0)
    difference = np.abs(limited - python_loop(run, y).clip(-3, 3))
    largest_difference = difference.max()
    assert largest_difference > 0.1, "without the hold it would do otherwise"
    difference = np.abs(c_replay(tmp_path / "out", y, MAIN_LIMITED_C) - limited)
    largest_difference = difference.max()
    assert largest_difference <= 1e-9


def test_the_certificate_lies_beside_it_byte_for_byte(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="mlp", channels=1, seed=0)
    paths = write_controller(run, tmp_path / "out")
    names = {path.name for path in paths}
    assert {"controller.h", "controller.json", "controller.py", "certificate.json"} <= names
    certificate_path = tmp_path / "out" / "certificate.json"
    assert (certificate_path).read_bytes() == (run / "certificate.json").read_bytes()
    # Its numbers prove nothing.
    controller_path = tmp_path / "out" / "controller.h"
    text = controller_path.read_text()
    assert "NOT certified" in text


def structured_run(
    folder: Path, kinds: tuple[str, ...], seen: float, integral: bool = False
) -> Path:
    """A certified pair of a model with these neurons, which the output sees directly where `seen`
    is not zero."""
    candidate = structured(kinds, seed=2)
    h = np.full((1, len(kinds)), seen)
    made = replace(candidate, h=h)
    rate_controller = 0.05 if integral else 0.5
    asked = RiccatiSynthesis(rate_controller=rate_controller, rate_observer=0.5, input_weight=0.1)
    internal_model = ["step"] if integral else []
    changed_asked = replace(asked, internal_model=internal_model)
    design = changed_asked.design(made, certified_balls(made))
    assert design.certified
    folder.mkdir(parents=True)
    text = json.dumps(made.to_json())
    (folder / "model.json").write_text(text)
    design.save(folder / "certificate.json")
    return folder


def test_with_neurons_the_header_says_what_is_proved_and_how_set_points_are_found(
    tmp_path: Path,
) -> None:
    run = write_recordings(structured_run(tmp_path / "run", ("tanh",), 0.0))
    header = render_c_sources(run, prefix="drive")["drive.h"]
    assert "Within the limits nothing is proved: the theorems on them know no neurons." in header
    assert "Set points lie on lines between stored rest points: missed by at most" in header
    assert "drive_track(&state, y, r, u);" in header


def test_the_device_aims_where_the_model_rests(tmp_path: Path) -> None:
    """Rest points of the model by Newton's method, and the device's own curve; then the loop on the
    model itself."""
    kinds = ("tanh", "softplus")
    run = structured_run(tmp_path / "run", kinds, 0.05)
    text = (run / "model.json").read_text()
    content = json.loads(text)
    model = model_from_json(content)
    ends = (-2.0, 2.0)
    device = DeviceController.from_controller(
        load_controller(run),
        "double",
        *(model.scale.physical_input(np.array([end])) for end in ends),
    )
    assert device.set_point_maps is not None
    missed = device.set_point_maps.missed
    assert 1e-6 < missed < 1e-2
    lifted = model.scaffold_in(np.array([[-1.0], [0.7]]))
    for r in model.output_at(np.stack([rested(model, v) for v in lifted]), lifted):
        x, u = scaled_equilibrium(model, r)
        aimed = device.nearest_equilibrium(r)
        assert model.scale.scaled_output(r) == pytest.approx(aimed["w"], abs=1e-9)
        difference = np.abs(aimed["x"] - x)
        largest_difference = difference.max()
        assert largest_difference < 20 * missed
        assert aimed["v"] == pytest.approx(u, abs=20 * missed)
        output_equilibrium = model.scale.output_equilibrium
        state = device.equilibrium_state(output_equilibrium)
        truth = np.zeros(model.order)
        assert not state.any()
        for _ in range(200):
            y = (
                model.output_at(truth, lift(model, applied))
                if _
                else model.scale.output_equilibrium
            )
            applied, state = device.compute_step(state, y, r)
            truth = model.next_state(truth, lift(model, applied))
        difference = np.abs(model.scale.scaled_output(y) - model.scale.scaled_output(r))
        largest_difference = difference.max()
        assert largest_difference < 20 * missed


def lift(model: StructuredSSM, u: np.ndarray) -> np.ndarray:
    return model.map_input(u[None])[0]


def rested(model: StructuredSSM, v: np.ndarray) -> np.ndarray:
    x = np.zeros(model.order)
    for _ in range(500):
        x = model.next_state(x, v)
    return x


def test_an_output_that_two_rest_points_share_has_no_set_points(tmp_path: Path) -> None:
    """A relu that turns the falling output back at large inputs."""
    made = load_controller(structured_run(tmp_path / "run", ("relu",), 0.0))
    assert made.neurons is not None
    f = np.zeros((1, 3))
    g = np.ones((1, 1))
    h = np.full((1, 1), 100.0)
    bias = np.array([-0.1])
    turned = {"f": f, "g": g, "h": h, "bias": bias}
    phi_bias = np.zeros(1)
    neurons = replace(made.neurons, **turned, phi_bias=phi_bias)
    folded = replace(made, neurons=neurons)
    ends = [made.scale.physical_input(np.array([end])) for end in (-0.5, 0.5)]
    device = DeviceController.from_controller(folded, "double", *ends)
    assert device.set_point_maps is None
    assert device.no_set_points_reason.startswith("two equilibria of the model have one output")
    device = DeviceController.from_controller(made, "double", *ends)
    assert device.set_point_maps is not None
    assert device.no_set_points_reason == ""
    two_inputs = replace(device, lower=np.zeros(2), upper=np.ones(2))
    assert two_inputs.no_set_points_reason.startswith("neurons stand between several inputs")


@pytest.mark.parametrize(("read_by_neuron", "holds"), [(0.0, True), (0.5, False)])
def test_an_integrator_holds_every_output_where_no_neuron_reads_it(
    tmp_path: Path, read_by_neuron: float, holds: bool
) -> None:
    run = structured_run(tmp_path / "run", ("tanh",), 0.0)
    made = load_controller(run)
    a = made.a.copy()
    a[:, -1] = (0.0, 0.0, 1.0)
    assert made.neurons is not None
    f = made.neurons.f.copy()
    f[:, -1] = read_by_neuron
    neurons = replace(made.neurons, f=f)
    integrating = replace(made, a=a, neurons=neurons)
    limit = np.full(1, 0.5)
    device = DeviceController.from_controller(integrating, "double", -limit, limit)
    points = device.set_point_maps
    is_held = points is not None and points.inward is None
    assert is_held == holds
    if points is not None and holds:
        shown = made.c[0, -1]
        at_rest = np.array([0.0, 0.0, 1.0]) / shown
        states = points.at_rest[:, 0]
        np.testing.assert_allclose(states, at_rest)


def test_the_limits_of_a_one_sided_log_leave_room_to_rest(tmp_path: Path) -> None:
    run = write_recordings(random_run(tmp_path / "run", kind="linear", channels=1, seed=0))
    text = (run / "model.json").read_text()
    stored = json.loads(text)
    for rest in (-7.5, 9.0):
        text = json.dumps(stored | {"input_equilibrium": [rest]})
        (run / "model.json").write_text(text)
        lower, upper = (float(end[0]) for end in find_input_limits(run))
        assert rest in (lower, upper)
        assert lower < -4 < 4 < upper


@pytest.mark.parametrize(
    ("kinds", "integral"),
    [*(((kind,), kind == "tanh") for kind in NEURONS), (tuple(NEURONS), False)],
)
def test_neurons_are_exported(tmp_path: Path, kinds: tuple[str, ...], integral: bool) -> None:
    """Far from rest, so that every neuron bends; a controller without them would not agree."""
    seen = 0.02 * (len(kinds) > 1)
    run = structured_run(tmp_path / "run", kinds, seen, integral)
    write_controller(run, tmp_path / "out")
    rng = np.random.default_rng(7)
    white_noise = rng.standard_normal((SAMPLES, 1))
    y = 1 + 20 * white_noise
    expected = python_loop(run, y)
    assert np.ptp(expected) > 0.01
    text = (run / "model.json").read_text()
    bare = json.loads(text)
    e = (0 * np.array(bare["e"])).tolist()
    text = json.dumps(bare | {"e": e})
    (run / "model.json").write_text(text)
    difference = np.abs(python_loop(run, y) - expected)
    largest_difference = difference.max()
    largest = max(REPLAYS.values())
    lower_limit = 100 * largest * np.abs(expected).max()
    assert largest_difference > lower_limit
    for replay, tolerance in REPLAYS.items():
        replayed = replay(tmp_path / "out", y)
        largest = float(np.abs(expected).max())
        size = max(1.0, largest)
        difference = np.abs(replayed - expected)
        largest_difference = difference.max()
        assert largest_difference <= tolerance * size, replay.__name__


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kinds", [("relu", "saturation"), ("tanh", "softplus", "clipped_cubic")])
def test_the_replay_of_neurons_in_c(tmp_path: Path, kinds: tuple[str, ...], real: str) -> None:
    """To the last digit where they are piecewise linear, else within the bound that the replay
    itself holds."""
    made = load_controller(structured_run(tmp_path / "run", kinds, 0.02))
    ends = (-0.5, 0.5)
    device = DeviceController.from_controller(
        made, real, *(made.scale.physical_input(np.array([end])) for end in ends)
    )
    folder = written(device, tmp_path / "c")
    words = ("-fsanitize=address,undefined", "-lm") if real == "double" else ("-std=c99", "-lm")
    sources = ("controller_replay.c", *words)
    text = compiled(folder, sources=sources)
    assert "tanh" in kinds or text.startswith("0 of 200 inputs differ")
    free = DeviceController.from_controller(
        made, "double", *(made.scale.physical_input(np.array([end])) for end in (-1e6, 1e6))
    )
    assert (
        real == "float"
        or "tanh" in kinds
        or free.multiplication_count == products(free, tmp_path / "counted")
    )
    broken = (
        (folder / "controller.h")
        .read_text()
        .replace("controller_phi_bias[0];", "controller_phi_bias[0] + 1;")
    )
    (folder / "controller.h").write_text(broken)
    sources = ("controller_replay.c", *words)
    with pytest.raises(AssertionError, match="of 200 inputs differ"):
        compiled(folder, sources=sources)


def test_rates_of_neurons_are_proved_for_the_deployed_floats(tmp_path: Path) -> None:
    kinds = ("tanh", "relu")
    run = structured_run(tmp_path / "run", kinds, 0.0)
    design = Design.load(run / "certificate.json")
    for real in ("double", "float"):
        lower = np.array([-np.inf])
        upper = np.array([np.inf])
        device = DeviceController.from_controller(load_controller(run), real, lower, upper)
        rates = prove_deployed_rates(device, design)
        assert 0.45 < rates["state_feedback"] <= 0.5
        assert 0.45 < rates["observer"] <= 0.5
