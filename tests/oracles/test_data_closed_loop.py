"""A log of a known loop: the set point found again from the PI, the bias of a slow drift gone, and
what is refused."""

from pathlib import Path

import numpy as np
import pytest
import scipy

from ssm_study.data.closed_loop import project_inputs_on_set_points, reconstruct_pi_set_point
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.feedback import EARLIER, PRESENT, feedback_error_reduction
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory

GAIN = 3.0
INTEGRAL_S = 0.8
STEP_S = 0.1
SAMPLES = 3000


Signals = tuple[np.ndarray, np.ndarray, np.ndarray]


def loop(seed: int, drift: float = 0.95, integral_s: float = INTEGRAL_S) -> Signals:
    """`x+ = 0.9 x + 0.1 u` under a PI, y with noise half as large as what the input moves."""
    rng = np.random.default_rng(seed)
    count = SAMPLES // 10
    levels = rng.uniform(-1, 1, count)
    r = levels.repeat(10)
    w = 0.2 * rng.standard_normal(SAMPLES)
    u = np.zeros(SAMPLES)
    y = np.zeros(SAMPLES)
    x = 0.0
    i = 0.0
    slow = 0.0
    for k in range(SAMPLES):
        innovation = np.sqrt(1 - drift**2)
        shock = innovation * w[k]
        slow = drift * slow + shock
        y[k] = x + slow
        e = r[k] - y[k]
        u[k] = GAIN * (e + i)
        i += STEP_S / integral_s * e
        x = 0.9 * x + 0.1 * u[k]
    return r, u, y


def log(u: np.ndarray, y: np.ndarray) -> Trajectory:
    inputs = u[:, None]
    outputs = y[:, None]
    return Trajectory(u=inputs, y=outputs, step_s=STEP_S)


def fitted(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gain at rest and pole of the first-order model nearest in free run: no code of ours."""
    bounds = (0, [5, 0.999])

    def error_of(parameters: np.ndarray) -> np.ndarray:
        gain, pole = parameters
        numerator = [0.0, (1 - pole) * gain]
        response = scipy.signal.lfilter(numerator, [1.0, -pole], u)
        return y - response

    nearest = scipy.optimize.least_squares(error_of, [0.8, 0.8], bounds=bounds)
    return nearest.x


CSV = {"delimiter": ",", "header": "r,u,y", "comments": "", "fmt": "%.12g"}


def written(folder: Path, *columns: np.ndarray) -> str:
    signals = np.column_stack(columns)
    path = folder / "log.csv"
    np.savetxt(path, signals, **CSV)
    return str(path)


def test_the_set_point_of_a_pi_is_found_again() -> None:
    r, u, y = loop(0)
    recorded = log(u, y)
    rows = reconstruct_pi_set_point(recorded, GAIN, INTEGRAL_S)
    set_point = rows[:, 0]
    late = SAMPLES // 10  # what the integral held at the start is forgotten by then
    deviation = (set_point - r)[late:]
    difference = np.abs(deviation - deviation[-1])
    largest_difference = difference.max()
    assert largest_difference < 1e-9
    rows = reconstruct_pi_set_point(recorded, 2 * GAIN, INTEGRAL_S)
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
        direct_gain, _ = fitted(u, y)
        direct.append(direct_gain)
        staged_u = by_set_point[0].u[:, 0]
        staged_gain, _ = fitted(staged_u, y)
        staged.append(staged_gain)
        assert 0.3 < share < 0.95
    assert max(direct) < 0.92
    mean = np.mean(staged)
    difference = abs(mean - 1)
    assert difference < 0.04
    deviations = np.array(staged) - 1
    difference = np.abs(deviations)
    largest_difference = difference.max()
    assert largest_difference < 0.12


def settings_of(path: str) -> dict[str, object]:
    return {"path": path, "input": "u", "output": "y", "step_s": STEP_S}


def test_set_point_and_pi_give_the_same_input_and_no_doubt_of_feedback(tmp_path: Path) -> None:
    signals = loop(1, drift=0.0)
    path = written(tmp_path, *signals)
    settings = settings_of(path)
    plain = RecordedData(**settings).build(0)
    named = RecordedData(**settings, reference="r").build(0)
    controller = [GAIN, INTEGRAL_S]
    pi = RecordedData(**settings, controller=controller).build(0)
    controller = [-GAIN, 100.0]
    wrong = RecordedData(**settings, controller=controller).build(0)
    by_name = named.training[0].u[300:, 0]
    by_controller = pi.training[0].u[300:, 0]
    difference = np.abs(by_name - by_controller)
    largest_difference = difference.max()
    upper_limit = 0.05 * np.ptp(by_name)
    assert largest_difference < upper_limit
    assert feedback_error_reduction(plain, 0) > PRESENT
    assert feedback_error_reduction(named, 0) < EARLIER
    assert feedback_error_reduction(wrong, 0) > PRESENT
    assert plain.metadata.get("by_set_point") is None
    by_set_point = float(named.metadata["by_set_point"])
    assert 0.3 < by_set_point < 0.99
    actual = plain.training[0].y
    expected = named.training[0].y
    np.testing.assert_array_equal(actual, expected)


def test_refusals(tmp_path: Path) -> None:
    r, u, y = loop(2)
    path = written(tmp_path, r, u, y)
    settings = settings_of(path)
    controller = [1.0, 1.0]
    with pytest.raises(BadRequest, match="only one of them can be given; name the set point alone"):
        RecordedData(**settings, reference="r", controller=controller)
    no_controllers = ([0.0, 1.0], [1.0], [1.0, -1.0])
    for controller in no_controllers:
        with pytest.raises(BadRequest, match="is no PI, which has a gain"):
            RecordedData(**settings, controller=controller)
    clipped_u = np.clip(u, -1, 1)
    clipped = log(clipped_u, y)
    with pytest.raises(BadRequest, match="at a limit of the input"):
        reconstruct_pi_set_point(clipped, GAIN, INTEGRAL_S)
    two_inputs = np.stack([u, u], axis=1)
    outputs = y[:, None]
    trajectory = Trajectory(u=two_inputs, y=outputs, step_s=STEP_S)
    with pytest.raises(BadRequest, match="a PI needs one each"):
        reconstruct_pi_set_point(trajectory, GAIN, INTEGRAL_S)
    short = log(u[:300], y[:300])
    logs = [short]
    references = [r[:300, None]]
    with pytest.raises(BadRequest, match="log longer"):
        project_inputs_on_set_points(logs, references)
    recorded_data = RecordedData(**settings, reference="set_point")
    with pytest.raises(BadRequest):
        recorded_data.build(0)


def test_two_logs_of_one_loop_share_one_share_by_their_set_points(tmp_path: Path) -> None:
    paths = []
    for name, seed in (("first", 1), ("second", 2)):
        folder = tmp_path / name
        folder.mkdir()
        signals = loop(seed, drift=0.0)
        path = written(folder, *signals)
        paths.append(path)
    settings = settings_of(paths[0]) | {"path": paths}
    both = RecordedData(**settings, reference="r").build(0)
    by_set_point = float(both.metadata["by_set_point"])
    assert 0.3 < by_set_point < 0.99
    numbers = [record.log for record in both.training]
    assert numbers == [1, 2]
