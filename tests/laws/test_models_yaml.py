"""Every yaml of the groups model, scaffold and training trains a model that its own JSON
replays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from models_cases import data_set
from recorded import assert_as_recorded, is_recorded

from ssm_study.models.baselines.solved import SolvedSpec
from ssm_study.models.spec import ModelSpec
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.training.choice import fill_in_defaults
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.training import Training

CONF = Path(__file__).resolve().parents[2] / "conf"
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
SCAFFOLDS = sorted(path.stem for path in (CONF / "scaffold").glob("*.yaml"))
TRAININGS = sorted(path.stem for path in (CONF / "training").glob("*.yaml"))
OPTIMISERS = sorted(path.stem for path in (CONF / "training" / "optimiser").glob("*.yaml"))


PACKAGES = {"n4sid": "nfoursid"}  # the extra "baselines"
# Few steps of few starts: what is judged is that a model comes of it and replays.
BRIEF = ("model.starts=1", "model.draws=2", "model.start_steps=[5,3,3]")
CHOSEN = ("log",)  # among models of many kinds: which one is a question of its own
FEWER = dict.fromkeys(("structured", "log"), BRIEF)


def read(group: str, choice: str, *overrides: str) -> Any:
    with initialize_config_dir(str(CONF), version_base=None):
        tree = compose(overrides=[f"+{group}={choice}", *overrides])
    return instantiate(tree[group], _convert_="all")


def brief(**changes: Any) -> Training:
    return read(
        "training", "default", "training.max_epochs=2", *(f"{k}={v}" for k, v in changes.items())
    )


@pytest.mark.parametrize("choice", MODELS)
def test_every_model_yaml_is_identified_and_replayed(choice: str, tmp_path: Path) -> None:
    if choice in PACKAGES:
        pytest.importorskip(PACKAGES[choice])
    data = data_set(noise=0.02, samples=120, records=2)
    fewer = FEWER.get(choice, ())
    spec = read("model", choice, *fewer)
    assert isinstance(spec, ModelSpec)
    found = brief().identify(spec, data, seed=0, folder=tmp_path)
    assert np.isfinite(records_fit_percent(found.model, data.training, data))
    text = json.dumps(found.model.to_json())
    content = json.loads(text)
    again = model_from_json(content)
    test_u = data.test[0].u
    actual = again.simulate(test_u)
    test_u = data.test[0].u
    expected = found.model.simulate(test_u)
    np.testing.assert_allclose(actual, expected, rtol=1e-13)
    assert is_recorded("model_ssm")
    if choice not in CHOSEN and is_recorded(f"model_{choice}"):
        assert_as_recorded(f"model_{choice}", [content, actual], 1e-2)


@pytest.mark.parametrize("choice", MODELS)
def test_frozen_numbers_step_as_the_tensors_do(choice: str) -> None:
    if choice in PACKAGES:
        pytest.importorskip(PACKAGES[choice])
    data = data_set(samples=60, records=2)
    spec = read("model", choice)
    if isinstance(spec, StructuredSpec):
        spec = fill_in_defaults(spec)
    if isinstance(spec, SolvedSpec):
        pytest.skip("solved, not trained")
    net = (spec.settings_without_neurons() if isinstance(spec, StructuredSpec) else spec).build(
        data, 0
    )
    u = data.test[0].u
    with torch.no_grad():
        scaled = net(torch.from_numpy(data.scale.scaled_input(u))[None])[0].numpy()
    output_scale = data.scale.output_scale
    expected = scaled * output_scale + data.scale.output_equilibrium
    actual = net.to_numpy(data).simulate(u)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("side", ["scaffold_in", "scaffold_out"])
@pytest.mark.parametrize("choice", SCAFFOLDS)
def test_every_scaffold_yaml_fits_both_sides(choice: str, side: str, tmp_path: Path) -> None:
    spec = read(
        "model", "ssm", f"scaffold@model.{side}={choice}", "model.hidden_width=6", "model.order=2"
    )
    data = data_set(samples=120, records=2)
    found = brief().identify(spec, data, seed=0, folder=tmp_path)
    assert records_fit_percent(found.model, data.training, data) > 30


@pytest.mark.parametrize("choice", TRAININGS)
def test_every_training_yaml_trains(choice: str, tmp_path: Path) -> None:
    training = read("training", choice, "training.max_epochs=3")
    data = data_set(samples=120)
    spec = read("model", "ssm", "model.order=2")
    found = training.identify(spec, data, 0, tmp_path)
    assert records_fit_percent(found.model, data.training, data) > 30


@pytest.mark.parametrize("choice", OPTIMISERS)
def test_every_optimiser_yaml_lowers_the_error(choice: str, tmp_path: Path) -> None:
    training = read("training", "default", f"training/optimiser={choice}", "training.max_epochs=4")
    spec = read("model", "ssm", "model.order=2")
    found = training.identify(spec, data_set(samples=120), 0, tmp_path)
    assert found.curve[-1]["fit_training_percent"] > 60


def test_a_model_without_a_network_to_train_says_so() -> None:
    for choice in ("structured", "log", "n4sid", "narx", "output_error", "bilinear"):
        with pytest.raises(TypeError, match="a training of its own"):
            read("model", choice).build(data_set(), 0)


def test_an_unknown_stored_model_is_refused() -> None:
    with pytest.raises(BadRequest, match="kind = transformer"):
        model_from_json({"kind": "transformer"})


def test_a_baseline_whose_package_is_missing_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr("ssm_study.models.baselines.solved.import_module", absent)
    with pytest.raises(BadRequest, match="pip install"):
        read("model", "n4sid").fit_model(data_set())
