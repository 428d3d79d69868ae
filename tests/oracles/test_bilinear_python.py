"""From arrays to a loop that comes to rest, and what is refused on the way."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import assert_as_recorded
from test_models_bilinear import known_model, levels

import ssm_study as st
from ssm_study.refusal import BadRequest

SAMPLES = 400


@pytest.fixture(scope="module")
def model() -> st.Model:
    u = levels(SAMPLES, 7)
    plant = known_model()
    y = plant.simulate(u)
    return st.fit(u, y, 0.1, model="bilinear", starts=1, progress=False)


@pytest.fixture(scope="module")
def design(model: st.Model) -> st.RestDesign:
    return st.control(model, input_weight=0.5)


def test_the_fitted_loop_is_certified_and_says_only_that_it_comes_to_rest(
    model: st.Model, design: st.RestDesign
) -> None:
    u = levels(SAMPLES, 7)
    plant = known_model()
    y = plant.simulate(u)
    score = model.score(u, y)
    assert score > 95
    assert design.certified
    text = repr(design)
    assert "the loop comes to rest from every start" in text
    assert "contracts" not in text
    assert "Bilinear" in repr(model)


def test_a_saved_design_is_loaded_and_simulated(design: st.RestDesign, tmp_path: Path) -> None:
    folder = design.save(tmp_path / "saved")
    again = st.load(folder)
    assert isinstance(again, st.RestDesign)
    equilibrium = design.model.scale.output_equilibrium
    offsets = [[0.2], [-0.2]]
    deviation = np.array(offsets)
    starts = equilibrium + deviation
    expected = st.simulate(design, starts)
    actual = st.simulate(again, starts)
    np.testing.assert_array_equal(actual.y, expected.y)
    end = actual.time_s.max()
    is_last = actual.time_s == end
    last = actual.y[is_last]
    distances = (last - equilibrium[0]).abs()
    largest = distances.max()
    assert largest < 0.01


A_RATE = {"rate": 0.1}
A_METHOD = {"method": "riccati"}
LIMITS = {"input_limits": (-1, 1)}
NEGATIVE_WEIGHT = {"input_weight": -1.0}
UNKNOWN_WORD = {"weight": 1.0}
OF_NO_USE = [
    (A_RATE, "rate = 0.1: is for other models"),
    (A_METHOD, "method = riccati: is for other models"),
    (LIMITS, "is for other models"),
    (NEGATIVE_WEIGHT, "input_weight = -1.0: must be positive"),
    (UNKNOWN_WORD, "weight = weight: unknown; use input_weight or sensor_noise"),
]


@pytest.mark.parametrize(("arguments", "problem"), OF_NO_USE)
def test_a_request_that_it_has_no_use_for_is_refused(
    model: st.Model, arguments: dict[str, Any], problem: str
) -> None:
    with pytest.raises(BadRequest, match=problem):
        st.control(model, **arguments)


def test_it_is_no_linear_system(model: st.Model) -> None:
    with pytest.raises(BadRequest, match="has products of input and state"):
        model.to_control()
    with pytest.raises(BadRequest, match="has products of input and state"):
        model.eigenvalues()


def test_model_and_design_are_printed_as_recorded(model: st.Model, design: st.RestDesign) -> None:
    numbers = [design.certificates, repr(model), repr(design)]
    assert_as_recorded("bilinear_python", numbers, 1e-2)
