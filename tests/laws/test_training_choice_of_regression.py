"""A regression is a candidate where it leads output error, and is preferred where a load
dominates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.baselines.regression import fit_arx
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training import choice
from ssm_study.training.candidates import LINEAR, REGRESSION, Candidate, best_candidate
from ssm_study.training.choice_of_regression import (
    LAGS,
    add_clearly_better_regression,
    choose_regression,
    score_regressions,
)
from ssm_study.training.choice_of_size import simplest_certifiable_candidate
from ssm_study.training.folds import make_folds
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.search import SettingsSearch
from ssm_study.training.training import Training, TrainingSession

AUTO = {"order": "auto", "neurons": "auto", "knots": "auto"}
SPEC = StructuredSpec(**AUTO, input_path="none", among_starts=None)
TRAINING = Training(
    optimiser=Lbfgs(steps_per_epoch=10, history=20),
    max_epochs=1,
    patience=1,
    min_gain_percent=0.0,
    validation_tolerance_percent=0.0,
)


def add_load(record: Trajectory, rng: np.random.Generator) -> Trajectory:
    """The record with a slow load on its output."""
    samples = len(record)
    heights = rng.normal(size=1 + samples // 100)
    levels = np.repeat(heights, 100)[:samples]
    load = record.y.std() / 3.0 * levels
    y = record.y + load[:, None]
    return replace(record, y=y)


@pytest.fixture(scope="module")
def loaded() -> DataSet:
    """Records to whose output a slow load adds a third of its deviation."""
    data = data_set(noise=0.01, samples=500, records=4)
    rng = np.random.default_rng(2)
    parts = {}
    for part in ("training", "validation", "test"):
        records = getattr(data, part)
        parts[part] = tuple(add_load(record, rng) for record in records)
    return replace(data, **parts)


def search_in(data: DataSet, spec: StructuredSpec = SPEC) -> SettingsSearch:
    folds = make_folds(data)
    return SettingsSearch(spec=spec, folds=folds, seed=0, announce=lambda _: None)


def candidate(training_error: float, *errors: float, model: str = "structured") -> Candidate:
    kind = {"question": "size", "model": model, "settings": {}}
    error_array = np.array(errors)
    return Candidate(errors=error_array, training_error=training_error, **kind)


UNEXPLAINED = (30.0, 60.0, 60.0, 60.0, 60.0)


def choose_in(search: SettingsSearch, *candidates: Candidate) -> Candidate | None:
    """Regression that is preferred to some candidates, of those that the search scores."""
    regressions = score_regressions(search)
    return choose_regression(search, candidates, regressions)


def test_records_that_are_explained_prefer_no_regression(loaded: DataSet) -> None:
    search = search_in(loaded)
    explains = candidate(19.0, 60.0, 60.0, 60.0, 60.0)
    follows_by_chance = candidate(25.0, 70.0, 70.0, 70.0, 70.0)
    assert choose_in(search, explains, follows_by_chance) is None


def test_what_others_explain_by_chance_hides_no_load(loaded: DataSet) -> None:
    search = search_in(loaded)
    predicts_best = candidate(27.0, 60.0, 60.0, 60.0, 60.0)
    explains_more = candidate(9.0, 62.0, 58.0, 64.0, 60.0)
    tried = choose_in(search, explains_more, predicts_best)
    assert tried is not None
    assert tried.model == REGRESSION


def test_a_regression_is_taken_where_folds_cannot_tell(loaded: DataSet, tmp_path: Path) -> None:
    search = search_in(loaded)
    unexplained = candidate(*UNEXPLAINED)
    tried = choose_in(search, unexplained)
    assert tried is not None
    assert tried.model == REGRESSION
    assert len(search.tried) == len(LAGS)
    order = tried.settings["order"]
    smaller = [other for other in search.tried if other.settings["order"] < order]
    best = min(search.tried, key=lambda other: other.mean_error_percent)
    assert all(other.is_clearly_worse(best) for other in smaller)
    chosen = search.build_settings_choice(tried)
    assert chosen.linear_kind == REGRESSION
    session = TrainingSession(seed=0, folder=tmp_path)
    identified = TRAINING._train_chosen_model(chosen, loaded, session)
    lags = int(chosen.spec.order)
    expected = fit_arx(loaded, lags, 1)
    u = loaded.test[0].u
    no_input = 0.0 * u
    model = identified.model
    actual = model.simulate(u) - model.simulate(no_input)
    reference = expected.simulate(u) - expected.simulate(no_input)
    atol = 1e-8 * np.ptp(reference)
    np.testing.assert_allclose(actual, reference, atol=atol)


def test_the_regression_is_the_first_choice_and_the_candidates_follow(
    loaded: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    unexplained = candidate(*UNEXPLAINED)
    settings = {"order": 2, "neurons": 1}
    other = replace(unexplained, settings=settings)
    monkeypatch.setattr(choice, "try_model_sizes", lambda *_, **__: [other])
    monkeypatch.setattr(choice, "choose_bilinear_model", lambda *_: None)
    choices = choice.iterate_model_choices(SPEC, loaded, 0, lambda _: None)
    first, second = choices
    assert first.linear_kind == REGRESSION
    assert second.linear_kind is None
    assert second.spec.order == 2
    assert second.spec.neurons == 1


def test_folds_that_agree_refuse_a_regression(loaded: DataSet) -> None:
    search = search_in(loaded)
    explained = candidate(20.0, 1.0, 1.0, 1.0, 1.0)
    assert choose_in(search, explained) is None
    assert search.tried


def test_a_size_that_is_fixed_stays_fixed(loaded: DataSet) -> None:
    fixed = replace(SPEC, neurons=2)
    search = search_in(loaded, fixed)
    unexplained = candidate(*UNEXPLAINED)
    assert score_regressions(search) == []
    assert choose_in(search, unexplained) is None


def test_two_standard_errors_are_chance() -> None:
    best = candidate(30.0, 40.0, 40.0, 40.0, 40.0)
    scattered = candidate(30.0, 60.0, 30.0, 50.0, 40.0)
    behind = candidate(30.0, 50.0, 46.0, 50.0, 48.0)
    assert not scattered.is_worse_beyond_chance(best)
    assert behind.is_worse_beyond_chance(best)
    of_two_folds = candidate(30.0, 1.0, 1.0)
    assert of_two_folds.is_worse_beyond_chance(best)


def test_the_chosen_model_is_what_a_regression_is_compared_with(loaded: DataSet) -> None:
    """The model that leads by its mean is not the chosen one, since the folds cannot tell it from a
    simpler one. A regression that is behind the first, but not behind the second, is taken."""
    search = search_in(loaded)
    lags_of_15 = candidate(52.0, 41.0, 52.0, 64.0, 52.0, model=REGRESSION)
    leads = candidate(29.0, 30.0, 47.0, 63.0, 39.0)
    simpler = candidate(49.0, 44.0, 49.0, 50.0, 52.0)
    chosen = simplest_certifiable_candidate(search, [simpler, leads])
    assert chosen is simpler
    assert lags_of_15.is_worse_beyond_chance(leads)
    assert choose_regression(search, [simpler, leads], [lags_of_15]) is lags_of_15
    assert choose_regression(search, [leads], [lags_of_15]) is None


def output_error(*errors: float) -> Candidate:
    return candidate(10.0, *errors, model=LINEAR)


def regression(*errors: float) -> Candidate:
    return candidate(10.0, *errors, model=REGRESSION)


NEURONS = candidate(9.0, 28.0, 30.0, 32.0, 30.0)


def test_a_regression_ahead_of_output_error_is_a_candidate_and_taken(loaded: DataSet) -> None:
    """Output error follows the training records, and misses three held-out pieces by far; neurons
    predict no better than the regression, which is simpler."""
    search = search_in(loaded)
    misses = output_error(60.0, 75.0, 80.0, 40.0)
    leads = regression(30.0, 31.0, 30.0, 30.0)
    candidates = add_clearly_better_regression([misses, NEURONS], [leads])
    assert candidates == [misses, leads, NEURONS]
    chosen = simplest_certifiable_candidate(search, candidates)
    assert chosen is leads


def test_a_regression_no_better_than_output_error_is_no_candidate() -> None:
    predicts = output_error(31.0, 31.0, 31.0, 31.0)
    as_well = regression(30.0, 30.0, 31.0, 30.0)
    candidates = add_clearly_better_regression([predicts, NEURONS], [as_well])
    assert candidates == [predicts, NEURONS]
    assert add_clearly_better_regression([predicts, NEURONS], []) == candidates


def test_a_regression_behind_neurons_is_not_taken(loaded: DataSet) -> None:
    search = search_in(loaded)
    misses = output_error(60.0, 75.0, 80.0, 40.0)
    behind = regression(40.0, 42.0, 40.0, 38.0)
    candidates = add_clearly_better_regression([misses, NEURONS], [behind])
    assert behind in candidates
    chosen = simplest_certifiable_candidate(search, candidates)
    assert chosen is NEURONS


def test_the_choice_is_not_behind_a_regression_on_the_folds(loaded: DataSet) -> None:
    """The model that is taken is at most a twentieth of its error behind the best regression."""
    search = search_in(loaded)
    regressions = score_regressions(search)
    best = best_candidate(regressions)
    misses = output_error(*(best.errors + 10.0))
    neurons_miss = candidate(10.0, *(best.errors + 5.0))
    candidates = add_clearly_better_regression([misses, neurons_miss], regressions)
    chosen = simplest_certifiable_candidate(search, candidates)
    assert chosen.mean_error_percent <= 1.05 * best.mean_error_percent
