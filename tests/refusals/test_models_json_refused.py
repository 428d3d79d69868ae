"""Stored models that were damaged are refused in one sentence that names the entry."""

import copy
from typing import Any

import numpy as np
import pytest

from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace


def stored() -> dict[str, Any]:
    a = np.eye(2) * 0.5
    b = np.ones((2, 1))
    c = np.ones((1, 2))
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    identity = LinearScaffold.identity(1)
    scale = Scale.identity(1, 1)
    scaffolds = {"scaffold_in": identity, "scaffold_out": identity}
    ssm = SSM(linear=linear, scale=scale, step_s=0.01, **scaffolds)
    return ssm.to_json()


@pytest.mark.parametrize("key", sorted(stored()))
def test_a_missing_entry_is_named(key: str) -> None:
    data = stored()
    del data[key]
    with pytest.raises(BadRequest, match=key):
        SSM.from_json(data)


MALFORMED_MATRICES = [("a", [[1.0, 2.0], [3.0]]), ("a", "evil"), ("b", [1.0])]
MALFORMED_NUMBERS = [("input_scale", [0.0]), ("output_scale", [float("nan")]), ("step_s", -0.1)]


@pytest.mark.parametrize(("key", "value"), [*MALFORMED_MATRICES, *MALFORMED_NUMBERS])
def test_a_malformed_entry_is_named(key: str, value: Any) -> None:
    data = stored()
    data[key] = value
    with pytest.raises(BadRequest, match=key):
        SSM.from_json(data)


def test_an_unknown_scaffolding_is_refused() -> None:
    with pytest.raises(BadRequest, match="kind = spline"):
        Scaffold.from_json({"kind": "spline"})


def test_a_scaffolding_that_does_not_fit_the_linear_part_is_refused() -> None:
    data = copy.deepcopy(stored())
    two_channels = np.eye(2)
    data["scaffold_in"]["gain"] = two_channels.tolist()
    with pytest.raises(BadRequest, match="scaffold_in"):
        SSM.from_json(data)


def test_a_monotone_scaffolding_with_crossed_break_points_is_refused() -> None:
    breakpoints = [[1.0, 0.0]]
    slopes = [[1.0, 1.0, 1.0]]
    pieces = {"breakpoints": breakpoints, "slopes": slopes}
    with pytest.raises(BadRequest, match="breakpoints"):
        Scaffold.from_json({"kind": "monotone", **pieces})


def test_a_residual_scaffolding_without_its_certificate_is_refused() -> None:
    weights = [[[1.0]], [[1.0]]]
    biases = [[0.0]]
    negative_slopes = [[0.0]]
    positive_slopes = [[1.0]]
    layer = {
        "weights": weights,
        "biases": biases,
        "negative_slopes": negative_slopes,
        "positive_slopes": positive_slopes,
    }
    multipliers = [[-1.0]]
    ball = {"alpha": 1.0, "beta": 0.5}
    stored_map = {"kind": "residual", "multipliers": multipliers, **ball, **layer}
    with pytest.raises(BadRequest, match="multipliers"):
        Scaffold.from_json(stored_map)
