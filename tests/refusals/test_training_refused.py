"""Bad requests to models and training are one sentence, before any epoch runs."""

import pickle
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "laws"))
from models_cases import data_set
from test_training_identify import spec, training

from ssm_study.models.scaffolds.mlp import Mlp
from ssm_study.models.scaffolds.residual import Residual
from ssm_study.refusal import BadRequest
from ssm_study.training.optimisers import Adam, Lbfgs
from ssm_study.training.saving import DurableCheckpointIO

RING_OF_FIVE = {"start": "ring", "order": 5, "real_modes": 2}
RING_OF_THREE_REAL = {"start": "ring", "real_modes": 3}
RING_BEYOND_ONE = {"start": "ring", "ring_radius": (0.9, 1.1)}
FALLING_FREQUENCIES = {"start": "ring", "ring_frequency": (1.0, 0.5)}
WRONG_SIZES = [({"order": 0}, "model.order = 0"), ({"hidden_width": 0}, "model.hidden_width = 0")]
WRONG_SLOPES = [
    ({"slope_lower": 0.0}, "model.slope_lower = 0.0"),
    ({"slope_lower": -0.1}, "model.slope_lower = -0.1"),
    ({"slope_lower": 1.0}, "slope_upper"),
    ({"slope_lower": 2.0}, "slope_upper"),
    ({"slope_upper": float("inf")}, "slope_upper"),
]
WRONG_STARTS = [
    ({"start": "guess"}, "model.start = guess"),
    (RING_OF_FIVE, "model.real_modes = 2"),
    (RING_OF_THREE_REAL, "model.real_modes = 3"),
    (RING_BEYOND_ONE, "model.ring_radius"),
    (FALLING_FREQUENCIES, "model.ring_frequency"),
]
WRONG_MODELS = WRONG_SIZES + WRONG_SLOPES + WRONG_STARTS


@pytest.mark.parametrize(("changes", "named"), WRONG_MODELS)
def test_a_model_out_of_range_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(BadRequest, match=named):
        spec(**changes)


WRONG_EPOCHS = [
    ({"max_epochs": 0}, "training.max_epochs = 0"),
    ({"patience": 0}, "training.patience = 0"),
    ({"min_gain_percent": -1.0}, "training.min_gain_percent"),
    ({"starts": 0}, "training.starts = 0"),
]
WRONG_METHODS = [
    ({"integrated_share": 1.5}, "training.integrated_share = 1.5"),
    ({"roughness_weight": -1.0}, "training.roughness_weight = -1.0"),
    ({"precision": 16}, "training.precision = 16"),
    ({"initial_state": "guess"}, "training.initial_state = guess"),
]
WRONG_TRAININGS = WRONG_EPOCHS + WRONG_METHODS


@pytest.mark.parametrize(("changes", "named"), WRONG_TRAININGS)
def test_a_training_out_of_range_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(BadRequest, match=named):
        training(**changes)


WRONG_RATES = [0.0, -0.1, float("nan"), float("inf")]


@pytest.mark.parametrize("rate", WRONG_RATES)
def test_a_learning_rate_out_of_range_is_refused(rate: float) -> None:
    with pytest.raises(BadRequest, match="learning_rate"):
        Adam(learning_rate=rate, steps_per_epoch=10, final_fraction=0.1)


def test_other_settings_out_of_range_are_refused() -> None:
    with pytest.raises(BadRequest, match="steps_per_epoch"):
        Lbfgs(steps_per_epoch=0, history=20)
    with pytest.raises(BadRequest, match="history"):
        Lbfgs(steps_per_epoch=10, history=0)
    with pytest.raises(BadRequest, match=r"scaffold\.depth"):
        Mlp(depth=0, train_slopes=True, certified=True)
    with pytest.raises(BadRequest, match=r"scaffold\.depth"):
        Residual(depth=0)


HAS_GPU = torch.cuda.is_available()


@pytest.mark.skipif(HAS_GPU, reason="a GPU is present here")
def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match=r"training\.accelerator = gpu"):
        training(accelerator="gpu").identify(spec(), data_set(), 0, tmp_path)


def test_resuming_something_else_is_refused(tmp_path: Path) -> None:
    data = data_set()
    settings = training(max_epochs=1, checkpoint_every_s=0.0)
    settings.identify(spec(), data, 0, tmp_path)
    input_scale = np.array([2.0])
    scale = replace(data.scale, input_scale=input_scale)
    wider = replace(data, scale=scale)
    ssm_spec = spec(hidden_width=9)
    changed_data = replace(data, start_up_samples=20)
    wider_model = (ssm_spec, data)
    longer_start_up = (spec(), changed_data)
    wider_scale = (spec(), wider)
    changed_requests = (wider_model, longer_start_up, wider_scale)
    for model, records in changed_requests:
        with pytest.raises(BadRequest, match="another model, training or data set"):
            settings.identify(model, records, 0, tmp_path)


def test_a_damaged_or_evil_checkpoint_is_refused(tmp_path: Path) -> None:
    settings = training(max_epochs=1, checkpoint_every_s=0.0)
    data = data_set()
    settings.identify(spec(), data, 0, tmp_path)
    last = tmp_path / "last.ckpt"
    content = last.read_bytes()
    first_part = content[:1000]
    last.write_bytes(first_part)
    with pytest.raises(BadRequest, match="unreadable"):
        settings.identify(spec(), data, 0, tmp_path)
    marker = tmp_path / "ran"
    state = Evil(str(marker))
    checkpoint = {"state": state}
    DurableCheckpointIO().save_checkpoint(checkpoint, last)  # in good order but for its content
    with pytest.raises(pickle.UnpicklingError, match="weights_only"):
        DurableCheckpointIO().load_checkpoint(last, weights_only=False)
    with pytest.raises(BadRequest, match="unreadable"):
        settings.identify(spec(), data, 0, tmp_path)
    assert not marker.exists()
    torch.load(last, weights_only=False)
    assert marker.exists(), "the trap does not work"


class Evil:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path(self.path),))
