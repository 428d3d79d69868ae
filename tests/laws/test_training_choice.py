"""The records say whether the output answers within the sample, late or as a running sum, and how
large a model they deserve; training starts where they move."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.baselines.regression import fit_output_error
from ssm_study.models.identified import SSM
from ssm_study.models.structured_spec import AUTO, StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet, Trajectory
from ssm_study.systems import StateSpace
from ssm_study.training.candidates import (
    Candidate,
    CandidateErrors,
    best_candidate,
    fit_linear_model,
    is_far_worse_than_best,
    simplest_good_candidate,
)
from ssm_study.training.choice import iterate_model_choices
from ssm_study.training.choice_of_paths import is_nearly_integrating
from ssm_study.training.choice_of_size import simplest_certifiable_candidate
from ssm_study.training.folds import (
    join_consecutive_records,
    join_training_and_validation,
    make_folds,
)
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.search import SettingsChoice, SettingsSearch
from ssm_study.training.structured_fit import StructuredFit
from ssm_study.training.training import Training

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import KINDS

BRIEF = {"starts": 1, "draws": 1, "start_steps": (5, 3, 3)}
FIXED = {"order": 2, "neurons": 1, "knots": 0, "input_path": "none"}


def training(max_epochs: int) -> Training:
    """A training of a few epochs."""
    optimiser = Lbfgs(steps_per_epoch=10, history=20)
    return Training(
        optimiser=optimiser,
        max_epochs=max_epochs,
        patience=12,
        min_gain_percent=0.0,
        validation_tolerance_percent=0.0,
    )


def quiet(words: str) -> None:
    """Print nothing."""
    del words


def changed(data: DataSet, change: object) -> DataSet:
    """The same records with another output."""

    def record(one: Trajectory) -> Trajectory:
        return replace(one, y=change(one))  # type: ignore[operator]

    names = ("training", "validation", "test")
    parts = {name: tuple(record(one) for one in getattr(data, name)) for name in names}
    return replace(data, **parts)


def answering_at_once(record: Trajectory) -> np.ndarray:
    return record.y + 2.0 * record.u


def answering_late(record: Trajectory) -> np.ndarray:
    return np.concatenate([np.repeat(record.y[:1], 6, axis=0), record.y[:-6]])


def summed(record: Trajectory) -> np.ndarray:
    """An integrator behind the plant, driven by deviations from the record's mean."""
    mean = record.y.mean(axis=0)
    difference = record.y - mean
    running_sum = np.cumsum(difference, axis=0)
    return 0.05 * running_sum


@pytest.mark.parametrize(
    ("change", "name", "expected"),
    [
        (answering_at_once, "feedthrough", True),
        (lambda record: record.y, "feedthrough", False),
        (answering_late, "dead_time", 6),
        (lambda record: record.y, "dead_time", 0),
    ],
)
def test_the_delay_is_what_the_records_show(change: object, name: str, expected: object) -> None:
    data = changed(data_set(noise=0.02, samples=250, records=4), change)
    spec = StructuredSpec(**FIXED | BRIEF | {name: "auto"})  # type: ignore[arg-type]
    choice = next(iterate_model_choices(spec, data, 0, quiet))
    assert getattr(choice.spec, name) == expected
    text = json.dumps(choice.rows)
    rows = json.loads(text)
    assert [row[name] for row in rows if row["chosen"]] == [expected] * bool(rows)


def test_an_integrator_is_found_and_not_invented() -> None:
    data = data_set(noise=0.0, samples=500, records=4)
    assert not is_nearly_integrating(data)
    assert is_nearly_integrating(changed(data, summed))


def test_the_test_records_are_not_looked_at() -> None:
    data = changed(data_set(noise=0.02, samples=125, records=4), answering_at_once)
    test_y = data.test[0].y
    y = np.zeros_like(test_y)
    test = (replace(data.test[0], y=y),)
    other = replace(data, test=test)
    spec = StructuredSpec(**FIXED | BRIEF | {"feedthrough": "auto"})  # type: ignore[arg-type]
    choice = next(iterate_model_choices(spec, data, 0, quiet))
    expected = next(iterate_model_choices(spec, other, 0, quiet))
    assert choice.rows
    assert choice == expected


def test_short_records_choose_nothing() -> None:
    data = data_set(samples=120, records=1)
    spec = StructuredSpec(order="auto", neurons="auto", input_path="auto", knots="auto")
    changed_data = replace(data, validation=data.training)
    choice = next(iterate_model_choices(spec, changed_data, 0, quiet))
    structured_spec = StructuredSpec(order=5, neurons=5)
    expected = SettingsChoice(spec=structured_spec)
    assert choice == expected
    message = choice.describe(["order", "neurons"])
    assert message.startswith("nothing, as no record beside the test has 240 samples")
    assert message.endswith("the defaults: order 5, neurons 5")
    assert choice.describe([]) == ""


def test_what_is_fixed_stays_fixed() -> None:
    data = data_set(noise=0.02, samples=200, records=4)
    spec = StructuredSpec(order="auto", neurons=0, knots=4, **BRIEF)  # type: ignore[arg-type]
    choice = next(iterate_model_choices(spec, data, 0, quiet))
    assert choice.spec.neurons == 0
    assert choice.spec.knots == 4
    assert choice.spec.automatic_settings == ()
    orders = {row["order"] for row in choice.rows}
    assert orders >= {2, 3}


def candidate(name: str, *errors: float) -> Candidate:
    candidate_errors = np.array(errors)
    return Candidate(question="size", model=name, settings={}, errors=candidate_errors)


def test_the_smallest_that_is_not_behind_is_taken() -> None:
    small = candidate("small", 10.0, 10.0, 10.0, 10.0)
    middle = candidate("middle", 4.1, 4.0, 4.2, 4.1)
    large = candidate("large", 4.0, 4.1, 4.1, 4.0)
    given_up = candidate("given up", 9.0, 9.0)
    candidates = [small, given_up, middle, large]
    assert simplest_good_candidate(candidates) is middle
    candidates = [small, given_up, middle, large]
    assert best_candidate(candidates) is large
    assert small.is_clearly_worse(large)
    assert not middle.is_clearly_worse(large)


def test_a_gain_on_one_fold_alone_decides_nothing() -> None:
    plain = candidate("plain", 10.0, 10.0, 10.0, 30.0)
    lucky = candidate("lucky", 11.0, 11.0, 10.0, 10.0)
    assert not plain.is_clearly_worse(lucky)


def test_a_loss_on_one_odd_fold_does_not_hide_gains_on_all_others() -> None:
    one_layer = candidate("one layer", 28.7, 56.5, 38.0, 17.0)
    neurons = candidate("neurons", 7.0, 73.0, 25.3, 11.8)
    assert one_layer.is_clearly_worse(neurons)
    assert not neurons.is_clearly_worse(one_layer)


def test_far_behind_after_two_folds_is_not_tried_on() -> None:
    best = candidate("best", 2.0, 2.0, 2.0, 2.0)
    errors = [4.0, 4.0]
    assert is_far_worse_than_best(errors, best)
    assert not is_far_worse_than_best([40.0], best)
    errors = [2.5, 2.5]
    assert not is_far_worse_than_best(errors, best)


@pytest.mark.parametrize("direct", [True, False])
def test_the_linear_model_as_a_state_space_is_the_recursion(direct: bool) -> None:
    """Both are simulated from rest: they differ by the recursion's offset, which decays."""
    data = data_set(noise=0.01, samples=600, records=2)
    data = changed(data, answering_at_once) if direct else data
    model = fit_linear_model(data, 2, has_feedthrough=direct)
    delay = 0 if direct else 1
    recursion = fit_output_error(data, 2, delay)
    u = data.test[0].u
    late = slice(300, None)
    actual = model.simulate(u)[late]
    expected = recursion.simulate(u)[late]
    test_y = data.test[0].y
    atol = 1e-6 * np.ptp(test_y)
    np.testing.assert_allclose(actual, expected, atol=atol)


def test_lightly_damped_modes_are_found_by_a_long_regression_cut_down() -> None:
    """A regression of as many lags as the beam has states is led astray by one percent of noise."""
    kind = next(kind for kind in KINDS if kind.name == "resonances")
    table = kind.log(0, 1500)
    data = data_set(samples=400)
    u = table[["u"]].to_numpy()
    y = table[["y"]].to_numpy()
    record = replace(data.training[0], u=u, y=y, step_s=kind.step_s)
    test = (record[1000:],)
    data = replace(data, training=(record[:1000],), test=test, start_up_samples=20)
    model = fit_linear_model(data, 10, has_feedthrough=False)
    assert records_fit_percent(model, data.test, data) > 95.0


class OnlyLinear:
    """A rule among starts that certifies models without neurons."""

    def has_certificates(self, model: object) -> bool:
        return model == "linear"

    def __call__(self, found: object) -> object:
        raise NotImplementedError


def test_what_cannot_be_certified_is_dropped_and_told() -> None:
    spec = StructuredSpec(**FIXED | BRIEF | {"order": "auto"}, among_starts=OnlyLinear())  # type: ignore[arg-type]
    search = SettingsSearch(spec=spec, folds=(), seed=0, announce=quiet)
    behind = replace(candidate("behind", 9.0, 9.0), example="linear")
    best = replace(candidate("best", 2.0, 2.0), example="neurons")
    search.tried += [behind, best]
    candidates = [behind, best]
    assert simplest_good_candidate(candidates) is best
    assert simplest_certifiable_candidate(search, [behind, best]) is behind
    rows = search.candidate_rows([behind])
    certified = [row["certified"] for row in rows]
    assert certified == [True, False]
    assert simplest_certifiable_candidate(search, [best]) is best


def test_a_held_out_piece_starts_from_where_its_output_is_predicted_better() -> None:
    """Twenty samples that a knock disturbed say little about a mode of five hundred samples; the
    log before them does."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(40, 1)), 60, axis=0)
    a = np.array([[0.998]])
    b = np.array([[0.01]])
    c = np.eye(1)
    d = np.zeros((1, 1))
    system = StateSpace(a=a, b=b, c=c, d=d)
    model = SSM.from_linear(system, 1.0)
    y = model.simulate(u)
    y[1800:1820] += y.std()
    log = Trajectory(u=u, y=y, step_s=1.0, log=1)
    validation = (log[1800:],)
    test = (log[1800:],)
    data = replace(data_set(samples=400), training=(log[:1800],), validation=validation, test=test)
    trial = CandidateErrors()
    changed_data = replace(data, scale=model.scale, start_up_samples=20)
    trial.add_error_on_fold(model, changed_data)
    assert trial.best_initial_state_source == "past"
    upper_limit = trial.by_start["samples"][0]
    assert trial.errors[0] < upper_limit


def test_pieces_that_follow_each_other_are_joined_and_folds_cover_them() -> None:
    u = np.arange(1000.0)[:, None]
    log = Trajectory(u=u, y=u, step_s=1.0, log=1)
    data = data_set(samples=400)
    validation = (log[400:600],)
    data = replace(data, training=(log[:400], log[600:]), validation=validation)
    joined = join_training_and_validation(data)
    assert [len(record) for record in joined.training] == [1000]
    records = [log[:400], log[500:]]
    assert len(join_consecutive_records(records)) == 2
    folds = make_folds(data)
    held_out = np.concatenate([fold.test[0].u for fold in folds])
    np.testing.assert_array_equal(held_out, u)
    for fold in folds:
        trained = np.concatenate([record.u for record in fold.training])
        test_u = fold.test[0].u
        assert not set(trained.ravel()) & set(test_u.ravel())


def test_a_late_answer_is_part_of_the_model(tmp_path: Path) -> None:
    data = changed(data_set(noise=0.0, samples=500, records=4), answering_late)
    spec = StructuredSpec(**FIXED | BRIEF | {"dead_time": 6})  # type: ignore[arg-type]
    found = training(max_epochs=10).identify(spec, data, 0, tmp_path)
    model = found.model
    assert model.order == 2 + 6
    input_equilibrium = data.scale.input_equilibrium
    step = np.tile(input_equilibrium, (20, 1))
    step[1:] += 1.0
    response = model.simulate(step)
    output_equilibrium = data.scale.output_equilibrium
    answer = response[:, 0] - output_equilibrium[0]
    actual = answer[:8]
    np.testing.assert_array_equal(actual, 0.0)
    assert abs(answer[8]) > 0.0


def test_a_delayed_structured_model_answers_as_the_model_did() -> None:
    data = data_set(samples=300)
    spec = StructuredSpec(order=2, neurons=2, input_path="free", feedthrough=True, knots=4)
    fit = StructuredFit(spec, data, 0)
    fit.start_training(2)
    model = fit.as_model()
    u = data.test[0].u
    late = model.with_dead_time(3).simulate(u)
    actual = late[3:]
    response = model.simulate(u)
    expected = response[:-3]
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    assert isinstance(model.linear, StateSpace)


def test_only_true_false_and_auto_are_feedthrough() -> None:
    with pytest.raises(BadRequest, match=r"model.feedthrough = sometimes"):
        StructuredSpec(order=2, neurons=1, feedthrough="sometimes")


def test_a_size_is_a_number_or_auto() -> None:
    with pytest.raises(BadRequest, match=r"model.order = some"):
        StructuredSpec(order="some", neurons=1)
    with pytest.raises(BadRequest, match=r"model.integrating_output = perhaps"):
        StructuredSpec(order=2, neurons=1, integrating_output="perhaps")
    assert AUTO == "auto"


def moving_late(samples: int = 6000) -> RecordBatch:
    """One record that stands still for its first half."""
    rng = np.random.default_rng(0)
    u = np.zeros((samples, 1))
    difference = samples - samples // 2
    u[samples // 2 :] = rng.normal(size=(difference, 1))
    running_sum = np.cumsum(u, axis=0)
    pairs = [(u, running_sum * 0.1)]
    return RecordBatch.from_pairs(pairs)


def test_a_start_is_made_where_the_record_moves() -> None:
    records = moving_late()
    stretch = records.cut_varying_part(2000)
    assert stretch.u.std() > 0.8
    standard_deviation = records.cut_whole_records(2000).u.std()
    assert standard_deviation == 0.0
    late = RecordBatch(*(part[:, 3000:] for part in records))
    assert np.shares_memory(late.cut_varying_part(2000).u, late.cut_whole_records(2000).u)


def test_records_at_rest_have_no_start() -> None:
    u = np.zeros((300, 1))
    u[0] = 1.0
    pairs = [(u, np.arange(300.0)[:, None])]
    records = RecordBatch.from_pairs(pairs)
    still = RecordBatch(records.u * 0.0, records.y, records.weight)
    with pytest.raises(BadRequest, match="no stretch of the training records moves"):
        still.cut_varying_part(100)


def test_a_log_that_stands_still_at_first_trains() -> None:
    """With the equilibrium at zero its first samples are all zero, and gave a singular matrix."""
    data = data_set(samples=400, records=1)
    record = data.training[0]
    input_equilibrium = data.scale.input_equilibrium
    u = np.concatenate([np.tile(input_equilibrium, (2500, 1)), record.u])
    output_equilibrium = data.scale.output_equilibrium
    y = np.concatenate([np.tile(output_equilibrium, (2500, 1)), record.y])
    changed_record = replace(record, u=u, y=y)
    data = replace(data, training=(changed_record,))
    start_steps = [5, 5, 3]
    spec = StructuredSpec(order=2, neurons=1, draws=1, start_steps=start_steps)
    fit = StructuredFit(spec, data, 0)
    fit.start_training(3)
    assert float(fit.loss) < 0.2
