"""A direct path is compared only where the records do not show that the output answers later."""

from dataclasses import replace

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import Trajectory
from ssm_study.training import choice_of_paths
from ssm_study.training.choice import iterate_model_choices
from ssm_study.training.search import SettingsSearch

SPEC = StructuredSpec(order=2, neurons=1, knots=0, input_path="none", feedthrough="auto")


def answering_in_the_next_sample(record: Trajectory) -> np.ndarray:
    return record.y


def answering_at_once(record: Trajectory) -> np.ndarray:
    return record.y + 2.0 * record.u


def answering_to_nothing(record: Trajectory) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.standard_normal(record.y.shape)


@pytest.mark.parametrize(
    ("output", "compared"),
    [
        (answering_in_the_next_sample, (False,)),
        (answering_at_once, (False, True)),
        (answering_to_nothing, (False, True)),
    ],
)
def test_a_direct_path_is_compared_where_the_answer_is_not_surely_later(
    output: object, compared: tuple[bool, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = data_set(noise=0.02, samples=250, records=4)
    records = []
    for record in data.training:
        y = output(record)  # type: ignore[operator]
        changed = replace(record, y=y)
        records.append(changed)
    training = tuple(records)
    changed_data = replace(data, training=training, validation=training[:1])
    search = SettingsSearch(spec=SPEC, folds=(), seed=0, announce=lambda _: None)
    values_of = {}

    def remember(_: object, question: str, name: str, values: object, gain: float) -> None:
        del name, gain
        values_of[question] = values

    monkeypatch.setattr(choice_of_paths, "choose_between_two_values", remember)
    choice_of_paths.choose_delay(search, changed_data)
    assert values_of["direct path"] == compared


def test_a_path_that_the_lag_decides_is_told_without_models_that_were_compared() -> None:
    data = data_set(noise=0.02, samples=250, records=4)
    choice = next(iterate_model_choices(SPEC, data, 0, str))
    assert choice.rows == ()
    text = choice.describe(SPEC.automatic_settings)
    assert text == "feedthrough no: read off the records"
