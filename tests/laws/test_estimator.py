"""The estimator keeps scikit-learn's conventions, and its searches find the better model."""

import numpy as np
import pytest

import ssm_study as st

pytest.importorskip("sklearn", reason="scikit-learn is not installed (make test installs it)")
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
from sklearn.utils import get_tags

STEP_S = 0.1


def record(samples: int = 900) -> tuple[np.ndarray, np.ndarray]:
    """A resonant second-order lag, which one lag of its output cannot follow."""
    rng = np.random.default_rng(0)
    levels = rng.uniform(-3, 3, samples // 6)
    u = np.repeat(levels, 6)
    y = np.zeros(samples)
    for k in range(2, samples):
        last = 1.5 * y[k - 1]
        before = 0.8 * y[k - 2]
        driven = 0.3 * u[k - 1]
        y[k] = last - before + driven
    white_noise = rng.standard_normal(samples)
    return u, y + 0.01 * white_noise


def arx(**parameters) -> st.Estimator:
    return st.Estimator(step_s=STEP_S, model="arx", **parameters)


def test_a_clone_has_the_same_parameters_and_no_model() -> None:
    u, y = record()
    settings = {"lags": 2}
    estimator = arx(settings=settings)
    fitted = estimator.fit(u, y)
    copy = clone(fitted)
    params = copy.get_params()
    assert params == fitted.get_params()
    assert not hasattr(copy, "model_")
    assert get_tags(copy).estimator_type == "regressor"


def test_a_search_over_time_finds_the_lags_that_the_plant_has() -> None:
    u, y = record()
    numbers_of_lags = (1, 3)
    lags = [{"lags": n} for n in numbers_of_lags]
    choices = {"settings": lags}
    search = GridSearchCV(arx(), choices, cv=TimeSeriesSplit(2), error_score="raise")
    search.fit(u, y)
    expected = {"settings": lags[1]}
    assert search.best_params_ == expected
    scores = search.cv_results_["mean_test_score"]
    assert scores[1] > 95 > scores[0]
    expected = (len(u), 1)
    predicted = search.predict(u)
    assert predicted.shape == expected
    facts = search.best_estimator_.model_.result_columns
    fit_test_percent = facts["fit_test_percent"]
    assert fit_test_percent > 95


def test_what_a_search_found_is_controlled() -> None:
    """The example in the estimator's docstring, with short trainings."""
    u, y = record(600)
    quick = st.Estimator(step_s=STEP_S, model="linear", overrides=("training.max_epochs=3",))
    orders = [2, 3]
    choices = {"order": orders}
    search = GridSearchCV(quick, choices, cv=TimeSeriesSplit(2), error_score="raise")
    search.fit(u, y)
    model = search.best_estimator_.model_
    design = st.control(model, method="riccati", rate=0.05, observer_rate=0.1)
    assert isinstance(model, st.Model)
    assert design.certified


def test_a_stretch_that_begins_in_motion_is_scored_from_its_own_state() -> None:
    u, y = record()
    settings = {"lags": 3}
    estimator = arx(settings=settings)
    fitted = estimator.fit(u, y)
    sizes = np.abs(y[500:600])
    position_of_largest = int(np.argmax(sizes))
    start = 500 + position_of_largest  # far from rest
    stretch = slice(start, start + 60)
    from_rest = fitted.model_.score(u[stretch], y[stretch], start_up_samples=0)
    score = fitted.score(u[stretch], y[stretch])
    assert score > from_rest + 1


def test_model_comparison_and_estimator_score_a_stretch_alike() -> None:
    """One definition of the fit: that of the model's own test record."""
    u, y = record()
    settings = {"lags": 3}
    estimator = arx(settings=settings)
    fitted = estimator.fit(u, y)
    model = fitted.model_
    test = model.data.test[0]
    expected = fitted.score(test.u, test.y)
    expected_fit = pytest.approx(expected, abs=1e-9)
    assert model.result_columns["fit_test_percent"] == expected_fit
    score = model.score(test.u, test.y)
    assert score == expected
    comparison = st.compare([model], test.u, test.y)
    table = comparison.table
    fit_percent = table.fit_percent.item()
    expected_fit = pytest.approx(expected, abs=1e-9)
    assert fit_percent == expected_fit
    errors = model.simulation_errors(test.u, test.y)
    assert len(errors) == len(test.y)
    comparison_from_rest = st.compare([model], test.u, test.y, start_up_samples=0)
    table = comparison_from_rest.table
    from_rest = model.score(test.u, test.y, start_up_samples=0)
    fit_from_rest = table.fit_percent.item()
    expected_from_rest = pytest.approx(from_rest, abs=1e-9)
    assert fit_from_rest == expected_from_rest
    with pytest.raises(st.BadRequest, match=r"start_up_samples = -1: .*use 20, or 0"):
        model.score(u, y, start_up_samples=-1)


def test_wrong_use_is_refused_in_a_sentence() -> None:
    u, y = record()
    with pytest.raises(st.BadRequest, match="is no parameter; use one of step_s, model"):
        arx().set_params(oder=3)
    with pytest.raises(st.BadRequest, match=r"is not fitted; call fit\(u, y\) first"):
        arx().predict(u)
    fitted = arx().fit(u, y)
    with pytest.raises(st.BadRequest, match="none are left to score"):
        fitted.score(u[:20], y[:20])
    constant = np.ones(60)
    with pytest.raises(st.BadRequest, match="is constant"):
        fitted.score(u[:60], constant)
