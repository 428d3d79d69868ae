"""A log of a known loop: the set point found again from the PI, the bias of a slow drift gone, and
what is refused."""

from pathlib import Path

import numpy as np
import pytest
import scipy

from ssm_study.data.closed_loop import project_inputs_on_set_points, reconstruct_pi_set_point
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.feedback import EARLIER, PRESENT, feedback_share
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory

GAIN = 3.0
INTEGRAL_S = 0.8
STEP_S = 0.1
SAMPLES = 3000


def loop(
    seed: int, drift: float = 0.95, integral_s: float = INTEGRAL_S
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`x+ = 0.9 x + 0.1 u` under a PI, y with noise half as large as what the input moves."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1, 1, SAMPLES // 10)
    r = levels.repeat(10)
    w = 0.2 * rng.standard_normal(SAMPLES)
    u = np.zeros(SAMPLES)
    y = np.zeros(SAMPLES)
    x = 0.0
    i = 0.0
    slow = 0.0
    for k in range(SAMPLES):
        shock = np.sqrt(1 - drift**2) * w[k]
        slow = drift * slow + shock
        y[k] = x + slow
        e = r[k] - y[k]
        u[k], i = GAIN * (e + i), i + STEP_S / integral_s * e
        x = 0.9 * x + 0.1 * u[k]
    return r, u, y


def log(u: np.ndarray, y: np.ndarray) -> Trajectory:
    return Trajectory(u=u[:, None], y=y[:, None], step_s=STEP_S)


def fitted(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gain at rest and pole of the first-order model nearest in free run: no code of ours."""
    bounds = (0, [5, 0.999])
    return scipy.optimize.least_squares(
        lambda p: y - scipy.signal.lfilter([0.0, (1 - p[1]) * p[0]], [1.0, -p[1]], u),
        [0.8, 0.8],
        bounds=bounds,
    ).x


def written(folder: Path, *columns: np.ndarray) -> str:
    signals = np.column_stack(columns)
    np.savetxt(folder / "log.csv", signals, delimiter=",", header="r,u,y", comments="", fmt="%.12g")
    return str(folder / "log.csv")


def test_the_set_point_of_a_pi_is_found_again() -> None:
    r, u, y = loop(0)
    rows = reconstruct_pi_set_point(log(u, y), GAIN, INTEGRAL_S)
    found = rows[:, 0]
    late = SAMPLES // 10  # what the integral held at the start is forgotten by then
    deviation = (found - r)[late:]
    difference = np.abs(deviation - deviation[-1])
    largest_difference = difference.max()
    assert largest_difference < 1e-9
    rows = reconstruct_pi_set_point(log(u, y), 2 * GAIN, INTEGRAL_S)
    wrong = rows[:, 0]
    deviation = (wrong - r)[late:]
    largest = np.abs(deviation).max()
    assert largest > 0.1


def test_the_bias_of_a_slow_drift_is_gone() -> None:
    """From the applied input a drift makes the gain too small at every seed; from the set point's
    share it scatters."""
    direct = []
    staged = []
    for seed in range(6):
        r, u, y = loop(seed, integral_s=1e9)
        logs = [log(u, y)]
        references = [r[:, None]]
        by_set_point, share = project_inputs_on_set_points(logs, references)
        direct.append(fitted(u, y)[0])
        by_set_point_u = by_set_point[0].u
        staged.append(fitted(by_set_point_u[:, 0], y)[0])
        assert 0.3 < share < 0.95
    assert max(direct) < 0.92
    mean = np.mean(staged)
    difference = abs(mean - 1)
    assert difference < 0.04
    difference = np.abs(np.array(staged) - 1)
    largest_difference = difference.max()
    assert largest_difference < 0.12


def test_set_point_and_pi_give_the_same_input_and_no_doubt_of_feedback(tmp_path: Path) -> None:
    path = written(tmp_path, *loop(1, drift=0.0))
    asked = {"path": path, "input": "u", "output": "y", "step_s": STEP_S}
    controller = [GAIN, INTEGRAL_S]
    plain, named, pi, wrong = (
        RecordedData(**asked, **more).build(0)
        for more in (
            {},
            {"reference": "r"},
            {"controller": controller},
            {"controller": [-GAIN, 100.0]},
        )
    )
    training_u = named.training[0].u
    a = training_u[300:, 0]
    training_u = pi.training[0].u
    b = training_u[300:, 0]
    difference = np.abs(a - b)
    largest_difference = difference.max()
    upper_limit = 0.05 * np.ptp(a)
    assert largest_difference < upper_limit
    found = {
        name: feedback_share(data, 0)
        for name, data in (("plain", plain), ("named", named), ("wrong", wrong))
    }
    assert found["plain"] > PRESENT
    assert found["named"] < EARLIER
    assert found["wrong"] > PRESENT
    assert plain.metadata.get("by_set_point") is None
    by_set_point = float(named.metadata["by_set_point"])
    assert 0.3 < by_set_point < 0.99
    actual = plain.training[0].y
    expected = named.training[0].y
    np.testing.assert_array_equal(actual, expected)


def test_refusals(tmp_path: Path) -> None:
    r, u, y = loop(2)
    path = written(tmp_path, r, u, y)
    asked = {"path": path, "input": "u", "output": "y", "step_s": STEP_S}
    recorded_data_controller = [1.0, 1.0]
    with pytest.raises(BadRequest, match="one is enough; name the set point alone"):
        RecordedData(**asked, reference="r", controller=recorded_data_controller)
    for controller in ([0.0, 1.0], [1.0], [1.0, -1.0]):
        with pytest.raises(BadRequest, match="is no PI; give"):
            RecordedData(**asked, controller=controller)
    clipped = log(np.clip(u, -1, 1), y)
    with pytest.raises(BadRequest, match="are at a limit of the input"):
        reconstruct_pi_set_point(clipped, GAIN, INTEGRAL_S)
    two_inputs = np.stack([u, u], axis=1)
    trajectory = Trajectory(u=two_inputs, y=y[:, None], step_s=STEP_S)
    with pytest.raises(BadRequest, match="a PI has one each"):
        reconstruct_pi_set_point(trajectory, GAIN, INTEGRAL_S)
    logs = [log(u[:300], y[:300])]
    references = [r[:300, None]]
    with pytest.raises(BadRequest, match="log longer"):
        project_inputs_on_set_points(logs, references)
    recorded_data = RecordedData(**asked, reference="set_point")
    with pytest.raises(BadRequest):
        recorded_data.build(0)
