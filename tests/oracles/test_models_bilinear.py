"""Products of input and state: the system is found, by routes of their own, and what the model
cannot do is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models.bilinear import Bilinear, hat_functions
from ssm_study.models.bilinear_problem import BilinearProblem, spread_nodes
from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.models.spec import scale_records
from ssm_study.models.stored import read_model_json
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training.metrics import records_fit_percent

CHANNELS = (Channel(name="u", unit="V"),), (Channel(name="y", unit="m"),)


def known_model() -> Bilinear:
    """Two states and three nodes; at rest at zero, where `theta_2 = 1`."""
    decay = np.array([[0.6, 0.1], [0.0, 0.5]])
    change = np.array([[0.2, 0.0], [0.1, 0.1]])
    b = np.array([[-0.3, 0.1], [0.0, 0.0], [0.5, 0.2]])
    return Bilinear(
        nodes=np.array([-1.0, 0.0, 1.0]),
        a=np.stack([decay - change, decay, decay + change]),
        b=b,
        c=np.array([[1.0, -0.5]]),
        scale=Scale.identity(1, 1),
        step_s=0.1,
    )


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
    training = (record(240, 0), record(60, 1))
    validation = (record(120, 2),)
    test = (record(120, 3),)
    parts = (training, validation, test)
    zero = np.zeros(1)
    rest = (zero, zero)
    return assemble_dataset(parts, rest, CHANNELS, 0)


@pytest.mark.parametrize("rate", [None, 0.98])
def test_the_system_is_found(data: DataSet, rate: float | None) -> None:
    spec = BilinearSpec(order=2, nodes=3, rate=rate, starts=2)
    model = spec.solve(data)
    assert records_fit_percent(model, data.test, data) > 99.5
    if rate is not None:
        assert max(np.linalg.norm(a, 2) for a in model.a) < rate


def test_a_linear_model_does_not_explain_it(data: DataSet) -> None:
    """Negative control: with one matrix for all inputs the products are missed."""
    problem = BilinearProblem.from_records(scale_records(data), 2, 3, None)
    parts = problem.initial_parameters(np.random.default_rng(0), 0.0)
    linear = problem.build_model(parts, data.scale, data.step_s)
    assert records_fit_percent(linear, data.test, data) < 90


@pytest.mark.parametrize(
    ("ends", "nodes"),
    [
        ((-1.0, 1.0), [-1, -0.5, 0, 0.5, 1]),
        ((-0.2, 1.0), [-0.2, 0, 1 / 3, 2 / 3, 1]),
        ((0.5, 2.0), [0, 0.5, 1, 1.5, 2]),
        ((-1.0, -1.0), [-1, -0.75, -0.5, -0.25, 0]),
    ],
)
def test_the_nodes_hold_zero_and_both_ends(ends: tuple[float, float], nodes: list[float]) -> None:
    np.testing.assert_allclose(spread_nodes(*ends, 5), nodes, atol=1e-15)
    assert 0.0 in spread_nodes(*ends, 5)


def test_a_free_run_is_the_recursion_written_out() -> None:
    model = known_model()
    u = levels(30, 4)
    x = np.array([0.3, -0.2])
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
    actual = model.simulate(u, np.array([0.3, -0.2]))
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
    expected = v[inside]
    np.testing.assert_allclose(interpolated[inside], expected, atol=1e-15)


@pytest.mark.parametrize("rate", [None, 0.98])
def test_the_jacobian_is_that_of_finite_differences(data: DataSet, rate: float | None) -> None:
    problem = BilinearProblem.from_records(scale_records(data), 2, 3, rate)
    parts = problem.initial_parameters(np.random.default_rng(1), 0.3)
    parts = parts._replace(x0=parts.x0 + 0.1)
    values = parts.flatten()
    residual, jacobian = problem.residual_and_jacobian(parts)
    np.testing.assert_array_equal(residual, problem.residual(parts))
    for column, unit in enumerate(np.eye(len(values))):
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
    y = model.simulate(u, np.array([0.3, -0.2]))
    from_outputs = model.simulate_from_outputs(u, y[:20])
    from_rest = model.simulate(u)
    error = from_outputs - y
    assert np.abs(error).max() < 0.02
    error = from_rest - y
    assert np.abs(error).max() > 0.3
    without = model.simulate_from_outputs(u, y[:0])
    np.testing.assert_array_equal(without, from_rest)


def test_a_stored_model_is_read_back_or_refused() -> None:
    model = known_model()
    text = json.dumps(model.to_json())
    content = json.loads(text)
    again = read_model_json(content)
    u = levels(50, 6)
    actual = again.simulate(u)
    expected = model.simulate(u)
    np.testing.assert_array_equal(actual, expected)
    moved = [[0.3, 0.1], [0.1, 0.0], [0.5, 0.2]]
    drifts = content | {"b": moved}
    with pytest.raises(BadRequest, match="the model does not rest there"):
        read_model_json(drifts)
    twice = np.array([0.0, 0.0, 1.0])
    with pytest.raises(BadRequest, match="the nodes must ascend"):
        replace(model, nodes=twice)
    fewer = model.a[:2]
    with pytest.raises(BadRequest, match="the shapes of a and b must be"):
        replace(model, a=fewer)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"order": 0}, "model.order = 0"),
        ({"order": 9}, "at most 8 states"),
        ({"nodes": 2}, "which include the bilinear system"),
        ({"rate": 1.0}, r"must lie in \(0, 1\)"),
    ],
)
def test_settings_that_cannot_be_fitted_are_refused(settings: dict, problem: str) -> None:
    with pytest.raises(BadRequest, match=problem):
        BilinearSpec(**settings)


def test_several_inputs_and_short_records_are_refused(data: DataSet) -> None:
    short = tuple(each[:30] for each in data.training)
    with pytest.raises(BadRequest, match="and 40 are needed"):
        BilinearSpec().solve(replace(data, training=short))
    scale = Scale.identity(2, 1)
    twice = replace(data, scale=scale)
    with pytest.raises(BadRequest, match="takes one input, and there are 2"):
        BilinearSpec().solve(twice)
