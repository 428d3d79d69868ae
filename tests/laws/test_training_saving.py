"""An interrupted training goes on where it stopped; numbers that leave the finite end it in good order."""

from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from models_cases import data_set
from test_training_identify import LBFGS, spec, training

from ssm_study.training import training as room
from ssm_study.training.checkpoint import DurableCheckpointIO
from ssm_study.training.fit import Fit
from ssm_study.training.optimisers import Adam, OptimiserSpec


class Interrupt(Callback):
    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        if trainer.current_epoch == self.epoch:
            raise InterruptedError("killed here")


@pytest.mark.parametrize("optimiser", [LBFGS, Adam(learning_rate=0.02, steps_per_epoch=5, final_fraction=0.1)])
def test_a_killed_training_resumes_to_the_same_model(
    optimiser: OptimiserSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, settings = data_set(noise=0.05), training(optimiser, max_epochs=8, checkpoint_every_s=0.0)
    whole = settings.identify(spec(), data, 0, tmp_path / "whole")
    make = room.Training._trainer
    with monkeypatch.context() as patch:
        patch.setattr(room.Training, "_trainer", lambda self, calls, folder: make(self, [*calls, Interrupt(3)], folder))
        with pytest.raises(InterruptedError):
            settings.identify(spec(), data, 0, tmp_path / "broken")
    resumed = settings.identify(spec(), data, 0, tmp_path / "broken")
    assert resumed.model.to_json() == whole.model.to_json()
    assert [row["epoch"] for row in resumed.curve] == [row["epoch"] for row in whole.curve]


def test_a_loss_that_is_not_finite_stops_with_the_last_good_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, steps = data_set(noise=0.05), iter(range(10_000))
    step = Fit.training_step

    def poisoned(self: Fit, batch: object, batch_idx: int) -> torch.Tensor:
        loss = step(self, batch, batch_idx)
        return loss * float("nan") if next(steps) >= 20 else loss

    monkeypatch.setattr(Fit, "training_step", poisoned)
    adam = Adam(learning_rate=0.02, steps_per_epoch=5, final_fraction=0.1)
    found = training(adam).identify(spec(), data, 0, tmp_path)
    assert "not finite" in found.ended
    assert "learning rate" in found.ended
    assert found.fit_training_percent > 50.0


def test_a_write_that_fails_keeps_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    io, path = DurableCheckpointIO(), tmp_path / "last.ckpt"
    io.save_checkpoint({"epoch": 1}, path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        io.save_checkpoint({"epoch": 2}, path)
    assert io.load_checkpoint(path) == {"epoch": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]
