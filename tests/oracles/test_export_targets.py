"""Every export target computes what the Python loop computes, for every scaffolding, in one and several channels."""

import json
import runpy
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from report_runs import KINDS, random_run

from ssm_study.export.targets import export
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.synthesis.certificate import Design

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
        for (int i = 0; i < (int)(sizeof u / sizeof *u); ++i) u[i] = u[i] > 3 ? 3 : u[i] < -3 ? -3 : u[i];
        controller_advance(&state, y, u);""",
)


def python_loop(run: Path, y: np.ndarray, limit: float = np.inf) -> np.ndarray:
    model, design = SSM.from_json(json.loads((run / "model.json").read_text())), Design.load(run / "certificate.json")
    law = ObserverFeedback(model=model, gains=design.pair)
    memory, m = law.start(1), model.scale.inputs
    target = np.concatenate([np.zeros(model.order + m), model.scale.output_equilibrium])
    u = np.empty((len(y), m))
    for k, seen in enumerate(y):
        u[k] = np.clip(law.input(memory, seen[None], target)[0], -limit, limit)
        memory = law.advance(memory, u[k][None], seen[None], target)
    return u


def c_replay(folder: Path, y: np.ndarray, main: str = MAIN_C) -> np.ndarray:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    numbers = json.loads((folder / "controller.json").read_text())
    m, p = len(numbers["input_scale"]), len(numbers["output_scale"])
    (folder / "main.c").write_text(main % (p, m, p, m))
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2"]
    subprocess.run(["gcc", *strict, "main.c", "-o", "main"], cwd=folder, check=True)
    text = " ".join(repr(float(v)) for v in y.ravel())
    done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=float).reshape(len(y), m)


def onnx_replay(folder: Path, y: np.ndarray) -> np.ndarray:
    runtime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")
    session = runtime.InferenceSession(folder / "controller.onnx", providers=["CPUExecutionProvider"])
    state, u = np.zeros((1, session.get_inputs()[1].shape[1])), []
    for seen in y:
        given, state = session.run(["u", "next_state"], {"y": seen[None], "state": state})
        u.append(given[0])
    return np.array(u)


def control_replay(folder: Path, y: np.ndarray) -> np.ndarray:
    control = pytest.importorskip("control", reason="the extra `export` is not installed")
    system = runpy.run_path(str(folder / "controller.py"))["controller"]
    return control.input_output_response(system, np.arange(len(y)) * system.dt, y.T, squeeze=False).outputs.T


@pytest.mark.parametrize(("replay", "tolerance"), [(c_replay, 1e-9), (onnx_replay, 1e-6), (control_replay, 1e-9)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("channels", "integral"), [(1, False), (2, False), (1, True), (2, True)])
def test_export_replays_the_python_loop(
    tmp_path: Path, kind: str, channels: int, integral: bool, replay: Replay, tolerance: float
) -> None:
    run = random_run(tmp_path / "run", kind=kind, channels=channels, seed=channels, integral=integral)
    export(run, tmp_path / "out")
    y = 3 + 5 * np.random.default_rng(7).standard_normal((SAMPLES, channels))
    expected = python_loop(run, y)
    assert np.ptp(expected) > 0.01  # a controller that does nothing would agree with anything
    assert np.abs(replay(tmp_path / "out", y) - expected).max() <= tolerance * max(1.0, float(np.abs(expected).max()))


def test_integrators_in_c_rest_while_a_limit_holds_the_input(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="mlp", channels=1, seed=3, integral=True)
    export(run, tmp_path / "out")
    y = 40 * np.sign(np.sin(2 * np.pi * np.arange(SAMPLES) / 60))[:, None]
    limited = python_loop(run, y, limit=3.0)
    assert np.abs(limited - python_loop(run, y).clip(-3, 3)).max() > 0.1, "without the hold it would do otherwise"
    assert np.abs(c_replay(tmp_path / "out", y, MAIN_LIMITED_C) - limited).max() <= 1e-9


def test_the_certificate_lies_beside_it_byte_for_byte(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="mlp", channels=1, seed=0)
    names = {path.name for path in export(run, tmp_path / "out")}
    assert {"controller.h", "controller.json", "controller.py", "certificate.json"} <= names
    assert (tmp_path / "out" / "certificate.json").read_bytes() == (run / "certificate.json").read_bytes()
    assert "NOT certified" in (tmp_path / "out" / "controller.h").read_text()  # its numbers prove nothing
