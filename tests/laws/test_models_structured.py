"""The structured model: compiled equals stepped, one layer is its case without neurons, slopes lie
in [0, 1]."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.stored import read_model_json
from ssm_study.models.structured import NEURONS, StructuredSSM, evaluate_activations
from ssm_study.models.structured_kernel import activation_and_slope
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale

KINDS = tuple(NEURONS)


def monotone(rng: np.random.Generator, channels: int) -> MonotoneScaffold:
    drawn_points = rng.normal(size=(channels, 5))
    points = np.sort(drawn_points, axis=1)
    slopes = rng.uniform(0.2, 1.5, (channels, 6))
    return MonotoneScaffold(breakpoints=points, slopes=slopes)


def drawn(
    seed: int, n: int = 3, m: int = 2, p: int = 2, kinds: tuple[str, ...] = KINDS
) -> StructuredSSM:
    rng = np.random.default_rng(seed)
    q = len(kinds)
    b = (n, m)
    c = (p, n)
    d = (p, m)
    e = (n, q)
    f = (q, n)
    g = (q, m)
    h = (p, q)
    shapes = {"b": b, "c": c, "d": d, "e": e, "f": f, "g": g, "h": h, "bias": (q,)}
    a = rng.normal(size=(n, n))
    norm = np.linalg.norm(a, 2)
    matrices = {name: 0.3 * rng.normal(size=shape) for name, shape in shapes.items()}
    scaffold_in = monotone(rng, m)
    scaffold_out = monotone(rng, p)
    scale = Scale(
        input_scale=rng.uniform(0.5, 2, m),
        output_scale=rng.uniform(0.5, 2, p),
        input_equilibrium=rng.normal(size=m),
        output_equilibrium=rng.normal(size=p),
    )
    return StructuredSSM(
        a=0.6 * a / norm,
        **matrices,
        neurons=kinds,
        scaffold_in=scaffold_in,
        scaffold_out=scaffold_out,
        scale=scale,
        step_s=0.01,
    )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 5), m=st.integers(1, 3), p=st.integers(1, 3))
def test_the_compiled_run_is_the_stepped_one(seed: int, n: int, m: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = tuple(rng.choice(KINDS, size=rng.integers(0, 6)).tolist())
    model = drawn(seed, n, m, p, kinds)
    input_equilibrium = model.scale.input_equilibrium
    deviation = rng.normal(size=(2, 40, m))
    u = input_equilibrium + deviation
    x = rng.normal(size=(2, n))
    compiled = model.simulate(u, x)
    for k in range(40):
        ubar = model.map_input(u[:, k])
        actual = model.output_at(x, ubar)
        expected = compiled[:, k]
        np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=1e-12)
        x = model.advance(x, ubar)


def test_rest_stays_at_rest_whatever_the_bias() -> None:
    model = drawn(0)
    input_equilibrium = model.scale.input_equilibrium
    resting_input = np.tile(input_equilibrium, (20, 1))
    y = model.simulate(resting_input)
    output_equilibrium = model.scale.output_equilibrium
    resting_output = np.tile(output_equilibrium, (20, 1))
    assert np.array_equal(y, resting_output)


def test_a_stored_model_of_one_layer_is_the_case_without_neurons() -> None:
    rich = drawn(1, kinds=())
    names = ("scaffold_in", "scaffold_out", "scale")
    parts = {name: getattr(rich, name) for name in names}
    plain = SSM(linear=rich.linear, step_s=0.01, **parts)
    same = StructuredSSM.from_json(plain.to_json())
    rng = np.random.default_rng(1)
    u = rng.normal(size=(200, 2))
    assert same.neurons == ()
    actual = same.simulate(u)
    expected = plain.simulate(u)
    np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("kinds", [KINDS, ()])
def test_a_model_reads_back_to_the_same_bits(kinds: tuple[str, ...]) -> None:
    model = drawn(2, kinds=kinds)
    text = json.dumps(model.to_json())
    content = json.loads(text)
    back = read_model_json(content)
    rng = np.random.default_rng(2)
    u = rng.normal(size=(50, 2))
    assert isinstance(back, StructuredSSM)
    response = back.simulate(u)
    assert np.array_equal(response, model.simulate(u))


@given(kind=st.sampled_from(KINDS), z=st.floats(-50, 50), gap=st.floats(1e-3, 5))
def test_secants_of_a_neuron_lie_in_the_unit_interval(kind: str, z: float, gap: float) -> None:
    points = np.array([[z], [z + gap]])
    low, high = evaluate_activations((kind,), points)[:, 0]
    upper_limit = (high - low) / gap
    assert -1e-12 <= upper_limit <= 1 + 1e-9
    at_low = np.array([z])
    slope = evaluate_activations((kind,), at_low, "slope")[0]
    assert 0 <= slope <= 1
    code = KINDS.index(kind)
    actual = activation_and_slope(code, z)
    expected = (low, slope)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_is_the_derivative(kind: str) -> None:
    even = np.linspace(-3, 3, 41)[:, None]
    z = even + 0.013
    above = evaluate_activations((kind,), z + 1e-6)
    below = evaluate_activations((kind,), z - 1e-6)
    difference = (above - below) / 2e-6
    actual = evaluate_activations((kind,), z, "slope")
    np.testing.assert_allclose(actual, difference, atol=1e-6)


UNFIT = [
    ("e", np.zeros((3, 4)), "of shape"),
    ("bias", np.full(5, np.nan), "finite"),
    ("neurons", ("tanh",) * 4 + ("sine",), "unknown neuron"),
]


@pytest.mark.parametrize(("field", "value", "word"), UNFIT)
def test_what_does_not_fit_is_refused(field: str, value: object, word: str) -> None:
    with pytest.raises(BadRequest, match=word):
        replace(drawn(5), **{field: value})


@pytest.mark.parametrize(("field", "value"), [("neurons", "tanh"), ("f", [[1.0]]), ("h", None)])
def test_a_damaged_document_is_refused(field: str, value: object) -> None:
    data = drawn(6).to_json()
    with pytest.raises(BadRequest):
        read_model_json(data | {field: value})
