"""Models that folds chose are trained on all records but the tests, from the best of many starts.

Size alone is no reason where a candidate explains less."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.structured_spec import AUTO, StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training import choice_of_size
from ssm_study.training.candidates import Candidate, simplest_good_candidate
from ssm_study.training.choice_of_size import (
    candidates_without_neurons_or_integrator,
    decide_on_integrator,
    far_better_noncontracting,
    models_of_other_structure,
    simplest_certifiable_candidate,
    train_finalists,
    try_models_with_integrator,
    try_noncontracting_models,
    try_sizes_without_neurons,
)
from ssm_study.training.folds import make_folds
from ssm_study.training.metrics import Identification
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.saving import train_with_lightning
from ssm_study.training.search import STRUCTURED, SettingsChoice, SettingsSearch
from ssm_study.training.short_starts import STEPS, best_starts, training_fit_as_text
from ssm_study.training.structured_fit import StructuredFit
from ssm_study.training.training import Training, TrainingSession

BRIEF = {"starts": 1, "draws": 1, "start_steps": (5, 3, 3)}
FIXED = {"order": 2, "neurons": 1, "knots": 0, "input_path": "none"}


def training(max_epochs: int) -> Training:
    """A training of a few epochs."""
    return Training(
        optimiser=Lbfgs(steps_per_epoch=10, history=20),
        max_epochs=max_epochs,
        patience=12,
        min_gain_percent=0.0,
        validation_tolerance_percent=0.0,
    )


def quiet(words: str) -> None:
    """Print nothing."""
    del words


def candidate(name: str, *errors: float) -> Candidate:
    """A candidate of these errors on folds."""
    return Candidate(question="size", model=name, settings={}, errors=np.array(errors))


def test_what_explains_its_own_records_far_worse_is_not_taken_for_its_size() -> None:
    """Four folds seldom tell two models apart; the training records do, where they are many."""
    small = candidate("small", 9.7, 26.2, 17.4, 28.9)
    large = candidate("large", 15.0, 21.2, 17.2, 12.2)
    assert not small.is_clearly_worse(large)
    assert simplest_good_candidate([small, large]) is small
    worse = replace(small, training_error=20.0)
    better = replace(large, training_error=10.0)
    assert simplest_good_candidate([worse, better]) is better
    assert simplest_good_candidate([better, worse]) is better


def test_what_explains_more_of_an_unmeasured_load_is_not_taken_for_that() -> None:
    """Both leave a fifth or more unexplained: the smaller model is as good."""
    small = replace(candidate("small", 51.0, 52.0, 50.0, 51.0), training_error=45.0)
    large = replace(candidate("large", 50.0, 51.0, 50.0, 51.0), training_error=20.0)
    assert simplest_good_candidate([small, large]) is small
    assert simplest_good_candidate([small, replace(large, training_error=10.0)]) is not small


def test_the_training_records_decide_where_the_folds_contradict_each_other() -> None:
    """Without one quarter the large model fails there, on others it is twice as good."""
    small = replace(candidate("small", 17.7, 40.2, 14.4, 22.0), training_error=18.6)
    large = replace(candidate("large", 7.0, 73.0, 25.3, 11.8), training_error=8.3)
    failing = replace(large, errors=np.array([6.9, 100.0, 25.6, 11.8]))
    assert large.is_undecided_by_folds(small)
    assert simplest_good_candidate([small, large]) is large
    assert simplest_good_candidate([small, failing]) is failing
    assert simplest_good_candidate([small, replace(failing, training_error=16.0)]) is small
    assert simplest_good_candidate([small, replace(large, training_error=16.0)]) is small
    agreed = replace(large, errors=small.errors + 0.5)
    assert not agreed.is_undecided_by_folds(small)
    assert simplest_good_candidate([small, agreed]) is small


def test_members_are_of_the_structures_that_folds_cannot_tell_apart(tmp_path: Path) -> None:
    """One training of the chosen structure, and one of each other that is about as good."""
    spec = StructuredSpec(**FIXED | BRIEF | {"order": AUTO, "members": 3})  # type: ignore[arg-type]
    data = data_set(noise=0.02, samples=250, records=4)
    other = replace(spec, order=1)
    choice = SettingsChoice(spec=replace(spec, order=2), others=(other,))
    session = TrainingSession(seed=0, folder=tmp_path)
    orders = [member.order for member in train_choice(choice, data, session).members]
    assert orders == [2, 2, 1]
    alone = replace(choice, spec=replace(choice.spec, members=1))
    actual = train_choice(alone, data, session).members
    assert actual == ()


def train_choice(choice: SettingsChoice, data: DataSet, session: TrainingSession) -> Identification:
    """Train a choice for one epoch."""
    return training(max_epochs=1)._train_chosen_model(choice, data, session)


def test_other_structures_contract_and_are_about_as_good() -> None:
    chosen = replace(candidate("structured", 10.0, 10.0, 10.0, 10.0), fits=(1,))
    near = replace(chosen, errors=np.array([9.9, 10.0, 10.0, 9.9]), settings={"rate": 0.999})
    behind = replace(chosen, errors=np.array([12.0, 12.0, 12.0, 12.0]))
    free = replace(near, settings={"rate": None})
    integrating = replace(near, settings={"rate": 0.999, "integrating_output": True})
    linear = replace(near, fits=())
    candidates = [chosen, near, behind, free, integrating, linear]
    expected = [near]
    actual = models_of_other_structure(candidates, chosen)
    assert actual == expected


def test_what_fails_on_a_fold_is_not_taken_for_its_size() -> None:
    """One failed fold makes the standard error so large that the mean says nothing."""
    small = candidate("small", 40.0, 40.0, 45.0, 100.0)
    large = candidate("large", 47.0, 48.0, 49.0, 60.0)
    assert not small.is_clearly_worse(large)
    assert simplest_good_candidate([small, large]) is large
    assert simplest_good_candidate([small, candidate("large", 38.0, 38.0, 43.0, 100.0)]) is small


def test_what_folds_chose_is_trained_on_training_and_validation_records(tmp_path: Path) -> None:
    spec = StructuredSpec(**FIXED | BRIEF | {"feedthrough": AUTO})  # type: ignore[arg-type]
    data = data_set(noise=0.02, samples=250, records=4)
    moved = replace(data, validation=(replace(data.validation[0], y=-data.validation[0].y),))
    both = training(max_epochs=3).identify(spec, moved, 0, tmp_path / "both")
    assert both.refitted
    assert "trained on the training and validation records" in both.ended
    without = replace(spec, refit=False)
    one_part = training(max_epochs=3).identify(without, moved, 0, tmp_path / "training")
    assert not one_part.refitted
    assert one_part.fit_validation_percent < both.fit_validation_percent


def test_the_best_of_short_starts_goes_on_and_certified_ones_come_first() -> None:
    data = data_set(noise=0.02, samples=300, records=2)
    spec = StructuredSpec(**FIXED | BRIEF)  # type: ignore[arg-type]
    lines: list[str] = []
    kept = best_starts(spec, data, 7, 3, kept_count=3, print_line=lines.append)
    seeds = [*kept]
    expected = ["1 of 3", "2 of 3", "3 of 3"]
    actual = [line.split(",")[0] for line in lines]
    assert actual == expected
    assert all("fit to the training records" in line for line in lines)
    assert training_fit_as_text(float("inf")) == "the simulation diverges"
    losses = []
    for seed in seeds:
        fit = StructuredFit(spec, data, seed)
        fit.start_training(STEPS)
        losses.append(float(fit.loss))
    assert losses == sorted(losses)
    expected = [7, 1007, 2007]
    assert sorted(seeds) == expected

    class OnlyTheLast:
        """A choice among starts by which the model of one start alone can be certified."""

        def __call__(self, identified: object) -> None:
            """Choose none: nobody asks."""

        def has_certificates(self, model: object) -> bool:
            return np.array_equal(model.a, last.a)  # type: ignore[attr-defined]

    fit = StructuredFit(spec, data, seeds[-1])
    fit.start_training(STEPS)
    last = fit.as_model()
    asked = replace(spec, among_starts=OnlyTheLast())
    expected = [seeds[-1], seeds[0]]
    certified_first = best_starts(asked, data, 7, 3, kept_count=2)
    assert [*certified_first] == expected


@pytest.mark.parametrize("integrates", [False, True])
def test_a_run_that_goes_on_begins_where_its_short_run_did(
    integrates: bool, tmp_path: Path
) -> None:
    """The parameters are not computed again, and every number stays the same."""
    data = data_set(noise=0.02, samples=300, records=2)
    spec = StructuredSpec(**FIXED | BRIEF, integrating_output=integrates, gain_share=0.05)  # type: ignore[arg-type]
    kept = best_starts(spec, data, 7, 2, kept_count=1)
    seed, *_ = kept
    brief = training(max_epochs=3)
    folder = tmp_path / "anew"
    session = TrainingSession(seed=seed, folder=folder)
    anew = train_with_lightning(brief, spec, data, session)
    folder = tmp_path / "prepared"
    session = TrainingSession(seed=seed, folder=folder, initial_parameters=kept)
    prepared = train_with_lightning(brief, spec, data, session)
    assert anew.fit_validation_percent == prepared.fit_validation_percent
    u = data.test[0].u
    expected = anew.model.simulate(u)
    actual = prepared.model.simulate(u)
    np.testing.assert_array_equal(actual, expected)


def test_a_model_that_need_not_contract_has_to_gain_a_quarter() -> None:
    contracting = [candidate("one layer", 10.0, 10.0, 11.0, 10.0), candidate("neurons", 9.0, 9.0)]
    spec = StructuredSpec(order=AUTO, neurons=5, knots=0, rate=AUTO)
    search = SettingsSearch(spec=spec, folds=(), seed=0, announce=quiet)
    for order, error in ((2, 7.0), (3, 9.0)):
        free = candidate("structured", *[error] * 4)
        search.tried.append(replace(free, settings={"order": order, "rate": None}))
    taken = far_better_noncontracting(try_noncontracting_models(search), contracting)
    expected = [2]
    actual = [one.settings["order"] for one in taken]
    assert actual == expected
    search.decided["integrating_output"] = True
    assert try_noncontracting_models(search) == []


def test_many_neurons_without_contraction_need_few_that_were_not_given_up() -> None:
    spec = StructuredSpec(order=AUTO, neurons=AUTO, knots=0, input_path="none", rate=AUTO)
    fold = data_set(samples=100)
    search = SettingsSearch(spec=spec, folds=(fold,) * 4, seed=0, announce=quiet)
    for size in (2, 3):
        given_up = candidate("structured", 90.0, 90.0)
        settings = {"order": size, "neurons": size, "rate": None}
        search.tried.append(replace(given_up, settings=settings))
    tried = try_noncontracting_models(search)
    expected = [2, 3]
    actual = [one.settings["neurons"] for one in tried]
    assert actual == expected


def test_one_layer_stays_where_no_good_model_with_an_integrator_can_be_certified() -> None:
    spec = StructuredSpec(order=AUTO, neurons=AUTO, knots=AUTO, integrating_output=AUTO)
    search = SettingsSearch(spec=spec, folds=(), seed=0, announce=quiet)
    without = candidate(STRUCTURED, 20.0, 22.0, 21.0, 23.0)
    one_layer = replace(without, settings={"neurons": 0, "integrating_output": False})
    neurons = replace(without, settings={"neurons": 5, "integrating_output": False})
    search.tried += [one_layer, neurons]
    assert candidates_without_neurons_or_integrator(search) == []
    search.decided["integrating_output"] = True
    stays = candidates_without_neurons_or_integrator(search)
    expected = [id(one_layer)]
    actual = [id(each) for each in stays]
    assert actual == expected
    smallest = candidate("one state", 30.0, 31.0, 30.0, 33.0)
    best = candidate("two states", 10.0, 11.0, 10.0, 12.0)
    search.spec = replace(spec, among_starts=AllCertified())
    examined = [replace(each, example="model") for each in (smallest, best, one_layer)]
    search.certified = {id(each): each.model != "two states" for each in examined}
    assert simplest_certifiable_candidate(search, examined) is examined[2]
    assert simplest_certifiable_candidate(search, examined[:2]) is examined[0]


class AllCertified:
    """Choice among starts that certifies every model."""

    def __call__(self, identified: object) -> None:
        """Choose none: nobody asks."""

    def has_certificates(self, model: object) -> bool:
        return model is not None


def test_finalists_are_trained_further_and_nothing_else() -> None:
    """After a few steps a large model is less trained than a small one."""
    spec = StructuredSpec(**FIXED | BRIEF | {"order": AUTO})  # type: ignore[arg-type]
    data = data_set(noise=0.02, samples=250, records=4)
    search = SettingsSearch(spec=spec, folds=make_folds(data)[:2], seed=0, announce=quiet)
    tried = [search.score_structured_model("size", {"order": order}) for order in (1, 2)]
    small, large = tried
    hopeless = replace(small, errors=3.0 * large.errors)
    first, second = train_finalists(search, [hopeless, large])
    assert first is hopeless
    assert second.question == "longer training"
    assert second.training_error < large.training_error
    assert second.settings == large.settings


def test_an_integrator_has_to_beat_models_without_neurons() -> None:
    """A load that is not in the log drifts: both models with neurons follow it where they train."""
    spec = StructuredSpec(order=AUTO, neurons=AUTO, knots=0, integrating_output=AUTO)
    folds = make_folds(data_set(noise=0.02, samples=250, records=4))
    for error, is_needed in ((50.0, False), (0.1, True)):
        search = search_with_integrator(spec, folds, error)
        assert not decide_on_integrator(search)
        assert search.has_integrator is is_needed
        expected = int(is_needed)
        count = len(search.chosen)
        assert count == expected


def test_an_integrator_that_leads_but_not_clearly_is_trained_further(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is taken if sizes with it then lead those without."""
    monkeypatch.setattr(choice_of_size, "FURTHER_STEPS", 2)
    spec = replace(StructuredSpec(**FIXED | BRIEF), knots=AUTO, integrating_output=AUTO)
    folds = make_folds(data_set(noise=0.02, samples=250, records=4))
    one_layer = try_sizes_without_neurons(search_of(spec, folds))[0]
    search = search_with_integrator(spec, folds, 0.99 * one_layer.mean_error_percent)
    assert decide_on_integrator(search)
    assert not search.has_integrator
    assert search.chosen == []
    actual = try_models_with_integrator(search, [one_layer])
    assert actual == []
    far = replace(one_layer, errors=100.0 * one_layer.errors)
    leading = try_models_with_integrator(search, [far])
    expected = {True}
    actual = {one.settings["integrating_output"] for one in leading}
    assert actual == expected
    assert leading[0].question == "longer training"


def search_of(spec: StructuredSpec, folds: Sequence[DataSet]) -> SettingsSearch:
    """Search on two folds in which nothing is tried yet."""
    return SettingsSearch(spec=spec, folds=folds[:2], seed=0, announce=quiet)


def search_with_integrator(
    spec: StructuredSpec, folds: Sequence[DataSet], error: float
) -> SettingsSearch:
    """Search that has adopted an integrator, with the same error on both folds."""
    search = search_of(spec, folds)
    search.adopt_settings(candidate("with", error, error), {"integrating_output": True})
    return search
