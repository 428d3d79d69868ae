"""A measured disturbance where records are cut, joined, shifted and compared: folds, the choice of
a model, the start of a piece from its log's past, the estimator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from disturbance_cases import STEP_S, motor_log
from structured_cases import drawn

import ssm_study as st
from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.splits import split_by_time
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.warm_start import preceding_log, state_from_past
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.systems import StateSpace
from ssm_study.training.candidates import fit_linear_model, try_linear_model
from ssm_study.training.choice_of_paths import nearly_integrates
from ssm_study.training.folds import join_training_and_validation, make_folds

SLOW = 0.99
SAMPLES = 1200
SCALE = Scale(
    input_scale=np.ones(1),
    output_scale=np.ones(1),
    input_equilibrium=np.zeros(1),
    output_equilibrium=np.zeros(1),
    disturbance_scale=np.array([2.0]),
    disturbance_equilibrium=np.array([3.0]),
)


def slow_model() -> SSM:
    """A lag that a disturbance moves more than the input does."""
    a = np.array([[SLOW]])
    b = np.array([[0.01]])
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    system = StateSpace(a=a, b=b, c=c, d=d)
    identity = LinearScaffold.identity(1)
    b_d = np.array([[0.05]])
    return SSM(
        linear=system, scaffold_in=identity, scaffold_out=identity, scale=SCALE, step_s=0.1, b_d=b_d
    )


def log_of_slow_model() -> Trajectory:
    """The model's own answer to an input and a disturbance that step."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, SAMPLES // 20).repeat(20)[:, None]
    d = rng.uniform(0, 6, SAMPLES // 40).repeat(40)[:, None]
    y = slow_model().simulate(u, np.array([2.0]), d)
    return Trajectory(u=u, y=y, d=d, step_s=0.1, log=1)


def dataset() -> DataSet:
    """That log, cut in order of time."""
    training, validation, test = split_by_time(log_of_slow_model(), 0.2, 0.2)
    rest = (np.zeros(1), np.zeros(1), np.full(1, 3.0))
    names = ("u", "y", "d")
    channels = tuple((Channel(name=name, unit=""),) for name in names)
    parts = (training, validation, test)
    return assemble_dataset(parts, rest, channels, 20)


def test_the_past_of_a_piece_is_driven_by_its_disturbance() -> None:
    """The state at the test piece is that of the whole simulation, which owes nothing to it."""
    data = dataset()
    piece = data.test[0]
    whole = log_of_slow_model()
    start = whole.first
    u = whole.u[start : piece.first]
    d = whole.d[start : piece.first]
    expected = slow_model().simulate_mapped(slow_model().driving_signals(u, d), np.array([2.0]))[1]
    state = state_from_past(slow_model(), data, piece)
    np.testing.assert_allclose(state, expected.reshape(-1)[-1], rtol=1e-6)
    before = preceding_log(data, piece)
    np.testing.assert_array_equal(before.d, whole.d[: piece.first])


def test_folds_have_the_disturbance_of_their_own_samples() -> None:
    data = dataset()
    whole = log_of_slow_model()
    (joined,) = join_training_and_validation(data).training
    assert len(joined.d) == len(joined) == len(data.training[0]) + len(data.validation[0])
    for fold in make_folds(data):
        for record in (*fold.training, *fold.test):
            first = record.first
            expected = whole.d[first : first + len(record)]
            np.testing.assert_array_equal(record.d, expected)


def test_linear_candidates_are_told_the_disturbance() -> None:
    """With it a first-order model is exact; with it left out most of the output is missed."""
    data = dataset()
    trial = try_linear_model(make_folds(data), 1, 1)
    told = trial.errors
    training = tuple(replace(one, d=None) for one in data.training)
    validation = tuple(replace(one, d=None) for one in data.validation)
    test = tuple(replace(one, d=None) for one in data.test)
    disturbance_scale = np.zeros(0)
    disturbance_equilibrium = np.zeros(0)
    scale = replace(
        data.scale,
        disturbance_scale=disturbance_scale,
        disturbance_equilibrium=disturbance_equilibrium,
    )
    without = replace(
        data, disturbances=(), training=training, validation=validation, test=test, scale=scale
    )
    assert told.max() < 1.0
    trial = try_linear_model(make_folds(without), 1, 1)
    errors = trial.errors
    mean = errors.mean()
    assert mean > 30.0
    assert not nearly_integrates(data)


@pytest.mark.parametrize("direct", [False, True])
def test_a_linear_model_of_the_choice_has_a_path_for_the_disturbance(direct: bool) -> None:
    """The disturbance is no input of it, or it would be commanded."""
    data = dataset()
    model = fit_linear_model(data, 1, direct=direct)
    linear_b = model.linear.b
    expected = model.linear.d.shape
    assert linear_b.shape == expected == (1, 1)
    whole = log_of_slow_model()
    response = model.simulate(whole.u, None, whole.d)
    error = whole.y - response
    response = model.simulate(whole.u)
    error_without = whole.y - response
    settled = slice(400, None)  # the start is forgotten
    norm = np.linalg.norm(error[settled])
    upper_limit = 0.3 * np.linalg.norm(error_without[settled])
    assert norm < upper_limit
    late = model.with_dead_time(2)
    actual = late.b_d[:1]
    np.testing.assert_array_equal(actual, model.b_d)


@pytest.mark.parametrize("samples", [1, 3])
def test_neurons_and_a_load_behind_a_dead_time(samples: int) -> None:
    """The load acts at once, the input late: the delayed model is the model on a shifted input."""
    system = drawn(3, radius=0.8)
    rng = np.random.default_rng(0)
    bias = np.zeros(system.neurons)
    neurons = ("tanh",) * system.neurons
    model = StructuredSSM(
        **vars(system),
        bias=bias,  # at rest at the equilibrium, as before the record
        neurons=neurons,
        scaffold_in=LinearScaffold.identity(1),
        scaffold_out=LinearScaffold.identity(1),
        scale=SCALE,
        step_s=0.1,
        b_d=rng.normal(size=(system.order, 1)),
    )
    u = rng.normal(size=(60, 1))
    d = rng.normal(size=(60, 1))
    late = np.concatenate([np.zeros((samples, 1)), u[:-samples]])
    delayed = model.with_dead_time(samples).simulate(u, d=d)
    expected = model.simulate(late, d=d)
    np.testing.assert_allclose(delayed, expected, atol=1e-10)


def test_the_estimator_is_told_the_load(tmp_path: Path) -> None:
    log = pd.read_csv(motor_log(tmp_path))
    train = log[:600]
    test = log[600:]
    words = ("model.hidden_width=4", "training.max_epochs=8")
    estimator = st.Estimator(step_s=STEP_S, model="ssm", order=2, overrides=words)
    estimator.fit(train.voltage, train.speed, disturbance=train.torque)
    fit = estimator.score(test.voltage, test.speed, disturbance=test.torque)
    assert fit > 85.0
    assert estimator.score(test.voltage, test.speed) < fit - 20.0
    predicted = estimator.predict(test.voltage, disturbance=test.torque)
    expected = estimator.model_.predict(test.voltage, test.torque)
    np.testing.assert_array_equal(predicted, expected)
    disturbance = test.torque[:-1]
    with pytest.raises(BadRequest, match="the input has 300 samples"):
        estimator.score(test.voltage, test.speed, disturbance=disturbance)
