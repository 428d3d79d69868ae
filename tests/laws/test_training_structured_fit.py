"""Fits of structured models: contracting, reproducible, pruned, stored with their integrator."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_study.bounds.metrics import model_bound_columns
from ssm_study.models.contracting import RecurrenceMatrices, find_contraction_metric
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training.levenberg import damping_update_factor
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.pruning import prune_neurons
from ssm_study.training.structured_fit import LinearStarts, StructuredFit
from ssm_study.training.training import Training


def recorded(model: StructuredSSM, seed: int) -> DataSet:
    rng = np.random.default_rng(seed)
    records = []
    for part in ("training", "validation", "test"):
        u = np.repeat(rng.uniform(-2, 2, (60, 1)), 8, axis=0)
        y = model.simulate(u)
        trajectory = Trajectory(u=u, y=y, step_s=0.1, name=part)
        records.append((trajectory,))
    channel = (Channel(name="a", unit="V"),)
    scale = Scale.identity(1, 1)
    return DataSet(
        training=records[0],
        validation=records[1],
        test=records[2],
        inputs=channel,
        outputs=channel,
        scale=scale,
    )


@pytest.fixture(scope="module")
def data() -> DataSet:
    a = [[0.9, 0.2], [-0.2, 0.8]]
    b = [[0.1], [0.4]]
    c = [[1.0, 0.0]]
    e = [[-0.6], [0.1]]
    blocks = {"a": a, "b": b, "c": c, "e": e}
    d = [[0.0]]
    f = [[1.5, 0.0]]
    g = [[0.0]]
    h = [[0.0]]
    blocks |= {"d": d, "f": f, "g": g, "h": h, "bias": [0.3]}
    scaffold_in = LinearScaffold.identity(1)
    scaffold_out = LinearScaffold.identity(1)
    scale = Scale.identity(1, 1)
    true = StructuredSSM(
        **{name: np.array(block) for name, block in blocks.items()},
        neurons=("tanh",),
        scaffold_in=scaffold_in,
        scaffold_out=scaffold_out,
        scale=scale,
        step_s=0.1,
    )
    return recorded(true, 0)


def trained(data: DataSet, folder: Path, epochs: int = 25, **choices: object) -> StructuredSSM:
    sizes = {"order": 2, "neurons": 1, "knots": 0}
    settings: dict[str, Any] = {"starts": 1} | sizes | choices
    spec = StructuredSpec(**settings)
    no_use = Lbfgs(steps_per_epoch=1, history=1)
    rule: dict[str, Any] = {"max_epochs": epochs, "patience": 15}
    rule["min_gain_percent"] = 0.0
    rule["validation_tolerance_percent"] = 0.2
    training = Training(optimiser=no_use, **rule)
    identified = training.identify(spec, data, 0, folder)
    assert isinstance(identified.model, StructuredSSM)
    if epochs > 1:
        assert identified.fit_validation_percent > 99.0
    return identified.model


def test_a_model_of_the_class_is_identified_contracting_and_again_the_same(
    data: DataSet, tmp_path: Path
) -> None:
    model = trained(data, tmp_path / "long")
    core = RecurrenceMatrices(model.a, model.e, model.f)
    found = find_contraction_metric(core, 0.9995)
    assert found is not None
    first = trained(data, tmp_path / "a", epochs=1)
    second = trained(data, tmp_path / "b", epochs=1)
    assert first.to_json() == second.to_json()


def test_a_neuron_that_does_nothing_is_removed_and_the_metric_stays(
    data: DataSet, tmp_path: Path
) -> None:
    spare = trained(data, tmp_path, epochs=1)
    e = np.hstack([spare.e, 1e-9 * np.ones((2, 1))])
    f = np.vstack([spare.f, [[1.0, 0.0]]])
    g = np.zeros((2, 1))
    h = np.zeros((1, 2))
    bias = np.append(spare.bias, 0.0)
    neurons = ("tanh", "softplus")
    idle = replace(spare, e=e, f=f, g=g, h=h, bias=bias, neurons=neurons)
    records = data.training[:1]
    left = prune_neurons(idle, records)
    assert left.neurons == ("tanh",)
    test_u = data.test[0].u
    actual = left.simulate(test_u)
    test_u = data.test[0].u
    expected = spare.simulate(test_u)
    np.testing.assert_allclose(actual, expected, atol=1e-5)
    g = np.array([[0.0], [1.0]])
    h = np.array([[0.0, 1e-9]])
    through = replace(idle, g=g, h=h)
    records = data.training[:1]
    structured_ssm = prune_neurons(through, records)
    neurons = structured_ssm.neurons
    assert neurons == idle.neurons  # its mean slope would be a feedthrough
    h = np.array([[0.0, 1e-9]])
    changed_idle = replace(idle, h=h)
    g = np.array([[0.0], [1.0]])
    for beside in (changed_idle, replace(idle, g=g)):
        records = data.training[:1]
        structured_ssm = prune_neurons(beside, records)
        neurons = structured_ssm.neurons
        assert neurons == ("tanh",)


REFUSED: list[tuple[dict[str, Any], str]] = [({"kinds": "sine"}, "unknown neuron")]
REFUSED_NUMBERS = {"order": 0, "neurons": -1, "rate": 1.2}
REFUSED_SHARES = {"gain_share": 1.0, "slope_lower": 0.0}
REFUSED_VALUES = REFUSED_NUMBERS | REFUSED_SHARES | {"input_path": "late"}
for refused_name, refused_value in REFUSED_VALUES.items():
    refused_choice = {refused_name: refused_value}
    field_words = f"model.{refused_name} = "
    REFUSED.append((refused_choice, field_words))
INTEGRATING_WITH_KNOTS = {"integrating_output": True, "output_knots": 4}
REFUSED.append((INTEGRATING_WITH_KNOTS, "model.output_knots"))
INTEGRATING_WITHOUT_NEURONS = {"integrating_output": True, "neurons": 0}
NEEDS_NEURONS = "model.neurons = 0: model.integrating_output=true needs neurons"
REFUSED.append((INTEGRATING_WITHOUT_NEURONS, NEEDS_NEURONS))


@pytest.mark.parametrize(("choice", "word"), REFUSED)
def test_what_makes_no_sense_is_refused(choice: dict[str, Any], word: str) -> None:
    settings = {"order": 2, "neurons": 1} | choice
    with pytest.raises(BadRequest, match=word):
        StructuredSpec(**settings)


def test_an_integrated_model_is_stored_with_its_integrator(data: DataSet) -> None:
    """The running sum in training, and one more state of the stored model: the same output."""
    spec = StructuredSpec(order=2, neurons=1, knots=0, starts=1, integrating_output=True)
    fit = StructuredFit(spec, data, 0)
    fit.training_step(None, 0)
    model = fit.as_model()
    assert model.order == 3
    eigenvalues = np.linalg.eigvals(model.a)
    spectral_radius = np.abs(eigenvalues).max()
    assert spectral_radius == pytest.approx(1.0)
    assert "hankel_largest" not in model_bound_columns(
        model
    )  # no infinite-horizon Gramian: withheld, and no refusal
    y = fit.problem.simulate_output(fit.parameter_blocks)[0]
    training_u = data.training[0].u
    response = model.simulate(training_u)
    actual = data.scale.scaled_output(response)
    np.testing.assert_allclose(actual, y, atol=1e-9)


def test_the_first_epoch_leaves_the_initial_parameters_as_they_are(data: DataSet) -> None:
    spec = StructuredSpec(order=1, neurons=1, knots=0, starts=1, start_steps=(1, 1, 1))
    fit = StructuredFit(spec, data, 0)
    fit.training_step(None, 0)
    assert fit.initial_parameters is not None
    for name, block in fit.parameter_blocks.items():
        np.testing.assert_array_equal(block, fit.initial_parameters[name])


def test_the_damping_follows_the_share_of_the_expected_gain():
    assert damping_update_factor(0.8, 1.0) == 0.3
    assert damping_update_factor(1.5, 2.0) == 1.0
    assert damping_update_factor(0.6, 2.0) == 1.0
    assert damping_update_factor(0.5, 2.0) == 2.0


@pytest.mark.parametrize(
    "other", [{"input_path": "free"}, {"neurons": 0}, {"rate": None}, {"knots": 0}, {"order": 3}]
)
def test_a_linear_start_that_is_there_changes_no_number_of_a_training(
    data: DataSet, other: dict[str, Any]
) -> None:
    """Models that differ in their neurons begin with the same linear model, fitted once."""
    first_spec = StructuredSpec(order=2, neurons=2, knots=4, start_steps=(3, 3, 2), draws=2)
    second_spec = replace(first_spec, **other)
    starts: LinearStarts = {}
    first = StructuredFit(first_spec, data, 0, starts)
    first.start_training(2)
    shared = StructuredFit(second_spec, data, 0, starts)
    shared.start_training(2)
    alone = StructuredFit(second_spec, data, 0)
    alone.start_training(2)
    for name, block in alone.parameter_blocks.items():
        actual = shared.parameter_blocks[name]
        np.testing.assert_array_equal(actual, block)
    is_same_linear_model = {"knots", "order"}.isdisjoint(other)
    assert len(starts) == (1 if is_same_linear_model else 2)


SIZES = {"order": 3, "knots": 0, "output_knots": 4}
PATHS = {"feedthrough": True, "dead_time": 2}
OF_THE_LINEAR_MODEL: dict[str, Any] = SIZES | PATHS
OF_THE_LINEAR_MODEL["integrating_output"] = True


def test_each_setting_of_the_linear_model_has_its_own_linear_start(data: DataSet) -> None:
    spec = StructuredSpec(order=2, neurons=2, knots=4, output_knots=0)
    fits = [StructuredFit(spec, data, seed) for seed in (0, 1)]
    for name, value in OF_THE_LINEAR_MODEL.items():
        changes = {name: value}
        changed_spec = replace(spec, **changes)
        changed_fit = StructuredFit(changed_spec, data, 0)
        fits.append(changed_fit)
    keys = {fit._linear_start_settings for fit in fits}
    assert len(keys) == len(fits)
