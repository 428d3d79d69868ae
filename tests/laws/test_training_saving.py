"""An interrupted training goes on where it stopped; numbers that leave the finite end it in good
order."""

import errno
import itertools
import os
import random
import signal
import time
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from models_cases import data_set
from test_engine_faults import FailingDisk
from test_training_identify import LBFGS, spec, training

from ssm_study.training import saving as room
from ssm_study.training.fit import TorchFit
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.optimisers import Adam, OptimiserSpec
from ssm_study.training.saving import BestModelCheckpoint, DurableCheckpointIO


class Interrupt(Callback):
    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        if trainer.current_epoch == self.epoch:
            raise InterruptedError("killed here")


@pytest.mark.parametrize(
    "optimiser", [LBFGS, Adam(learning_rate=0.02, steps_per_epoch=5, final_fraction=0.1)]
)
def test_a_killed_training_resumes_to_the_same_model(
    optimiser: OptimiserSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = data_set(noise=0.05)
    settings = training(optimiser, max_epochs=8, checkpoint_every_s=0.0)
    whole = settings.identify(spec(), data, 0, tmp_path / "whole")
    make = room.build_trainer
    with monkeypatch.context() as patch:
        patch.setattr(
            room,
            "build_trainer",
            lambda told, calls, folder: make(told, [*calls, Interrupt(3)], folder),
        )
        with pytest.raises(InterruptedError):
            settings.identify(spec(), data, 0, tmp_path / "broken")
    stopped = room.read_checkpoint(last := tmp_path / "broken" / room.LAST)
    stopped["callbacks"]["BestModelCheckpoint"]["curve"][-1]["seconds"] += 100.0
    DurableCheckpointIO().save_checkpoint(stopped, last)
    resumed = settings.identify(spec(), data, 0, tmp_path / "broken")
    upper_limit = resumed.curve[-1]["seconds"]
    assert 100.0 < upper_limit < resumed.seconds, "the time before the interruption counts"
    assert resumed.model.to_json() == whole.model.to_json()
    epoches = [row["epoch"] for row in resumed.curve]
    expected = [row["epoch"] for row in whole.curve]
    assert epoches == expected


def test_a_loss_that_is_not_finite_stops_with_the_last_good_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = data_set(noise=0.05)
    steps = iter(range(10_000))
    objective = TorchFit.training_loss

    def poisoned(self: TorchFit) -> torch.Tensor:
        loss = objective(self)
        return loss * float("nan") if next(steps) >= 20 else loss

    monkeypatch.setattr(TorchFit, "training_loss", poisoned)
    adam = Adam(learning_rate=0.02, steps_per_epoch=5, final_fraction=0.1)
    found = training(adam).identify(spec(), data, 0, tmp_path)
    assert "not finite" in found.ended
    assert "learning rate" in found.ended
    assert records_fit_percent(found.model, data.training, data) > 50.0


def test_a_training_whose_nth_write_fails_goes_on_from_the_last_good_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = data_set(samples=100, noise=0.05)
    settings = training(LBFGS, max_epochs=2, checkpoint_every_s=0.0)
    model = settings.identify(spec(), data, 0, tmp_path / "whole").model
    whole = model.to_json()
    failed: set[str] = set()
    for nth, code in zip((2, 3, 4, 5, 9, 11), itertools.cycle((errno.ENOSPC, errno.EIO))):
        disk = FailingDisk(nth, code)
        folder = tmp_path / f"{nth}"
        with (
            pytest.raises(OSError, match=os.strerror(code)),
            disk.inserted(monkeypatch),
        ):  # no error of torch's own
            settings.identify(spec(), data, 0, folder)
        failed.add(disk.failed)
        for path in folder.glob("*"):
            DurableCheckpointIO().load_checkpoint(path)  # whatever is there is whole
        model = settings.identify(spec(), data, 0, folder).model
        assert model.to_json() == whole
    expected = {"open", "write", "fsync", "replace"}
    assert failed == expected


def test_a_checkpoint_is_whole_whenever_its_writer_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    rng = random.Random(0)
    seen = set()
    weights = torch.zeros(100_000)
    checkpoint = {"epoch": 0, "weights": weights}
    DurableCheckpointIO().save_checkpoint(checkpoint, path)
    for _ in range(12):
        writer = os.fork()
        if writer == 0:
            for epoch in range(10_000):
                weights = torch.full((100_000,), epoch)
                checkpoint = {"epoch": epoch, "weights": weights}
                DurableCheckpointIO().save_checkpoint(checkpoint, path)
            os._exit(0)
        before = path.stat().st_ino
        while path.stat().st_ino == before:  # it is at work
            time.sleep(0.001)
        seconds = rng.uniform(0.0, 0.03)
        time.sleep(seconds)
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        found = DurableCheckpointIO().load_checkpoint(path)
        assert (found["weights"] == found["epoch"]).all()
        seen.add(found["epoch"])
    assert len(seen) > 1
    DurableCheckpointIO().save_checkpoint({}, path)
    lefts = tmp_path.iterdir()
    names = [left.name for left in lefts]
    assert names == ["last.ckpt"]


def test_no_flipped_bit_and_no_cut_of_a_checkpoint_is_silent(tmp_path: Path) -> None:
    io = DurableCheckpointIO()
    path = tmp_path / "last.ckpt"
    rng = random.Random(0)
    silent = 0
    weights = torch.linspace(0, 1, 1000)
    checkpoint = {"weights": weights}
    io.save_checkpoint(checkpoint, path)
    whole = path.read_bytes()
    weights = torch.load(path, weights_only=True)["weights"]
    assert len(weights) == 1000  # the sum at its end is in nobody's way
    for trial in range(200):
        harmed = bytearray(whole)
        harmed[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(harmed if trial % 2 else whole[: rng.randrange(len(whole))])
        try:
            io.load_checkpoint(path)
            silent += 1
        except ValueError:
            pass
    assert silent == 0


def test_a_write_that_fails_keeps_the_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    io = DurableCheckpointIO()
    path = tmp_path / "last.ckpt"
    checkpoint = {"epoch": 1}
    io.save_checkpoint(checkpoint, path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    checkpoint = {"epoch": 2}
    with pytest.raises(OSError, match="No space"):
        io.save_checkpoint(checkpoint, path)
    checkpoint = io.load_checkpoint(path)
    assert checkpoint == {"epoch": 1}
    paths = tmp_path.iterdir()
    names = [p.name for p in paths]
    assert names == ["last.ckpt"]


def test_epochs_that_change_nothing_end_the_training() -> None:
    """Two in a row, to the last bit; a change in either fit starts the count again, and a resumed
    training knows it."""
    keeper = BestModelCheckpoint(tolerance=0.0)
    module = torch.nn.Linear(1, 1)
    for epoch, fits in enumerate(
        [(80.0, 70.0), (90.0, 75.0), (90.0, 75.0), (90.0, 75.1), (90.0, 75.1)]
    ):
        keeper.record_epoch(epoch, *fits, module)
        assert not keeper.ended
    resumed = BestModelCheckpoint(tolerance=0.0)
    state_dict = keeper.state_dict()
    resumed.load_state_dict(state_dict)
    resumed.record_epoch(5, 90.0, 75.1, module)
    assert resumed.ended == "the optimiser no longer moves"
    assert resumed.kept_training == 90.0
