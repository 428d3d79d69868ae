"""A model with an integrator that clearly leads is trained to the end before it is given up, if it
lacks certificates alone."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.structured_spec import AUTO, StructuredSpec
from ssm_study.training import choice
from ssm_study.training.candidates import Candidate
from ssm_study.training.choice_of_leader import find_uncertified_leader, offer_leader
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.search import STRUCTURED, SettingsChoice, SettingsSearch
from ssm_study.training.training import Training, TrainingSession


class SaysCertified:
    """Choice among starts that certifies what says so."""

    def __call__(self, identified: object) -> None:
        """Choose none: nobody asks."""

    def has_certificates(self, model: object) -> bool:
        return model == "certified"


SPEC = StructuredSpec(
    order=AUTO, neurons=AUTO, knots=AUTO, integrating_output=AUTO, among_starts=SaysCertified()
)
ONE_LAYER = {"order": 3, "neurons": 0, "knots": 16, "integrating_output": False}
ONE_NEURON = {"order": 2, "neurons": 1, "knots": 16, "integrating_output": True}


def candidate(settings: dict[str, object], example: str, *errors: float) -> Candidate:
    """Candidate structured model with these errors on the folds; its example is a word."""
    error_array = np.array(errors)
    return Candidate(
        question="size", model=STRUCTURED, settings=settings, errors=error_array, example=example
    )


LAYER = candidate(ONE_LAYER, "certified", 21.0, 22.0, 20.0, 21.0)
LEADER = candidate(ONE_NEURON, "not certified", 14.0, 13.0, 14.0, 13.0)
LARGER_SIZE = ONE_NEURON | {"order": 3}
LARGER = candidate(LARGER_SIZE, "not certified", 13.0, 13.0, 14.0, 13.0)


def search_after(*tried: Candidate) -> SettingsSearch:
    """Search in which these candidates were tried."""
    search = SettingsSearch(spec=SPEC, folds=(), seed=0, announce=lambda _: None)
    search.tried += tried
    return search


def test_the_smallest_leader_without_certificates_is_found() -> None:
    search = search_after(LARGER, LAYER, LEADER)
    assert find_uncertified_leader(search, [LAYER]) is LEADER
    assert find_uncertified_leader(search, [LAYER, LEADER, LARGER]) is LEADER


def test_a_certified_candidate_is_no_leader() -> None:
    certified = replace(LEADER, example="certified")
    search = search_after(certified, LAYER)
    assert find_uncertified_leader(search, [LAYER]) is None


@pytest.mark.parametrize("error", [17.5, 30.0])
def test_a_lead_of_less_than_a_quarter_is_none(error: float) -> None:
    near = candidate(ONE_NEURON, "not certified", error, error, error, error)
    search = search_after(near, LAYER)
    assert find_uncertified_leader(search, [LAYER]) is None


def test_what_was_dropped_after_two_folds_is_no_leader() -> None:
    dropped = candidate(ONE_NEURON, "not certified", 14.0, 13.0)
    search = search_after(dropped, LAYER)
    assert find_uncertified_leader(search, [LAYER]) is None


def test_a_model_without_integrator_is_no_leader() -> None:
    settings = ONE_NEURON | {"integrating_output": False}
    other = replace(LEADER, settings=settings)
    search = search_after(other, LAYER)
    assert find_uncertified_leader(search, [LAYER]) is None


def test_a_leader_trained_further_counts_with_its_last_errors() -> None:
    errors = LEADER.errors - 1.0
    further = replace(LEADER, errors=errors)
    search = search_after(LEADER, LAYER, further)
    assert find_uncertified_leader(search, [LAYER]) is further


def test_a_leader_is_offered_and_later_choices_tell_of_it() -> None:
    search = search_after(LAYER, LEADER)
    (offer,) = offer_leader(search, LEADER, None)
    assert offer.only_if_certified
    assert offer.spec.integrating_output is True
    assert offer.spec.order == 2
    layer_row, leader_row = offer.rows
    assert layer_row["certified"] is None
    assert not layer_row["chosen"]
    assert leader_row["certified"]
    assert leader_row["chosen"]
    words = offer.describe(SPEC.automatic_settings)
    assert words.endswith("no brief training of it was certified, but the full training was")
    later = search.build_settings_choice(LAYER)
    leader_row = later.rows[1]
    assert leader_row["certified"] is False
    words = later.describe(SPEC.automatic_settings)
    remark = "a model with an integrator (states 2, neurons 1, break points 16) predicted better"
    assert f"; {remark}, but no training of it was certified" in words


@dataclass(frozen=True, kw_only=True)
class FakeResult:
    """Result of a training that was not run."""

    model: str
    seconds: float = 0.0
    choice: tuple[object, ...] = ()
    chosen: str = ""


@pytest.mark.parametrize("certified", [True, False])
def test_a_leader_is_kept_only_with_certificates(
    certified: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any, what is returned is what the other choices give, also if none is certified."""
    leader_rows = ({"order": 2},)
    leader = SettingsChoice(spec=SPEC, rows=leader_rows, only_if_certified=True)
    first_rows = ({"order": 3},)
    first = SettingsChoice(spec=SPEC, rows=first_rows)
    second = SettingsChoice(spec=SPEC)

    def choices(*_: object) -> Iterator[SettingsChoice]:
        yield from (leader, first, second)

    def identified(_: object, one: SettingsChoice, *__: object) -> object:
        is_certified = one is leader and certified
        model = "certified" if is_certified else "not certified"
        return FakeResult(model=model)

    monkeypatch.setattr(choice, "iterate_model_choices", choices)
    monkeypatch.setattr(Training, "_identify_with_chosen_settings", identified)
    optimiser = Lbfgs(steps_per_epoch=10, history=20)
    training = Training(
        optimiser=optimiser,
        max_epochs=1,
        patience=1,
        min_gain_percent=0.0,
        validation_tolerance_percent=0.0,
    )
    session = TrainingSession(seed=0, folder=tmp_path)
    data = data_set(samples=100)
    result = training._choose_settings_and_identify(SPEC, data, session)
    expected = leader_rows if certified else first_rows
    assert result.choice == expected
