"""Numbers of a map that `verify` lists as reached by no record: they alone change no signal."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ssm_study.bounds.network import Network
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.study.unreached_numbers import (
    cancelled_biases,
    leaky_rectifier,
    unreached_range_texts,
)

ROW_OF_BREAKPOINTS = [-2.0, -1.5, -0.6, 0.4, 0.7, 1.3, 2.2]
BREAKPOINTS = np.array([ROW_OF_BREAKPOINTS])
ROW_OF_SLOPES = [0.2, 0.9, 0.3, 0.8, 0.4, 0.7, 0.5, 1.0]
SLOPES = np.array([ROW_OF_SLOPES])
MAP = MonotoneScaffold(breakpoints=BREAKPOINTS, slopes=SLOPES)


RANGES = [(-1.0, 1.0), (-3.0, 3.0), (0.5, 0.6), (-1.6, -0.1)]


@pytest.mark.parametrize("ends", RANGES)
def test_a_number_is_listed_exactly_if_no_signal_changes_with_it(ends: tuple[float, float]) -> None:
    even_points = np.linspace(*ends, 801)
    signal = even_points[:, None]
    listed = []
    places = unreached_range_texts("scaffold_in", MAP.breakpoints, signal)
    for place in places:
        row, _, numbers = place.partition(": ")
        numbers_of_row = numbers.split(", ")
        listed += [f"{row}.{number}" for number in numbers_of_row]
    without_effect = []
    for field in ("breakpoints", "slopes"):
        numbers_of_field = getattr(MAP, field)
        count = numbers_of_field.shape[1]
        for number in range(count):
            values = getattr(MAP, field).copy()
            values[0, number] += 1e-3
            changed_field = {field: values}
            changed_map = replace(MAP, **changed_field)
            is_unchanged = np.array_equal(changed_map(signal), MAP(signal))
            if is_unchanged:
                without_effect.append(f"model.json scaffold_in.{field}.0.{number}")
    assert listed == without_effect


def test_a_bias_is_listed_exactly_if_no_signal_changes_with_it() -> None:
    """The network has two layers, linear neurons, and some that bend beyond the signal."""
    rng = np.random.default_rng(3)
    sizes = (1, 9, 8, 1)
    weights = tuple(rng.standard_normal((b, a)) for a, b in pairwise(sizes))
    hidden = sizes[1:-1]
    slopes = tuple(rng.uniform(0.1, 1.0, size) for size in hidden)
    upper = []
    for row in slopes:
        is_linear = np.arange(len(row)) % 3 == 0
        upper.append(np.where(is_linear, row, 1.0))
    biases = tuple(2.0 * rng.standard_normal(size) for size in hidden)
    network = Network(
        weights=weights, biases=biases, negative_slopes=slopes, positive_slopes=tuple(upper)
    )
    even_points = np.linspace(-0.7, 0.4, 801)
    signal = even_points[:, None]
    listed = set()
    places = cancelled_biases("scaffold_in", network, signal)
    for place in places:
        row, _, numbers = place.partition(": ")
        numbers_of_row = numbers.split(", ")
        listed |= {f"{row}.{number}" for number in numbers_of_row}
    without_effect = set()
    for layer, bias in enumerate(biases):
        for number in range(len(bias)):
            moved = [row.copy() for row in biases]
            moved[layer][number] += 1e-6
            other = replace(network, biases=tuple(moved))
            change = other(signal) - network(signal)
            difference = np.abs(change)
            largest_difference = difference.max()
            if largest_difference < 1e-12:
                without_effect.add(f"model.json scaffold_in.biases.{layer}.{number}")
    assert listed == without_effect
    assert 4 < len(listed) < 17
    only_linear = cancelled_biases("scaffold_out", network, None)
    expected = [
        "model.json scaffold_out.biases.0: 0, 3, 6",
        "model.json scaffold_out.biases.1: 0, 3, 6",
    ]
    assert list(only_linear) == expected


def test_a_neuron_has_one_slope_below_zero_and_one_above() -> None:
    z = np.linspace(-2.0, 2.0, 9)[:, None]
    negative = np.array([0.3])
    positive = np.array([1.5])
    expected = negative * np.minimum(z, 0.0) + positive * np.maximum(z, 0.0)
    actual = leaky_rectifier(z, negative, positive)
    np.testing.assert_allclose(actual, expected, rtol=1e-15)
