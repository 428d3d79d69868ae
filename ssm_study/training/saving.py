"""Training of a model by PyTorch Lightning, with checkpoints and a progress line. A checkpoint of
something else is refused."""

import copy
import hashlib
import io
import logging
import math
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping
from lightning.pytorch.plugins.io import CheckpointIO
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.utils.data import DataLoader

from ssm_study.durable import write_atomically
from ssm_study.models.spec import ModelSpec
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import DataSet
from ssm_study.training.fit import TorchFit
from ssm_study.training.metrics import Identification

if TYPE_CHECKING:
    from ssm_study.training.structured_fit import StructuredFit
    from ssm_study.training.training import Training, TrainingSession

SEAL_BYTES = hashlib.sha256().digest_size
LAST = "last.ckpt"
BEST = "best.ckpt"
INTERRUPTED = "stopped by Ctrl-C"
FITS = ("fit_training_percent", "fit_validation_percent")
# One epoch without a change may be a line search that started over; two cannot leave a kink.
STILL_EPOCHS = 2


class DurableCheckpointIO(CheckpointIO):
    """Checkpoint reader and writer for Lightning whose files survive a crash. It writes beside the
    target, flushes and renames; it reads tensors and plain containers only.

    The SHA-256 of the content follows it: torch does not notice a flipped bit (and reads past the
    sum without a word). Lightning's own writer goes through TMPDIR; with that on another file
    system a full disk destroyed the old file.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | Path,
        storage_options: Any | None = None,  # noqa: ARG002
    ) -> None:
        """Write a training checkpoint so that the file survives a crash."""
        target = Path(path)
        memory = io.BytesIO()
        target.parent.mkdir(parents=True, exist_ok=True)
        # Into a file it would hide a full disk behind an error of its own.
        torch.save(checkpoint, memory)
        for left in target.parent.glob(f".{target.name}.*.tmp"):  # by a writer that was killed
            left.unlink()
        content = memory.getvalue()
        write_atomically(target, content + hashlib.sha256(content).digest())

    def load_checkpoint(
        self, path: str | Path, map_location: Any | None = None, weights_only: bool | None = True
    ) -> dict[str, Any]:  # fmt: skip
        """Read a training checkpoint from a file."""
        del weights_only  # never anything else: a checkpoint must not be able to run code
        whole = Path(path).read_bytes()
        content = whole[:-SEAL_BYTES]
        seal = whole[-SEAL_BYTES:]
        if hashlib.sha256(content).digest() != seal:
            raise ValueError("not what was written")
        device = map_location or "cpu"
        return torch.load(io.BytesIO(content), map_location=device, weights_only=True)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove the file of a training checkpoint."""
        Path(path).unlink(missing_ok=True)


def train_with_lightning(
    settings: "Training", spec: ModelSpec, data: DataSet, session: "TrainingSession"
) -> Identification:
    """Train a model with PyTorch Lightning, with checkpoints and early stopping, and return the
    best model. Epochs, checkpoints and early stopping are the same for models with and without
    torch.

    With the session's `keep_on_interrupt` Ctrl-C ends the training with the best state so far, once
    an epoch has ended; raises `KeyboardInterrupt` otherwise.
    """
    # More epochs or patience only continue a training, so a checkpoint is good for those too.
    lasting = replace(settings, max_epochs=1, patience=1)
    folder = session.folder
    belongs_to = training_fingerprint((spec, session.seed), lasting, data)
    tolerance = settings.validation_tolerance_percent
    keeper = BestModelCheckpoint(tolerance, folder, belongs_to, settings.checkpoint_every_s)
    fit = build_lightning_module(settings, spec, data, session)
    stopping = EarlyStopping(
        monitor=FITS[1],
        mode="max",
        check_finite=False,
        min_delta=settings.min_gain_percent,
        patience=settings.patience,
    )
    line = [ProgressLine(settings.max_epochs)] if session.progress else []
    # Saved is what stopping has counted.
    callbacks = [stopping, keeper, *line, RestoreSignalHandlers()]
    try:
        run_trainer(settings, fit, callbacks, folder, find_resumable_checkpoint(folder, belongs_to))
    except KeyboardInterrupt:
        if not session.keep_on_interrupt or not keeper.curve:
            raise
        keeper.ended = f"{INTERRUPTED} after {len(keeper.curve)} epochs"
    early = f"{settings.max_epochs} epochs done"
    if stopping.stopped_epoch > 0:
        early = "validation fit no longer grows"
    if keeper.kept is not None:
        checkpoint = {"state_dict": keeper.kept, "fingerprint": belongs_to}
        DurableCheckpointIO().save_checkpoint(checkpoint, folder / BEST)
        fit.load_state_dict(keeper.kept)
    model, remark = fit.trained_model_with_remark()
    how = {"seconds": keeper.training_seconds, "curve": keeper.curve}
    return Identification.from_model(model, data, ended=(keeper.ended or early) + remark, **how)


def build_lightning_module(
    settings: "Training", spec: ModelSpec, data: DataSet, session: "TrainingSession"
) -> "TorchFit | StructuredFit":
    """Build the Lightning module that trains a model with given settings."""
    if isinstance(spec, StructuredSpec):
        from ssm_study.training import structured_fit  # compiles

        prepared = structured_fit.StructuredFit(spec, data, session.seed)
        prepared.initial_parameters = session.initial_parameters.get(session.seed, {})
        return prepared
    fit = TorchFit(spec.build(data, session.seed), data, settings)
    fit.to(torch.float32 if settings.precision == 32 else torch.float64)
    return fit


def run_trainer(
    settings: "Training",
    fit: pl.LightningModule,
    callbacks: list[Callback],
    folder: Path,
    resume_from: Path | None,
) -> None:
    """Run the training of a Lightning module until a callback or the number of epochs ends it."""
    one: DataLoader = DataLoader(range(1), batch_size=1)  # type: ignore[arg-type] # the records are in the fit
    with warnings.catch_warnings():
        # Advice on Slurm, workers, loggers: of no use here.
        warnings.filterwarnings("ignore", module="lightning")
        trainer = build_trainer(settings, callbacks, folder)
        with raise_on_interrupt():
            trainer.fit(fit, one, one, ckpt_path=resume_from)


@contextmanager
def raise_on_interrupt() -> Iterator[None]:
    """Context manager in which Ctrl-C raises `KeyboardInterrupt`, as in plain Python. Lightning
    would exit with status 1, as if the training had failed, and ignore Ctrl-C from then on."""
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
    finally:
        if is_main and handler is not None:
            signal.signal(signal.SIGINT, handler)


class RestoreSignalHandlers(Callback):
    """Callback that restores the process's signal handlers, which Lightning replaces.

    Lightning turns SIGTERM into an exception of its own, which looks like an error of the run, and
    stops where submitit has asked the process to continue. Without it the process ends at once: the
    last checkpoint is there, and the same command continues the training.
    """

    numbers = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)

    def __init__(self) -> None:
        self.handlers = {number: signal.getsignal(number) for number in self.numbers}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        """Restore, as training begins, the signal handlers that Lightning has replaced."""
        if threading.current_thread() is not threading.main_thread():
            return  # neither Lightning nor we may set a handler there
        for number, handler in self.handlers.items():
            if handler is not None:  # None: not set by Python
                signal.signal(number, handler)


def build_trainer(settings: "Training", callbacks: list[Callback], folder: Path) -> pl.Trainer:
    """Build the Lightning trainer for given training settings, callbacks and folder. Raises
    `BadRequest` for an accelerator that this machine does not have."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    switched_off = ("enable_checkpointing", "enable_progress_bar", "enable_model_summary")
    options: Any = dict.fromkeys(switched_off, False)
    options |= {"devices": 1, "log_every_n_steps": 1, "num_sanity_val_steps": 0}
    options |= {"callbacks": callbacks, "default_root_dir": folder}
    options["plugins"] = [DurableCheckpointIO()]
    options["max_epochs"] = settings.max_epochs
    options["logger"] = settings.logger.build_logger(folder) or False  # its own refusals pass
    try:
        return pl.Trainer(accelerator=settings.accelerator, **options)
    except (ImportError, MisconfigurationException, RuntimeError, ValueError) as error:
        problem = "not available on this machine"
        remedy = "use training.accelerator=cpu"
        raise BadRequest("training.accelerator", settings.accelerator, problem, remedy) from error


def training_fingerprint(spec: object, settings: object, data: DataSet) -> str:
    """Hash of settings and records that shows whether a checkpoint belongs to a training."""
    scored = f"{data.scale!r} {data.start_up_samples} {data.step_s}"
    digest = hashlib.sha256(f"{spec!r} {settings!r} {scored}".encode())
    for record in (*data.training, *data.validation):
        digest.update(np.ascontiguousarray(record.inputs_and_disturbances).tobytes())
        digest.update(np.ascontiguousarray(record.y).tobytes())
    return digest.hexdigest()


def find_resumable_checkpoint(folder: Path, fingerprint: str) -> Path | None:
    """Find the checkpoint from which an interrupted training can continue; None if there is none.
    Raises `BadRequest` for a checkpoint of another training."""
    path = folder / LAST
    if not path.exists():
        return None
    is_expected = read_checkpoint(path).get("fingerprint") == fingerprint
    problem = "the checkpoint there is of another model, training or data set"
    remedy = "choose an empty folder or remove last.ckpt"
    require(is_expected, "training folder", folder, problem, remedy)
    return path


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read the content of a training checkpoint, or raise `BadRequest` if the file is damaged."""
    try:
        return DurableCheckpointIO().load_checkpoint(path)
    except Exception as error:  # torch raises anything from UnpicklingError to RuntimeError here
        problem = f"unreadable ({type(error).__name__})"
        raise BadRequest("checkpoint", path, problem, "remove it and train again") from error


class ProgressLine(Callback):
    """Callback that shows epochs, fits and remaining time of a training on one line of the
    terminal."""

    def __init__(self, max_epochs: int) -> None:
        columns = (
            TextColumn("training"),
            BarColumn(),
            TextColumn("{task.description}"),
            TimeRemainingColumn(),
        )
        console = Console(stderr=True)
        self.progress = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self.task = self.progress.add_task("", total=max_epochs)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        """Show the progress line when a training begins."""
        self.progress.start()

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        """Show the fits of the latest epoch on the progress line."""
        training, validation = (f"{trainer.callback_metrics[name]:.2f} %" for name in FITS)
        epoch = trainer.current_epoch + 1
        line = f"epoch {epoch}/{trainer.max_epochs}, fit {training}, validation {validation}"
        self.progress.update(self.task, completed=epoch, description=line)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:  # noqa: ARG002
        """Remove the progress line when a training ends."""
        self.progress.stop()


class BestModelCheckpoint(Callback):
    """Callback that stores the best model of a training, and stops the training when the loss is
    not finite or no longer changes.

    Validation fits of noisy records differ by chance: among states within `tolerance` percent
    points of the best validation fit the one with the best training fit is kept. Epochs that leave
    both fits as they were, to the last bit, end the training: a line search that fails at a kink
    fails again and again. `last.ckpt` every `every_s` s.
    """

    remembered = (
        "best_validation",
        "kept_training",
        "kept_validation",
        "kept",
        "ended",
        "seen",
        "still",
        "curve",
    )

    def __init__(
        self,
        tolerance: float,
        folder: Path = Path(),
        belongs_to: str = "",
        every_s: float = math.inf,
    ) -> None:
        self.tolerance = tolerance
        self.folder = folder
        self.belongs_to = belongs_to
        self.every_s = every_s
        self.curve: list[dict[str, float]] = []
        self.began = time.perf_counter()
        self.saved_at = time.monotonic()
        self.best_validation = self.kept_training = self.kept_validation = -math.inf
        self.kept: dict[str, Tensor] | None = None
        self.ended = ""
        self.seen = (-math.inf, -math.inf)
        self.still = 0

    def state_dict(self) -> dict[str, Any]:
        """State of the best-model callback that a checkpoint stores."""
        return {name: getattr(self, name) for name in self.remembered}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of the best-model callback from a checkpoint."""
        for name in self.remembered:
            setattr(self, name, state_dict[name])
        self.began -= self.curve[-1]["seconds"] if self.curve else 0.0  # as if it had never stopped

    @property
    def training_seconds(self) -> float:
        """Duration of the training in seconds, including the time before an interruption."""
        return time.perf_counter() - self.began

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]  # noqa: ARG002
    ) -> None:  # fmt: skip
        """Add the hash of settings and records to a training checkpoint that is being saved."""
        checkpoint["fingerprint"] = self.belongs_to

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        """Write a checkpoint at the end of an epoch if the last one is old enough."""
        if time.monotonic() - self.saved_at >= self.every_s:
            trainer.save_checkpoint(self.folder / LAST)
            self.saved_at = time.monotonic()

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        """Store the model's initial parameters as the best so far, before the first epoch."""
        if self.kept is None:  # until an epoch has ended, the starting point is the state to return
            self.kept = copy.deepcopy(pl_module.state_dict())

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Record the fits of the epoch, and store the model if it is the best so far."""
        fits = {name: float(trainer.callback_metrics[name]) for name in FITS}
        self.record_epoch(trainer.current_epoch, fits[FITS[0]], fits[FITS[1]], pl_module)
        self.curve.append(
            {"epoch": float(trainer.current_epoch), "seconds": self.training_seconds, **fits}
        )
        trainer.should_stop = trainer.should_stop or bool(self.ended)

    def record_epoch(
        self, epoch: int, training: float, validation: float, module: nn.Module
    ) -> None:
        """Record the training and validation fits of one epoch, and store the model if it is the
        best so far. `ended` says why to stop, if so."""
        if not (math.isfinite(training) and math.isfinite(validation)):
            remedy = "lower the learning rate, or start from modes further inside the unit circle"
            problem = f"the loss was not finite in epoch {epoch}"
            self.ended = f"{problem}; the last good state is kept; {remedy}"
            return
        self.still = self.still + 1 if (training, validation) == self.seen else 0
        self.seen = (training, validation)
        if self.still == STILL_EPOCHS:
            self.ended = "the optimiser no longer moves"
        self.best_validation = max(self.best_validation, validation)
        least = self.best_validation - self.tolerance
        if self.kept_validation < least or (validation >= least and training > self.kept_training):
            self.kept = copy.deepcopy(module.state_dict())
            self.kept_training = training
            self.kept_validation = validation
