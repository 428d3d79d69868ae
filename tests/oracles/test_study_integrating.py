"""An integrating plant, a motor's position, through the whole line: from its log to rest on the
true plant."""

from pathlib import Path

import numpy as np
import pytest

import ssm_study as st
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.study.verify import verify
from ssm_study.systems import StateSpace

pytestmark = pytest.mark.usefixtures("without_baselines")

FEW = (
    "+synthesis.input_weights=[0.01,1.0]",
    "+synthesis.output_noises=[0.01,1.0]",
    "+synthesis.stretch_shares=[0.3]",
)


def moved(x: np.ndarray, volts: float) -> np.ndarray:
    """Speed and position."""
    return np.array([0.8 * x[0] + 0.2 * volts, x[1] + 0.05 * x[0]])


def position_log() -> tuple[np.ndarray, np.ndarray]:
    """Steps of random height without a mean, then rest; the position with noise."""
    rng = np.random.default_rng(0)
    x = np.zeros(2)
    u = rng.uniform(-1, 1, 200).repeat(10)
    difference = u - u.mean()
    u = np.concatenate([difference, np.zeros(200)])
    y = []
    for volts in u:
        white_noise = rng.standard_normal()
        y.append(x[1] + 0.01 * white_noise)
        x = moved(x, volts)
    return u, np.array(y)


def test_a_position_is_identified_certified_doubted_and_brought_to_rest() -> None:
    u, y = position_log()
    words = (
        "model.order=2",
        "model=ssm",
        "model.hidden_width=4",
        "data.equilibrium=zero",
        "model.slope_lower=0.3",
        "training.max_epochs=30",
        "loop.horizon_s=10",
        "loop.initial_conditions=2",
    )
    model = st.fit(u, y, 0.05, *words)
    design = st.control(model, *FEW)
    assert design.record["fit_test_percent"] > 90
    assert design.record["spectral_radius"] > 0.999
    assert design.certificate.certified
    assert design.record["evidence"] == "doubt"
    assert "The output integrates its input" in design.record["evidence_reasons"]
    assert "data.decimate" not in design.record["evidence_reasons"]
    law = ObserverFeedback.from_design(design.model, design.certificate)
    limit_lower = design.record["limit_lower"]
    limit_upper = design.record["limit_upper"]
    limits = (limit_lower, limit_upper)
    reference = np.zeros((1, 1))
    plan = law.target_trajectory(reference)
    rest = plan[0]
    for start in (0.2, -2.0):  # from positions far beyond one step
        x = np.array([0.0, start])
        memory = law.initial_memory(1)
        for _ in range(800):
            seen = x[None, 1:]
            inputs = law.input(memory, seen, rest)
            applied = np.clip(inputs, *limits)
            memory = law.next_memory(memory, applied, seen, rest)
            x = moved(x, float(applied[0, 0]))
        expected = [0, 0]
        assert x == pytest.approx(expected, abs=1e-3 * abs(start))


def pushed(u: np.ndarray) -> np.ndarray:
    """The position of a mass that friction slows, measured with noise."""
    x = np.zeros(2)
    y = []
    rng = np.random.default_rng(1)
    for volts in u:
        white_noise = rng.standard_normal()
        y.append(x[1] + 0.01 * white_noise)
        x = moved(x, volts)
    return np.array(y)


def test_a_linear_model_with_its_integrator_goes_the_whole_way(tmp_path: Path) -> None:
    """No neuron is left of what is linear: the model has an eigenvalue of exactly one, and no
    balanced coordinates."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 60).repeat(10)
    difference = u - u.mean()
    u = np.concatenate([difference, np.zeros(60)])
    words = (
        "model.integrating_output=true",
        "model.order=1",
        "model.neurons=1",
        "model.starts=1",
        "model.draws=2",
        "model.among_starts=null",
        "model.ridge=0.1",
        "training.max_epochs=10",
    )
    model = st.fit(u, pushed(u), 0.05, *words, "data.equilibrium=zero")
    assert isinstance(model.ssm, SSM)
    assert model.ssm.linear.integrates
    assert model.result_columns["fit_test_percent"] > 90
    search = ("synthesis.integral_weights=[0.01]", "+synthesis.observer_rates=[0.1]")
    words = ("synthesis=auto_integral", "loop.initial_conditions=2", *FEW, *search)
    design = st.control(model, *words)
    assert design.certificate.certified
    assert design.record["stable_fraction"] == 1
    run = design.save(tmp_path / "saved")
    verification = verify(run)
    assert not [one.claim for one in verification if not one.holds]
    response = st.simulate(design, np.array([0.5, -0.5]))
    ends = response.groupby("case").last()
    largest = np.abs(ends["y"]).max()
    assert largest < 0.05


@pytest.mark.parametrize(
    ("a", "b", "c"),
    [
        ([[1.0]], [[0.1]], [[1.0]]),
        ([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], [[1.0, 0.0]]),
        ([[0.8, 0.0], [0.05, 1.0]], [[0.2, 0.0], [0.0, 0.1]], [[0.0, 1.0], [1.0, 0.0]]),
    ],
    ids=["integrator", "double integrator", "two inputs"],
)
def test_integrators_from_elsewhere_are_certified_and_led_to_a_set_point(
    a: list, b: list, c: list, tmp_path
) -> None:
    control = pytest.importorskip("control")
    outputs = len(c)
    asked = ("synthesis=riccati", "synthesis.rate_controller=0.05", "synthesis.rate_observer=0.05")
    model = control.ss(a, b, c, np.zeros((outputs, len(b[0]))), 0.1)
    design = st.control(model, *asked)
    assert design.certificate.certified
    reach = design.within_limits([-1.0] * len(b[0]), [1.0] * len(b[0]))
    assert (reach.lower < 0).all()
    assert (reach.upper > 0).all()
    step = ("reference@loop.reference=step", "loop.reference.after=0.3", "loop.horizon_s=30")
    response = st.simulate(design, np.zeros((1, outputs)), *step)
    ended = response.filter(like="y").iloc[-1]
    assert ended.to_numpy() == pytest.approx(0.3, abs=1e-3)
    text = design.to_c(tmp_path / "held.h").read_text()
    assert "_reset" in text


def test_the_points_at_rest_are_all_of_them() -> None:
    """`(x, v)` with `x = A x + B v` have as many directions as inputs, whether the model integrates
    or not."""
    rng = np.random.default_rng(0)
    for integrators in (0, 1, 2):
        for inputs in (1, 2, 3):
            white_noise = rng.standard_normal((4, 4))
            turn = np.linalg.qr(white_noise)[0]
            modes = np.diag(np.where(np.arange(4) < integrators, 1.0, rng.uniform(-0.9, 0.9, 4)))
            b = rng.standard_normal((4, inputs))
            c = rng.standard_normal((2, 4))
            d = rng.standard_normal((2, inputs))
            a = turn @ modes @ turn.T
            system = StateSpace(a=a, b=b, c=c, d=d)
            x, v, y = system.equilibrium_basis()
            assert system.integrates == (integrators > 0)
            expected = max(inputs, integrators)
            assert x.shape[1] == expected
            rank = np.linalg.matrix_rank(np.vstack([x, v]))
            assert rank == x.shape[1]
            assert system.a @ x + b @ v == pytest.approx(x, abs=1e-9)
            expected = c @ x + d @ v
            assert y == pytest.approx(expected)
            assert integrators or (v == np.eye(inputs)).all()
