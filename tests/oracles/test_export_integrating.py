"""Set points of controllers whose model integrates: every output is one, in C as in Python."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from export_cases import compiled, device, written

from ssm_study.export.device import DeviceController
from ssm_study.export.portable import convert_floats, evaluate_static_map
from ssm_study.export.set_point_maps import REALS


def integrating_device(folder: Path, kind: str, real: str = "double") -> DeviceController:
    """Device for a model whose output is a running sum, with LQR gains."""
    made = device(folder, kind=kind, real=real)
    old = made.controller
    n = len(old.a)
    a = np.eye(n + 1)
    a[:n, :n] = old.a
    a[n:, :n] = 0.1 * old.c
    b = np.zeros((n + 1, 1))
    b[:n] = old.b
    c = np.eye(1, n + 1, n)
    state_feedback = lqr_gain(a, b)
    observer = lqr_gain(a.T, c.T)
    d = np.zeros((1, 1))
    e = np.zeros((n + 1, 1))
    model = {"a": a, "b": b, "c": c, "d": d}
    longer = replace(old, **model, k=state_feedback, l=observer.T, e=e)
    controller = convert_floats(longer, REALS[real])
    return replace(made, controller=controller)


def lqr_gain(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    order, inputs = b.shape
    q = np.eye(order)
    r = np.eye(inputs)
    p = scipy.linalg.solve_discrete_are(a, b, q, r)
    weighted = b.T @ p
    return -np.linalg.solve(r + weighted @ b, weighted @ a)


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kind", ["linear", "monotone"])
def test_an_integrating_output_is_brought_to_any_set_point(
    tmp_path: Path, kind: str, real: str
) -> None:
    """It stays there with the input at its equilibrium, also where the limits act on the way."""
    made = integrating_device(tmp_path, kind, real)
    assert made.no_set_points_reason == ""
    folder = written(made, tmp_path / "c")
    assert compiled(folder, "-std=c99").startswith("0 of 200")
    scale = made.controller.scale
    start = scale.physical_output(np.array([-3.0]))
    aim = scale.physical_output(np.array([40.0]))
    number = REALS[real]
    set_point = aim.astype(number)
    measured = start.astype(number)
    plant = convert_floats(made.controller, np.float64)
    x = made.equilibrium_state(measured)
    state = x.astype(float)
    inputs = []
    for _ in range(4000):
        read = plant.c @ state
        w = evaluate_static_map(plant.s_out, read)
        y = scale.physical_output(w)
        measured = y.astype(number)
        u, x = made.compute_step(x, measured, set_point)
        inputs.append(u)
        applied = scale.scaled_input(u.astype(float))
        lifted = evaluate_static_map(plant.s_in, applied)
        state = plant.a @ state + plant.b @ lifted
    assert y == pytest.approx(aim, rel=1e-3)
    at_rest = scale.physical_input(np.zeros(1))
    assert inputs[-1] == pytest.approx(at_rest, abs=1e-3)
    limits = (made.lower, made.upper)
    assert any(u in limits for u in inputs)


def test_slow_modes_are_no_integrator(tmp_path: Path) -> None:
    """In companion form I - A is as near to singular as the product of the distances to one."""
    made = device(tmp_path, kind="linear", real="float")
    old = made.controller
    n = len(old.a)
    pole = 1 - 10 ** (-8 / n)
    coefficients = np.poly([pole] * n)
    a = scipy.linalg.companion(coefficients)
    b = np.eye(n, 1)
    c = 1e-8 * np.eye(1, n, n - 1)  # a unit of the input holds a unit of the output
    d = np.zeros((1, 1))
    slow = convert_floats(replace(old, a=a, b=b, c=c, d=d), np.float32)
    points = replace(made, controller=slow).set_point_maps
    assert points is None or points.inward is not None


def test_an_integrator_that_the_output_does_not_tell_has_no_set_points(tmp_path: Path) -> None:
    made = integrating_device(tmp_path, "linear")
    hidden = np.eye(1, len(made.controller.a))
    blind = replace(made, controller=replace(made.controller, c=hidden))
    assert blind.no_set_points_reason.startswith("the model integrates, but not")
