"""Parts of an export that need no compiler: names, comments, rounding, equilibria and rates."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from export_cases import device
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.certificates.certificate import Design
from ssm_study.export.c import KEYWORDS, _count_constants, escape_comment, require_c_identifier
from ssm_study.export.device import DeviceController
from ssm_study.export.equilibrium_curve import PiecewiseLinear, evaluate_equilibrium_map
from ssm_study.export.portable import convert_floats, multiply_in_order
from ssm_study.export.set_point_text import describe_interpolation_error
from ssm_study.export.targets import (
    HALVINGS,
    UNLIMITED,
    _describe_limits,
    _describe_ranges,
    _provable_rate,
)
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

# Names and comments.


@pytest.mark.parametrize("name", ["", "9a", "a-b", "_a", "a b", *KEYWORDS.split()])
def test_what_is_no_name_in_c_is_refused(name: str) -> None:
    with pytest.raises(BadRequest, match="is no name in C"):
        require_c_identifier(name)


@pytest.mark.parametrize("name", ["a", "Motor_2", "floats", "x9"])
def test_a_name_in_c_is_taken(name: str) -> None:
    require_c_identifier(name)


COMMENTS = {
    "rad/s, 5 V": "rad/s, 5 V",
    "*/ int": "__ int",
    "a /b": "a _b",
    "a/ b": "a_ b",
    "what...": "what_",
    "two\nlines": "two_lines",
    "back\\slash": "back_slash",
}


def test_no_text_ends_its_comment_or_continues_it() -> None:
    escaped = {text: escape_comment(text) for text in COMMENTS}
    assert escaped == COMMENTS


def test_constants_are_counted_over_all_arrays() -> None:
    code = "static const double a_b[12] = {0};\nstatic const float c[3] = {1};\ndouble d[4];\n"
    assert _count_constants(code) == 15
    assert _count_constants("") == 0


# Products and rounding.


@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 99))
def test_a_product_in_order_is_the_product(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((rows, columns))
    vector = rng.standard_normal(columns)
    start = rng.standard_normal(rows)
    product = multiply_in_order(matrix, vector)
    np.testing.assert_allclose(product, matrix @ vector)
    added = multiply_in_order(matrix, vector, start)
    expected = start + matrix @ vector
    np.testing.assert_allclose(added, expected)


def test_a_product_in_order_rounds_from_left_to_right() -> None:
    row = np.array([[1e16, 1.0, -1e16]])
    ones = np.ones(3)
    actual = multiply_in_order(row, ones)[0]
    assert actual == 0.0
    single = multiply_in_order(row.astype(np.float32), ones.astype(np.float32))
    assert single.dtype == np.float32


def test_arrays_at_any_depth_are_rounded() -> None:
    table = PiecewiseLinear(points=np.ones(1), slopes=np.ones((2, 1)), offsets=np.ones((2, 1)))
    rounded = convert_floats((table, "word", 3), np.float32)
    expected = np.float32
    actual = rounded[0].slopes.dtype
    assert actual == expected
    expected = ("word", 3)
    assert rounded[1:] == expected


def test_missing_limits_are_the_largest_number(tmp_path: Path) -> None:
    known = device(tmp_path, kind="linear")
    endless = np.array([np.inf])
    for real, kind in (("double", np.float64), ("float", np.float32)):
        made = DeviceController.from_controller(known.controller, real, -endless, endless)
        largest = np.finfo(kind).max
        expected = [largest]
        values = made.upper.tolist()
        assert values == expected
        expected = [-largest]
        values = made.lower.tolist()
        assert values == expected
        assert made.upper.dtype == kind
        assert made.controller.a.dtype == kind
    with pytest.raises(BadRequest, match="real = half"):
        DeviceController.from_controller(known.controller, "half", -endless, endless)


# Equilibria.


@given(st.lists(st.integers(-30, 30), min_size=3, max_size=8, unique=True), st.integers(0, 9))
def test_lines_through_points_pass_through_them_and_go_on(places: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    arguments = np.array(places, dtype=float)
    values = rng.standard_normal((len(places), 2))
    lines = PiecewiseLinear.from_points(arguments, values)
    for argument, value in zip(arguments, values, strict=True):
        at = lines(np.array([argument]))
        np.testing.assert_allclose(at, value, atol=1e-9)
    order = np.argsort(arguments)
    first, second = order[:2]
    slope = (values[second] - values[first]) / (arguments[second] - arguments[first])
    beyond = lines(np.array([arguments[first] - 2.0]))
    expected = values[first] - 2.0 * slope
    np.testing.assert_allclose(beyond, expected, atol=1e-9)
    middle = (arguments[first] + arguments[second]) / 2
    between = lines(np.array([middle]))
    expected = values[[first, second]].mean(axis=0)
    np.testing.assert_allclose(between, expected, atol=1e-9)


def test_an_equilibrium_map_is_a_matrix_or_lines() -> None:
    matrix = np.array([[2.0], [3.0]])
    expected = [4.0, 6.0]
    values = evaluate_equilibrium_map(matrix, np.array([2.0])).tolist()
    assert values == expected
    lines = PiecewiseLinear.from_points(np.arange(3.0), np.arange(3.0)[:, None])
    expected = [1.5]
    values = evaluate_equilibrium_map(lines, np.array([1.5])).tolist()
    assert values == expected


@pytest.mark.parametrize("kind", ["linear", "monotone"])
@pytest.mark.parametrize("set_point", [-0.3, 0.0, 0.4])
def test_the_nearest_equilibrium_is_one_of_the_model(
    tmp_path: Path, kind: str, set_point: float
) -> None:
    made = device(tmp_path, kind=kind)
    scale = made.controller.scale
    wanted = scale.physical_output(np.array([set_point]))
    rest = made.nearest_equilibrium(wanted)
    u, state = made.compute_step(rest["x"], scale.physical_output(rest["w"]), wanted)
    expected = rest["x"]
    np.testing.assert_allclose(state, expected, atol=1e-9)
    expected = rest["v"]
    actual = scale.scaled_input(u)
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    is_free = np.all((u > made.lower) & (u < made.upper))
    if is_free:
        actual = rest["w"]
        np.testing.assert_allclose(actual, [set_point], atol=1e-9)
        expected = rest["x"]
        actual = made.equilibrium_state(wanted)
        np.testing.assert_allclose(actual, expected, atol=1e-9)


# Sentences.


def test_every_channel_has_its_range() -> None:
    channels = (Channel(name="u", unit="V"), Channel(name="v", unit=""))
    ends = np.array([-1.0, 0.5]), np.array([2.0, 1e6])
    lines = _describe_ranges("input", "limited to", channels, *ends)
    assert lines[0] == "input 0: u (V), limited to -1 to 2"
    assert lines[1].endswith(", limited to 0.5 to 1e+06")
    assert lines[1].startswith("input 1: v")


def device_of(**parts: Any) -> Any:
    """Device of these parts alone."""
    made: Any = object.__new__(DeviceController)
    vars(made).update(parts)
    return made


def test_without_limits_nothing_is_said_of_them() -> None:
    design: Any = object.__new__(Design)
    for lower, upper in ((-UNLIMITED, 1.0), (-1.0, UNLIMITED)):
        made = device_of(lower=np.array([lower]), upper=np.array([upper]))
        actual = _describe_limits(Path("run"), design, made)
        assert actual == ()


def device_missing(missed: float | None) -> Any:
    """Device whose set points are missed by so much; None without set points."""
    points = None if missed is None else SimpleNamespace(missed=missed)
    return device_of(set_point_maps=points)


def test_a_set_point_on_a_line_is_missed_by_what_is_told() -> None:
    actual = describe_interpolation_error(device_missing(None))
    assert actual == ()
    actual = describe_interpolation_error(device_missing(0.0))
    assert actual == ()
    (sentence,) = describe_interpolation_error(device_missing(0.00123))
    assert sentence.endswith("missed by at most 1.2e-03.")


# Rates.


class RateProof:
    """Theorem that holds up to a rate."""

    def __init__(self, largest: float) -> None:
        self.largest = largest
        self.variables = {"rate": np.float64(0.4)}
        self.tried: list[float] = []

    def required_ball(self, _: Any) -> SimpleNamespace:
        return SimpleNamespace(alpha=1.0, beta=0.0)

    def model_data(self, _: Any) -> dict[str, float]:
        return {"alpha": 9.0}

    def holds(self, **numbers: Any) -> bool:
        assert numbers["alpha"] == 1.0
        assert numbers["k"] == "rounded"
        self.tried.append(float(numbers["rate"]))
        return self.tried[-1] <= self.largest


@pytest.mark.parametrize("largest", [0.4, 0.39, 0.1, 0.0002])
def test_the_largest_rate_is_bisected_from_below(largest: float) -> None:
    proof: Any = RateProof(largest)
    function: Any = getattr(_provable_rate, "__wrapped__", _provable_rate)
    rate = function(proof, None, {"k": "rounded"})
    resolution = 0.4 / 2**HALVINGS
    assert rate <= largest
    assert largest - rate <= resolution
    expected = 1 if largest == 0.4 else 1 + HALVINGS
    count = len(proof.tried)
    assert count == expected
    hopeless: Any = RateProof(0.0)
    actual = function(hopeless, None, {"k": "rounded"})
    assert actual == 0.0
