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
from ssm_study.models.stored import model_from_json
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
    matrices = {}
    for name, shape in shapes.items():
        matrices[name] = 0.3 * rng.normal(size=shape)
    scaffold_in = monotone(rng, m)
    scaffold_out = monotone(rng, p)
    input_scale = rng.uniform(0.5, 2, m)
    output_scale = rng.uniform(0.5, 2, p)
    input_equilibrium = rng.normal(size=m)
    output_equilibrium = rng.normal(size=p)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    scaled_a = 0.6 * a / norm
    return StructuredSSM(
        a=scaled_a,
        **matrices,
        neurons=kinds,
        scaffold_in=scaffold_in,
        scaffold_out=scaffold_out,
        scale=scale,
        step_s=0.01,
    )


SEEDS = st.integers(0, 2**31)
ORDERS = st.integers(1, 5)
WIDTHS = st.integers(1, 3)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, n=ORDERS, m=WIDTHS, p=WIDTHS)
def test_the_compiled_run_is_the_stepped_one(seed: int, n: int, m: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    neurons = rng.integers(0, 6)
    drawn_kinds = rng.choice(KINDS, size=neurons)
    kinds = tuple(drawn_kinds.tolist())
    model = drawn(seed, n, m, p, kinds)
    input_equilibrium = model.scale.input_equilibrium
    deviation = rng.normal(size=(2, 40, m))
    u = input_equilibrium + deviation
    x = rng.normal(size=(2, n))
    compiled = model.simulate(u, x)
    for k in range(40):
        input_now = u[:, k]
        ubar = model.map_input(input_now)
        actual = model.output_at(x, ubar)
        expected = compiled[:, k]
        np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=1e-12)
        x = model.next_state(x, ubar)


def test_rest_stays_at_rest_whatever_the_bias() -> None:
    model = drawn(0)
    input_equilibrium = model.scale.input_equilibrium
    samples = (20, 1)
    resting_input = np.tile(input_equilibrium, samples)
    y = model.simulate(resting_input)
    output_equilibrium = model.scale.output_equilibrium
    resting_output = np.tile(output_equilibrium, samples)
    assert np.array_equal(y, resting_output)


def test_a_stored_model_of_one_layer_is_the_case_without_neurons() -> None:
    rich = drawn(1, kinds=())
    names = ("scaffold_in", "scaffold_out", "scale")
    parts = {name: getattr(rich, name) for name in names}
    plain = SSM(linear=rich.linear, step_s=0.01, **parts)
    document = plain.to_json()
    same = StructuredSSM.from_json(document)
    rng = np.random.default_rng(1)
    u = rng.normal(size=(200, 2))
    assert same.neurons == ()
    actual = same.simulate(u)
    expected = plain.simulate(u)
    np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=1e-12)


KINDS_OF_NEURONS = [KINDS, ()]


@pytest.mark.parametrize("kinds", KINDS_OF_NEURONS)
def test_a_model_reads_back_to_the_same_bits(kinds: tuple[str, ...]) -> None:
    model = drawn(2, kinds=kinds)
    document = model.to_json()
    text = json.dumps(document)
    content = json.loads(text)
    back = model_from_json(content)
    rng = np.random.default_rng(2)
    u = rng.normal(size=(50, 2))
    assert isinstance(back, StructuredSSM)
    response = back.simulate(u)
    expected = model.simulate(u)
    assert np.array_equal(response, expected)


ONE_KIND = st.sampled_from(KINDS)
POINTS = st.floats(-50, 50)
GAPS = st.floats(1e-3, 5)


@given(kind=ONE_KIND, z=POINTS, gap=GAPS)
def test_secants_of_a_neuron_lie_in_the_unit_interval(kind: str, z: float, gap: float) -> None:
    far_point = [z + gap]
    points = np.array([[z], far_point])
    activations = evaluate_activations((kind,), points)
    low, high = activations[:, 0]
    upper_limit = (high - low) / gap
    assert -1e-12 <= upper_limit <= 1 + 1e-9
    at_low = np.array([z])
    slopes = evaluate_activations((kind,), at_low, "slope")
    slope = slopes[0]
    assert 0 <= slope <= 1
    code = KINDS.index(kind)
    actual = activation_and_slope(code, z)
    expected = (low, slope)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_is_the_derivative(kind: str) -> None:
    grid = np.linspace(-3, 3, 41)
    even = grid[:, None]
    z = even + 0.013
    above = evaluate_activations((kind,), z + 1e-6)
    below = evaluate_activations((kind,), z - 1e-6)
    difference = (above - below) / 2e-6
    actual = evaluate_activations((kind,), z, "slope")
    np.testing.assert_allclose(actual, difference, atol=1e-6)


WRONG_SHAPE = np.zeros((3, 4))
NOT_FINITE = np.full(5, np.nan)
UNKNOWN_NEURON = ("tanh", "tanh", "tanh", "tanh", "sine")
UNFIT = [
    ("e", WRONG_SHAPE, "of shape"),
    ("bias", NOT_FINITE, "finite"),
    ("neurons", UNKNOWN_NEURON, "unknown neuron"),
]


@pytest.mark.parametrize(("field", "value", "word"), UNFIT)
def test_what_does_not_fit_is_refused(field: str, value: object, word: str) -> None:
    with pytest.raises(BadRequest, match=word):
        replace(drawn(5), **{field: value})


DAMAGED = [("neurons", "tanh"), ("f", [[1.0]]), ("h", None)]


@pytest.mark.parametrize(("field", "value"), DAMAGED)
def test_a_damaged_document_is_refused(field: str, value: object) -> None:
    data = drawn(6).to_json()
    with pytest.raises(BadRequest):
        model_from_json(data | {field: value})
