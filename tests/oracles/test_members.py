"""Several models of one log predict by their mean: ranked, stored, scored by two routes; control
stays with one of them."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import assert_as_recorded

sys.path.insert(0, str(Path(__file__).parents[1] / "laws"))
from models_cases import data_set
from test_training_choice import training

from ssm_study.api.model import Model
from ssm_study.models.members import member_columns, simulate_ensemble_mean
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet
from ssm_study.study.stages.model import (
    MEMBERS,
    compute_model,
    read_trained_model,
    training_result_columns,
)
from ssm_study.training.metrics import Identification, records_fit_percent

SIZE = {"order": 2, "neurons": 1, "knots": 0}
SMALL = {**SIZE, "draws": 1, "start_steps": (5, 3, 3)}


@pytest.fixture(scope="module")
def data() -> DataSet:
    """Records of a plant of two states, with noise."""
    return data_set(noise=0.02, samples=300, records=2)


@pytest.fixture(scope="module")
def folder(data: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that the model's stage leaves of two members."""
    there = tmp_path_factory.mktemp("members")
    spec = StructuredSpec(starts=1, members=2, **SMALL)  # type: ignore[arg-type]
    settings = {"model": spec, "training": training(3)}
    settings |= {"seed": 0, "progress": False}
    compute_model(there, data, **settings)  # type: ignore[arg-type]
    return there


def test_the_mean_is_scored_by_two_routes(folder: Path, data: DataSet) -> None:
    trained = read_trained_model(folder)
    facts = training_result_columns(trained, data)
    record = data.test[0]
    outputs = [model.simulate(record.u) for model in trained.members]
    error = record.y - sum(outputs) / len(outputs)
    mean = record.y.mean(axis=0)
    spread = record.y - mean
    relative_error = np.linalg.norm(error) / np.linalg.norm(spread)
    by_hand = 100.0 * (1.0 - relative_error)
    assert facts["members"] == 2
    fit = facts["fit_test_members_percent"]
    assert fit == pytest.approx(by_hand, rel=1e-12)


def test_members_are_those_that_fit_the_training_records_best(folder: Path, data: DataSet) -> None:
    trained = read_trained_model(folder)
    fits = [records_fit_percent(model, data.training, data) for model in trained.members]
    expected = sorted(fits, reverse=True)
    assert fits == expected
    stored_members = [model.to_json() for model in trained.members]
    assert trained.model.to_json() in stored_members


def test_a_changed_member_changes_what_verify_derives(
    folder: Path, data: DataSet, tmp_path: Path
) -> None:
    members = read_trained_model(folder).members
    stated = member_columns(members, data)
    for path in folder.glob("*.json"):
        content = path.read_bytes()
        (tmp_path / path.name).write_bytes(content)
    text = (tmp_path / MEMBERS).read_text()
    changed = json.loads(text)
    changed[1]["c"][0][0] *= 1.01
    text = json.dumps(changed)
    (tmp_path / MEMBERS).write_text(text)
    members = read_trained_model(tmp_path).members
    assert member_columns(members, data) != stated


def test_one_model_has_no_mean_and_may_predict_in_place_of_another(
    folder: Path, data: DataSet
) -> None:
    trained = read_trained_model(folder)
    assert member_columns((), data) == {}
    members = trained.members[:1]
    columns = member_columns(members, data)
    assert columns["members"] == 1
    _, test = simulate_validation_and_test(members[0], data)
    assert columns["fit_test_members_percent"] == test.fit_percent


def test_on_a_benchmark_the_mean_is_scored_on_each_test_record(folder: Path, data: DataSet) -> None:
    members = read_trained_model(folder).members
    metadata = data.metadata | {"benchmark": "ced"}
    benchmark = replace(data, metadata=metadata)
    columns = member_columns(members, benchmark)
    _, test = simulate_ensemble_mean(members, data)
    start = data.start_up_samples
    for number, record in enumerate(data.test):
        error = record.y[start:] - test.simulated[number][start:]
        by_hand = np.sqrt(np.mean(error**2))
        score = columns[f"score_members_{number + 1}"]
        assert score == pytest.approx(by_hand, rel=1e-12)
    assert "score_members_1" not in member_columns(members, data)


def test_python_predicts_with_the_mean_and_says_so(folder: Path, data: DataSet) -> None:
    trained = read_trained_model(folder)
    training_facts = {"seconds": 1.0, "curve": [], "ended": ""}
    identification = Identification.from_model(
        trained.model, data, members=trained.members, **training_facts
    )
    model = Model(simulator=trained.model, data=data, identification=identification)
    u = data.test[0].u
    responses = [member.simulate(u) for member in trained.members]
    expected = np.mean(responses, axis=0)
    actual = model.predict(u)
    np.testing.assert_array_equal(actual, expected)
    assert model.result_columns["members"] == 2
    assert "2 models" in model.summary()["mean that predicts"]


def test_members_is_a_positive_number() -> None:
    with pytest.raises(BadRequest, match=r"model.members = 0"):
        StructuredSpec(members=0, **SMALL)  # type: ignore[arg-type]


def test_members_and_scores_are_the_recorded_ones(folder: Path, data: DataSet) -> None:
    trained = read_trained_model(folder)
    columns = training_result_columns(trained, data)
    assert_as_recorded("members", [trained.model, columns], 1e-3)
