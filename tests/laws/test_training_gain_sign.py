"""Behind an integrator the gain of a trained model has one sign at every slope of its neurons."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.models.contracting import (
    FreeParameters,
    RecurrenceMatrices,
    matrices_from_parameters,
)
from ssm_study.models.structured_spec import TrainablePiecewiseMap
from ssm_study.training.gain_sign import gains_at_extreme_slopes
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.structured_problem import (
    FREE_CORE,
    DescentState,
    SimulationProblem,
    Theta,
    pack_parameters,
    regularised_loss,
    take_step,
    unpack_parameters,
)

N = 3
Q = 2
RATE = 0.95
LINEAR = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
MOVED = (*FREE_CORE, "b", "c", "bias")


def parameters(seed: int) -> Theta:
    """Random parameters of a contracting model with two neurons behind an integrator."""
    rng = np.random.default_rng(seed)
    shapes = {"x_e": (N, Q), "x_g": (N + Q, N)}
    shapes |= {"log_d": (Q,), "b": (N, 1), "c": (1, N)}
    theta = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    theta["bias"] = 0.3 * rng.normal(size=Q)
    shapes_of_zeros = {"d": (1, 1), "g": (Q, 1), "h": (1, Q), "x0": (2, N + 1)}
    for name, shape in shapes_of_zeros.items():
        theta[name] = np.zeros(shape)
    theta["scaffold_in"] = np.zeros(0)
    theta["scaffold_out"] = np.zeros(0)
    return theta


def integrating(gain_share: float) -> SimulationProblem:
    """A training problem of two random records."""
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(2):
        u = rng.normal(size=(30, 1))
        y = rng.normal(size=(30, 1))
        pairs.append((u, y))
    records = RecordBatch.from_pairs(pairs)
    return SimulationProblem(
        records=records,
        neurons=("tanh",) * Q,
        lift=LINEAR,
        read=LINEAR,
        rate=RATE,
        integrating_output=True,
        gain_share=gain_share,
    )


def gains_of(theta: Theta) -> np.ndarray:
    """Gains at the corners of the slopes."""
    problem = integrating(0.0)
    matrices = problem.kernel_matrices(theta)
    return gains_at_extreme_slopes(matrices)


def has_two_signs(theta: Theta) -> bool:
    signs = np.sign(gains_of(theta))
    return bool(np.ptp(signs) > 0)


def turned_round() -> Theta:
    """Parameters whose gain has two signs."""
    candidates = (parameters(seed) for seed in range(100))
    return next(theta for theta in candidates if has_two_signs(theta))


def start_descent(problem: SimulationProblem, theta: Theta) -> DescentState:
    loss = regularised_loss(problem, theta, MOVED)
    return DescentState(theta=theta, loss=loss, damping=1e-2)


def test_the_penalty_is_part_of_loss_and_step() -> None:
    theta = turned_round()
    problem = integrating(0.05)
    missing = problem.gain_sign_residuals(theta)
    assert missing.max() > 0.0
    bare_problem = integrating(0.0)
    bare = regularised_loss(bare_problem, theta, ())
    penalty = float(missing @ missing)
    penalised = regularised_loss(problem, theta, ())
    assert penalised == pytest.approx(bare + penalty)
    start = start_descent(problem, theta)
    after = take_step(problem, start, MOVED)
    assert after.loss < start.loss


def test_its_derivatives_are_those_of_differences() -> None:
    theta = turned_round()
    problem = integrating(0.05)
    missing, slopes = problem.gain_sign_residuals_and_jacobian(theta, MOVED)
    flat = pack_parameters(theta, MOVED)
    rng = np.random.default_rng(0)
    direction = 1e-5 * rng.normal(size=len(flat))
    moved = unpack_parameters(flat + direction, theta, MOVED)
    ahead = problem.gain_sign_residuals(theta | moved)
    difference = ahead - missing
    expected = slopes @ direction
    np.testing.assert_allclose(difference, expected, rtol=1e-2, atol=1e-8)
    steepest = np.abs(slopes).max()
    assert steepest > 0.0


def test_steps_turn_the_gain_back() -> None:
    problem = integrating(0.05)
    theta = turned_round()
    at = start_descent(problem, theta)
    for _ in range(30):
        at = take_step(problem, at, MOVED)
    signs = np.sign(gains_of(at.theta))
    assert np.ptp(signs) == 0


def contracting_core(theta: Theta) -> RecurrenceMatrices:
    """The contracting recurrence that these parameters stand for."""
    free = FreeParameters(*(theta[name] for name in FREE_CORE))
    return matrices_from_parameters(free, RATE)


def gain_at(theta: Theta, slopes: np.ndarray) -> np.ndarray:
    """Static gain of the model whose neurons have these slopes."""
    core = contracting_core(theta)
    recurrence = core.a + (core.e * slopes) @ core.f
    state = np.linalg.solve(np.eye(N) - recurrence, theta["b"])
    return theta["c"] @ state


def test_between_the_corners_the_gain_has_no_other_sign() -> None:
    rng = np.random.default_rng(1)
    numbers_of_signs = set()
    for seed in range(40):
        theta = parameters(seed)
        corner_signs = np.sign(gains_of(theta))
        signs = set(corner_signs)
        numbers_of_signs.add(len(signs))
        drawn_slopes = rng.uniform(size=(20, Q))
        for slopes in drawn_slopes:
            gain = gain_at(theta, slopes)
            inner_signs = set(np.sign(gain).ravel())
            assert len(signs) == 2 or inner_signs == signs
    assert numbers_of_signs == {1, 2}


def test_there_is_no_penalty_without_neurons_or_where_it_is_not_asked_for() -> None:
    theta = turned_round()
    without_penalty = integrating(0.0)
    assert without_penalty.gain_sign_residuals(theta).size == 0
    without_neurons = replace(integrating(0.05), neurons=())
    assert without_neurons.gain_sign_residuals(theta).size == 0
