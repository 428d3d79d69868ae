"""Products of input and state: the system is found, by routes of their own, and what the model
cannot do is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models.bilinear import Bilinear, hat_functions
from ssm_study.models.bilinear_problem import BilinearProblem, equally_spaced_nodes
from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.models.spec import scale_records
from ssm_study.models.stored import model_from_json
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training.metrics import records_fit_percent

INPUT = Channel(name="u", unit="V")
OUTPUT = Channel(name="y", unit="m")
CHANNELS = (INPUT,), (OUTPUT,)


def known_model() -> Bilinear:
    """Two states and three nodes; at rest at zero, where `theta_2 = 1`."""
    decay = np.array([[0.6, 0.1], [0.0, 0.5]])
    change = np.array([[0.2, 0.0], [0.1, 0.1]])
    a = np.stack([decay - change, decay, decay + change])
    at_minus_one = [-0.3, 0.1]
    at_one = [0.5, 0.2]
    b = np.array([at_minus_one, [0.0, 0.0], at_one])
    c = np.array([[1.0, -0.5]])
    nodes = np.array([-1.0, 0.0, 1.0])
    scale = Scale.identity(1, 1)
    return Bilinear(nodes=nodes, a=a, b=b, c=c, scale=scale, step_s=0.1)


def levels(samples: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-1, 1, samples)
    repeated = np.repeat(drawn, 5)
    return repeated[:samples, None]


def record(samples: int, seed: int) -> Trajectory:
    u = levels(samples, seed)
    model = known_model()
    y = model.simulate(u)
    return Trajectory(u=u, y=y, step_s=0.1)


@pytest.fixture(scope="module")
def data() -> DataSet:
    long = record(240, 0)
    short = record(60, 1)
    training = (long, short)
    validation = (record(120, 2),)
    test = (record(120, 3),)
    parts = (training, validation, test)
    zero = np.zeros(1)
    rest = (zero, zero)
    return assemble_dataset(parts, rest, CHANNELS, 0)


@pytest.mark.parametrize("rate", [None, 0.98])
def test_the_system_is_found(data: DataSet, rate: float | None) -> None:
    spec = BilinearSpec(order=2, nodes=3, rate=rate, starts=2)
    model = spec.fit_model(data)
    test_fit = records_fit_percent(model, data.test, data)
    assert test_fit > 99.5
    if rate is not None:
        norms = [np.linalg.norm(a, 2) for a in model.a]
        assert max(norms) < rate


def test_a_linear_model_does_not_explain_it(data: DataSet) -> None:
    """Negative control: with one matrix for all inputs the products are missed."""
    records = scale_records(data)
    problem = BilinearProblem.from_records(records, 2, 3, None)
    rng = np.random.default_rng(0)
    parts = problem.initial_parameters(rng, 0.0)
    linear = problem.build_model(parts, data.scale, data.step_s)
    test_fit = records_fit_percent(linear, data.test, data)
    assert test_fit < 90


SYMMETRIC = [-1, -0.5, 0, 0.5, 1]
SHORT_BELOW = [-0.2, 0, 1 / 3, 2 / 3, 1]
FROM_ZERO = [0, 0.5, 1, 1.5, 2]
TO_ZERO = [-1, -0.75, -0.5, -0.25, 0]
NODES_BETWEEN_ENDS = [
    ((-1.0, 1.0), SYMMETRIC),
    ((-0.2, 1.0), SHORT_BELOW),
    ((0.5, 2.0), FROM_ZERO),
    ((-1.0, -1.0), TO_ZERO),
]


@pytest.mark.parametrize(("ends", "nodes"), NODES_BETWEEN_ENDS)
def test_the_nodes_hold_zero_and_both_ends(ends: tuple[float, float], nodes: list[float]) -> None:
    spread = equally_spaced_nodes(*ends, 5)
    np.testing.assert_allclose(spread, nodes, atol=1e-15)
    assert 0.0 in spread


def test_a_free_run_is_the_recursion_written_out() -> None:
    model = known_model()
    u = levels(30, 4)
    x0 = np.array([0.3, -0.2])
    x = x0
    expected = []
    for v in u[:, 0]:
        expected.append(model.c @ x)
        low = 0 if v < 0 else 1
        high = low + 1
        width = model.nodes[high] - model.nodes[low]
        share = (v - model.nodes[low]) / width
        at_low = model.a[low] @ x
        at_low += model.b[low]
        at_high = model.a[high] @ x
        at_high += model.b[high]
        x = at_low
        x += share * (at_high - at_low)
    actual = model.simulate(u, x0)
    np.testing.assert_allclose(actual, expected, atol=1e-12)
    both = np.stack([u, -u])
    batch = model.simulate(both)
    alone = model.simulate(-u)
    np.testing.assert_array_equal(batch[1], alone)


def test_the_hat_functions_add_up_to_one_beyond_the_ends_too() -> None:
    v = np.linspace(-3, 3, 41)
    nodes = known_model().nodes
    hats = hat_functions(nodes, v)
    assert hats.min() >= 0
    sums = hats.sum(axis=1)
    np.testing.assert_allclose(sums, 1.0, atol=1e-15)
    inside = np.abs(v) <= 1
    interpolated = hats @ nodes
    actual = interpolated[inside]
    expected = v[inside]
    np.testing.assert_allclose(actual, expected, atol=1e-15)


@pytest.mark.parametrize("rate", [None, 0.98])
def test_the_jacobian_is_that_of_finite_differences(data: DataSet, rate: float | None) -> None:
    records = scale_records(data)
    problem = BilinearProblem.from_records(records, 2, 3, rate)
    rng = np.random.default_rng(1)
    drawn = problem.initial_parameters(rng, 0.3)
    x0 = drawn.x0 + 0.1
    parts = drawn._replace(x0=x0)
    values = parts.flatten()
    residual, jacobian = problem.residual_and_jacobian(parts)
    expected = problem.residual(parts)
    np.testing.assert_array_equal(residual, expected)
    directions = np.eye(len(values))
    for column, unit in enumerate(directions):
        step = 1e-6 * unit
        forward = parts.with_values(values + step)
        ahead = problem.residual(forward)
        backward = parts.with_values(values - step)
        back = problem.residual(backward)
        expected = (ahead - back) / 2e-6
        actual = jacobian[:, column]
        np.testing.assert_allclose(actual, expected, atol=1e-7)


def test_the_initial_state_is_estimated_from_the_first_outputs() -> None:
    model = known_model()
    u = levels(60, 5)
    x0 = np.array([0.3, -0.2])
    y = model.simulate(u, x0)
    first_outputs = y[:20]
    from_outputs = model.simulate_from_outputs(u, first_outputs)
    from_rest = model.simulate(u)
    error = np.abs(from_outputs - y)
    assert error.max() < 0.02
    error = np.abs(from_rest - y)
    assert error.max() > 0.3
    without = model.simulate_from_outputs(u, y[:0])
    np.testing.assert_array_equal(without, from_rest)


def test_a_stored_model_is_read_back_or_refused() -> None:
    model = known_model()
    stored = model.to_json()
    text = json.dumps(stored)
    content = json.loads(text)
    again = model_from_json(content)
    u = levels(50, 6)
    actual = again.simulate(u)
    expected = model.simulate(u)
    np.testing.assert_array_equal(actual, expected)
    moved = [[0.3, 0.1], [0.1, 0.0], [0.5, 0.2]]
    drifts = content | {"b": moved}
    with pytest.raises(BadRequest, match="the model does not rest there"):
        model_from_json(drifts)
    twice = np.array([0.0, 0.0, 1.0])
    with pytest.raises(BadRequest, match="the nodes must ascend"):
        replace(model, nodes=twice)
    fewer = model.a[:2]
    with pytest.raises(BadRequest, match="the shapes of a and b must be"):
        replace(model, a=fewer)


REFUSED_SETTINGS = [
    ({"order": 0}, "model.order = 0"),
    ({"order": 9}, "at most 8 states"),
    ({"nodes": 2}, "which include the bilinear system"),
    ({"rate": 1.0}, r"must lie in \(0, 1\)"),
]


@pytest.mark.parametrize(("settings", "problem"), REFUSED_SETTINGS)
def test_settings_that_cannot_be_fitted_are_refused(settings: dict, problem: str) -> None:
    with pytest.raises(BadRequest, match=problem):
        BilinearSpec(**settings)


def test_several_inputs_and_short_records_are_refused(data: DataSet) -> None:
    spec = BilinearSpec()
    short = tuple(record[:30] for record in data.training)
    with pytest.raises(BadRequest, match="and 40 are needed"):
        spec.fit_model(replace(data, training=short))
    scale = Scale.identity(2, 1)
    twice = replace(data, scale=scale)
    with pytest.raises(BadRequest, match="takes one input, and there are 2"):
        spec.fit_model(twice)
