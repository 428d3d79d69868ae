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
from ssm_study.models.warm_start import preceding_log, state_from_preceding_log
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.systems import StateSpace
from ssm_study.training.candidates import cross_validate_linear_model, fit_linear_model
from ssm_study.training.choice_of_paths import is_nearly_integrating
from ssm_study.training.folds import join_training_and_validation, make_folds

SLOW = 0.99
SAMPLES = 1200
UNIT = np.ones(1)
ZERO = np.zeros(1)
SCALE = Scale(
    input_scale=UNIT,
    output_scale=UNIT,
    input_equilibrium=ZERO,
    output_equilibrium=ZERO,
    disturbance_scale=np.array([2.0]),
    disturbance_equilibrium=np.array([3.0]),
)
X0 = np.array([2.0])


def slow_model() -> SSM:
    """A lag that a disturbance moves more than the input does."""
    a = np.array([[SLOW]])
    b = np.array([[0.01]])
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    system = StateSpace(a=a, b=b, c=c, d=d)
    identity = LinearScaffold.identity(1)
    b_d = np.array([[0.05]])
    scaffolds = {"scaffold_in": identity, "scaffold_out": identity}
    return SSM(linear=system, **scaffolds, scale=SCALE, step_s=0.1, b_d=b_d)


def log_of_slow_model() -> Trajectory:
    """The model's own answer to an input and a disturbance that step."""
    rng = np.random.default_rng(0)
    input_levels = rng.uniform(-1, 1, SAMPLES // 20)
    load_levels = rng.uniform(0, 6, SAMPLES // 40)
    u = input_levels.repeat(20)[:, None]
    d = load_levels.repeat(40)[:, None]
    y = slow_model().simulate(u, X0, d)
    return Trajectory(u=u, y=y, d=d, step_s=0.1, log=1)


def dataset() -> DataSet:
    """That log, cut in order of time."""
    log = log_of_slow_model()
    parts = split_by_time(log, 0.2, 0.2)
    load = np.full(1, 3.0)
    rest = (ZERO, ZERO, load)
    channels = []
    for name in ("u", "y", "d"):
        channel = Channel(name=name, unit="")
        channels.append((channel,))
    return assemble_dataset(parts, rest, tuple(channels), 20)


def test_the_past_of_a_piece_is_driven_by_its_disturbance() -> None:
    """The state at the test piece is that of the whole simulation, which owes nothing to it."""
    data = dataset()
    piece = data.test[0]
    whole = log_of_slow_model()
    start = whole.first
    end = piece.first
    u = whole.u[start:end]
    d = whole.d[start:end]
    model = slow_model()
    driving_signals = model.driving_signals(u, d)
    final_state = model.simulate_recurrence(driving_signals, X0)[1]
    state = state_from_preceding_log(model, data, piece)
    expected = final_state.reshape(-1)[-1]
    np.testing.assert_allclose(state, expected, rtol=1e-6)
    before = preceding_log(data, piece)
    np.testing.assert_array_equal(before.d, whole.d[:end])


def test_folds_have_the_disturbance_of_their_own_samples() -> None:
    data = dataset()
    whole = log_of_slow_model()
    (joined,) = join_training_and_validation(data).training
    expected = len(data.training[0]) + len(data.validation[0])
    assert len(joined) == expected
    assert len(joined.d) == expected
    for fold in make_folds(data):
        records = (*fold.training, *fold.test)
        for record in records:
            first = record.first
            last = first + len(record)
            np.testing.assert_array_equal(record.d, whole.d[first:last])


def leave_out_disturbance(data: DataSet) -> DataSet:
    """The same records without their disturbance."""
    parts = {}
    for name in ("training", "validation", "test"):
        records = getattr(data, name)
        parts[name] = tuple(replace(record, d=None) for record in records)
    no_disturbance = np.zeros(0)
    scale = replace(
        data.scale, disturbance_scale=no_disturbance, disturbance_equilibrium=no_disturbance
    )
    return replace(data, disturbances=(), scale=scale, **parts)


def test_linear_candidates_are_told_the_disturbance() -> None:
    """With it a first-order model is exact; with it left out most of the output is missed."""
    data = dataset()
    trial = cross_validate_linear_model(make_folds(data), 1, 1)
    assert trial.errors.max() < 1.0
    without = leave_out_disturbance(data)
    trial = cross_validate_linear_model(make_folds(without), 1, 1)
    mean = trial.errors.mean()
    assert mean > 30.0
    assert not is_nearly_integrating(data)


@pytest.mark.parametrize("direct", [False, True])
def test_a_linear_model_of_the_choice_has_a_path_for_the_disturbance(direct: bool) -> None:
    """The disturbance is no input of it, or it would be commanded."""
    data = dataset()
    model = fit_linear_model(data, 1, has_feedthrough=direct)
    assert model.linear.b.shape == (1, 1)
    assert model.linear.d.shape == (1, 1)
    whole = log_of_slow_model()
    response = model.simulate(whole.u, None, whole.d)
    error = whole.y - response
    response = model.simulate(whole.u)
    error_without = whole.y - response
    # The start is forgotten.
    norm = np.linalg.norm(error[400:])
    norm_without = np.linalg.norm(error_without[400:])
    upper_limit = 0.3 * norm_without
    assert norm < upper_limit
    late = model.with_dead_time(2)
    actual = late.b_d[:1]
    np.testing.assert_array_equal(actual, model.b_d)


@pytest.mark.parametrize("samples", [1, 3])
def test_neurons_and_a_load_behind_a_dead_time(samples: int) -> None:
    """The load acts at once, the input late: the delayed model is the model on a shifted input."""
    system = drawn(3, radius=0.8)
    rng = np.random.default_rng(0)
    # At rest at the equilibrium, as before the record.
    bias = np.zeros(system.neurons)
    neurons = ("tanh",) * system.neurons
    identity = LinearScaffold.identity(1)
    scaffolds = {"scaffold_in": identity, "scaffold_out": identity}
    b_d = rng.normal(size=(system.order, 1))
    model = StructuredSSM(
        **vars(system), **scaffolds, bias=bias, neurons=neurons, scale=SCALE, step_s=0.1, b_d=b_d
    )
    u = rng.normal(size=(60, 1))
    d = rng.normal(size=(60, 1))
    waiting = np.zeros((samples, 1))
    late = np.concatenate([waiting, u[:-samples]])
    late_model = model.with_dead_time(samples)
    delayed = late_model.simulate(u, d=d)
    expected = model.simulate(late, d=d)
    np.testing.assert_allclose(delayed, expected, atol=1e-10)


def test_the_estimator_is_told_the_load(tmp_path: Path) -> None:
    path = motor_log(tmp_path)
    log = pd.read_csv(path)
    train = log[:600]
    test = log[600:]
    overrides = ("model.hidden_width=4", "training.max_epochs=8")
    estimator = st.Estimator(step_s=STEP_S, model="ssm", order=2, overrides=overrides)
    estimator.fit(train.voltage, train.speed, disturbance=train.torque)
    load = test.torque
    fit = estimator.score(test.voltage, test.speed, disturbance=load)
    assert fit > 85.0
    fit_without = estimator.score(test.voltage, test.speed)
    assert fit_without < fit - 20.0
    predicted = estimator.predict(test.voltage, disturbance=load)
    expected = estimator.model_.predict(test.voltage, load)
    np.testing.assert_array_equal(predicted, expected)
    shorter = load[:-1]
    with pytest.raises(BadRequest, match="the input has 300 samples"):
        estimator.score(test.voltage, test.speed, disturbance=shorter)
