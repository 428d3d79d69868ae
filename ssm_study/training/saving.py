"""Saving while training runs and resuming from what was saved; a checkpoint of something else is refused."""

import hashlib
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
from jaxtyping import Shaped
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from ssm_study.refusal import BadRequest, require
from ssm_study.signals import DataSet
from ssm_study.training.checkpoint import DurableCheckpointIO

LAST, BEST = "last.ckpt", "best.ckpt"


class Saver(Callback):
    """Writes `last.ckpt` whenever `every_s` seconds have passed, so that a killed training can go on from there."""

    def __init__(self, folder: Path, fingerprint: str, every_s: float) -> None:
        self.folder, self.fingerprint, self.every_s = folder, fingerprint, every_s
        self.saved_at = time.monotonic()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        if time.monotonic() - self.saved_at >= self.every_s:
            trainer.save_checkpoint(self.folder / LAST)
            self.saved_at = time.monotonic()

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]  # noqa: ARG002
    ) -> None:  # fmt: skip
        checkpoint["fingerprint"] = self.fingerprint


def fingerprint(spec: object, settings: object, data: DataSet) -> str:
    """What a checkpoint belongs to: model, settings and every number of the records."""
    digest = hashlib.sha256(f"{spec!r} {settings!r}".encode())
    for record in (*data.training, *data.validation):
        digest.update(np.ascontiguousarray(record.u).tobytes())
        digest.update(np.ascontiguousarray(record.y).tobytes())
    return digest.hexdigest()


def resumable(folder: Path, expected: str) -> Path | None:
    """`last.ckpt` of an interrupted training of the same thing; raises `BadRequest` if it is of something else."""
    path = folder / LAST
    if not path.exists():
        return None
    found = read(path).get("fingerprint")
    problem = "the checkpoint there is of another model, training or data set"
    require(found == expected, "training folder", folder, problem, "choose an empty folder or remove last.ckpt")
    return path


def read(path: Path) -> dict[str, Any]:
    """The checkpoint's content; raises `BadRequest` when it is damaged."""
    try:
        return DurableCheckpointIO().load_checkpoint(path)
    except Exception as error:  # torch raises anything from UnpicklingError to RuntimeError here
        problem = f"unreadable ({type(error).__name__})"
        raise BadRequest("checkpoint", path, problem, "remove it and train again") from error


def write_best(path: Path, state: dict[str, Shaped[Tensor, "..."]], belongs_to: str) -> None:
    """Seal the best state beside the fingerprint of the fit it belongs to."""
    DurableCheckpointIO().save_checkpoint({"state_dict": state, "fingerprint": belongs_to}, path)


def load_state(path: Path, module: nn.Module) -> None:
    """Load `best.ckpt` into a module of the same architecture; raises `BadRequest` for any other."""
    state, own = read(path)["state_dict"], module.state_dict()
    differing = sorted(set(state) ^ set(own)) + sorted(
        name for name in set(state) & set(own) if state[name].shape != own[name].shape
    )
    shown = ", ".join(differing[:3])
    problem = f"the checkpoint is of another architecture (differs in {shown})"
    require(not differing, "checkpoint", path, problem, "use the settings it was trained with")
    module.load_state_dict(state)
