"""Numbers of a map that `verify` lists as reached by no record: they alone change no signal."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ssm_study.bounds.network import Network
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.study.unreached_numbers import cancelled_biases, unreached_ranges

BREAKPOINTS = np.array([[-2.0, -1.5, -0.6, 0.4, 0.7, 1.3, 2.2]])
SLOPES = np.array([[0.2, 0.9, 0.3, 0.8, 0.4, 0.7, 0.5, 1.0]])
MAP = MonotoneScaffold(breakpoints=BREAKPOINTS, slopes=SLOPES)


@pytest.mark.parametrize("ends", [(-1.0, 1.0), (-3.0, 3.0), (0.5, 0.6), (-1.6, -0.1)])
def test_a_number_is_listed_exactly_if_no_signal_changes_with_it(ends: tuple[float, float]) -> None:
    signal = np.linspace(*ends, 801)[:, None]
    listed = []
    for place in unreached_ranges("scaffold_in", MAP.breakpoints, signal):
        row, _, numbers = place.partition(": ")
        listed += [f"{row}.{number}" for number in numbers.split(", ")]
    without_effect = []
    for field in ("breakpoints", "slopes"):
        count = getattr(MAP, field).shape[1]
        for number in range(count):
            values = getattr(MAP, field).copy()
            values[0, number] += 1e-3
            changed_map = replace(MAP, **{field: values})
            if np.array_equal(changed_map(signal), MAP(signal)):
                without_effect.append(f"model.json scaffold_in.{field}.0.{number}")
    assert listed == without_effect


def test_a_bias_is_listed_exactly_if_no_signal_changes_with_it() -> None:
    """The network has two layers, linear neurons, and some that bend beyond the signal."""
    rng = np.random.default_rng(3)
    sizes = (1, 9, 8, 1)
    weights = tuple(rng.standard_normal((b, a)) for a, b in pairwise(sizes))
    slopes = tuple(rng.uniform(0.1, 1.0, size) for size in sizes[1:-1])
    upper = tuple(np.where(np.arange(len(row)) % 3 == 0, row, 1.0) for row in slopes)
    biases = tuple(2.0 * rng.standard_normal(size) for size in sizes[1:-1])
    network = Network(weights=weights, biases=biases, negative_slopes=slopes, positive_slopes=upper)
    even_points = np.linspace(-0.7, 0.4, 801)
    signal = even_points[:, None]
    listed = set()
    for place in cancelled_biases("scaffold_in", network, signal):
        row, _, numbers = place.partition(": ")
        listed |= {f"{row}.{number}" for number in numbers.split(", ")}
    without_effect = set()
    for layer, bias in enumerate(biases):
        for number in range(len(bias)):
            moved = [row.copy() for row in biases]
            moved[layer][number] += 1e-6
            other = replace(network, biases=tuple(moved))
            difference = np.abs(other(signal) - network(signal))
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
