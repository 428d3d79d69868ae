"""Behind an integrator the gain of a trained model has one sign at every slope of its neurons."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.models.contracting import FreeParameters, matrices_from_parameters
from ssm_study.models.structured_spec import TrainablePieces
from ssm_study.training.gain_sign import corner_gains
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.structured_problem import (
    FREE_CORE,
    Descent,
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
LINEAR = TrainablePieces(1, 0, 0.1, 1.0)
MOVED = (*FREE_CORE, "b", "c", "bias")


def parameters(seed: int) -> Theta:
    """Random parameters of a contracting model with two neurons behind an integrator."""
    rng = np.random.default_rng(seed)
    shapes = {"x_e": (N, Q), "x_g": (N + Q, N), "log_d": (Q,), "b": (N, 1), "c": (1, N)}
    theta = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    theta["bias"] = 0.3 * rng.normal(size=Q)
    zeros = {"d": (1, 1), "g": (Q, 1), "h": (1, Q), "x0": (2, N + 1)}
    theta |= {name: np.zeros(shape) for name, shape in zeros.items()}
    return theta | {"scaffold_in": np.zeros(0), "scaffold_out": np.zeros(0)}


def integrating(gain_share: float) -> SimulationProblem:
    """A training problem of two random records."""
    rng = np.random.default_rng(0)
    pairs = [(rng.normal(size=(30, 1)), rng.normal(size=(30, 1))) for _ in range(2)]
    return SimulationProblem(
        records=RecordBatch.from_pairs(pairs),
        neurons=("tanh",) * Q,
        lift=LINEAR,
        read=LINEAR,
        rate=RATE,
        integrating_output=True,
        gain_share=gain_share,
    )


def gains_of(theta: Theta) -> np.ndarray:
    """Gains at the corners of the slopes."""
    return corner_gains(integrating(0.0).matrices(theta))


def turned_round() -> Theta:
    """Parameters whose gain has two signs."""
    every = (parameters(seed) for seed in range(100))
    return next(theta for theta in every if np.ptp(np.sign(gains_of(theta))) > 0)


def test_the_penalty_is_part_of_loss_and_step() -> None:
    theta = turned_round()
    problem = integrating(0.05)
    missing = problem.gain_sign_residuals(theta)
    assert missing.max() > 0.0
    bare = regularised_loss(integrating(0.0), theta, ())
    assert regularised_loss(problem, theta, ()) == pytest.approx(bare + float(missing @ missing))
    at = Descent(theta=theta, loss=regularised_loss(problem, theta, MOVED), damping=1e-2)
    assert take_step(problem, at, MOVED).loss < at.loss


def test_its_derivatives_are_those_of_differences() -> None:
    theta = turned_round()
    problem = integrating(0.05)
    missing, slopes = problem.gain_sign_residuals_and_jacobian(theta, MOVED)
    flat = pack_parameters(theta, MOVED)
    direction = 1e-5 * np.random.default_rng(0).normal(size=len(flat))
    ahead = problem.gain_sign_residuals(theta | unpack_parameters(flat + direction, theta, MOVED))
    np.testing.assert_allclose(ahead - missing, slopes @ direction, rtol=1e-2, atol=1e-8)
    assert np.abs(slopes).max() > 0.0


def test_steps_turn_the_gain_back() -> None:
    problem = integrating(0.05)
    theta = turned_round()
    at = Descent(theta=theta, loss=regularised_loss(problem, theta, MOVED), damping=1e-2)
    for _ in range(30):
        at = take_step(problem, at, MOVED)
    gains = gains_of(at.theta)
    assert np.ptp(np.sign(gains)) == 0


def test_between_the_corners_the_gain_has_no_other_sign() -> None:
    rng = np.random.default_rng(1)
    seen = set()
    for seed in range(40):
        theta = parameters(seed)
        core = matrices_from_parameters(FreeParameters(*(theta[name] for name in FREE_CORE)), RATE)
        signs = set(np.sign(gains_of(theta)))
        for slopes in rng.uniform(size=(20, Q)):
            recurrence = core.a + (core.e * slopes) @ core.f
            gain = theta["c"] @ np.linalg.solve(np.eye(N) - recurrence, theta["b"])
            assert len(signs) == 2 or set(np.sign(gain).ravel()) == signs
        seen.add(len(signs))
    assert seen == {1, 2}


def test_there_is_no_penalty_without_neurons_or_where_it_is_not_asked_for() -> None:
    theta = turned_round()
    assert integrating(0.0).gain_sign_residuals(theta).size == 0
    assert replace(integrating(0.05), neurons=()).gain_sign_residuals(theta).size == 0
