"""Numbers of a map that `verify` lists as reached by no record: they alone change no signal."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.study.unreached_numbers import unreached_places

MAP = MonotoneScaffold(
    breakpoints=np.array([[-2.0, -1.5, -0.6, 0.4, 0.7, 1.3, 2.2]]),
    slopes=np.array([[0.2, 0.9, 0.3, 0.8, 0.4, 0.7, 0.5, 1.0]]),
)


@pytest.mark.parametrize("ends", [(-1.0, 1.0), (-3.0, 3.0), (0.5, 0.6), (-1.6, -0.1)])
def test_a_number_is_listed_exactly_if_no_signal_changes_with_it(ends: tuple[float, float]) -> None:
    signal = np.linspace(*ends, 801)[:, None]
    listed = []
    for place in unreached_places("scaffold_in", MAP.breakpoints, signal):
        row, _, numbers = place.partition(": ")
        listed += [f"{row}.{number}" for number in numbers.split(", ")]
    without_effect = []
    for field in ("breakpoints", "slopes"):
        for number in range(getattr(MAP, field).shape[1]):
            values = getattr(MAP, field).copy()
            values[0, number] += 1e-3
            if np.array_equal(replace(MAP, **{field: values})(signal), MAP(signal)):
                without_effect.append(f"model.json scaffold_in.{field}.0.{number}")
    assert listed == without_effect
