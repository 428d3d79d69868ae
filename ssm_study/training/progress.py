"""What is seen and kept while training runs: a live line on a terminal, and one row of the curve per epoch."""

import time

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


class Curve(Callback):
    """One row per epoch: `epoch, seconds, fit_training_percent, fit_validation_percent`."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.started = time.perf_counter()
        self.before_s = 0.0

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        names = ("fit_training_percent", "fit_validation_percent")
        fits = {name: float(trainer.callback_metrics[name]) for name in names}
        seconds = self.before_s + time.perf_counter() - self.started
        self.rows.append({"epoch": float(trainer.current_epoch), "seconds": seconds, **fits})

    def state_dict(self) -> dict[str, object]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.rows = list(state_dict["rows"])  # type: ignore[call-overload] # written by state_dict above
        self.before_s = self.rows[-1]["seconds"] if self.rows else 0.0


class Line(Callback):
    """Epochs, fits and time left on one live line; silent where stderr is not a terminal."""

    def __init__(self, max_epochs: int) -> None:
        columns = (TextColumn("training"), BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
        console = Console(stderr=True)
        self.progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self.task = self.progress.add_task("", total=max_epochs)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        self.progress.start()

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        metrics = trainer.callback_metrics
        fits = f"fit {metrics['fit_training_percent']:.2f} %, validation {metrics['fit_validation_percent']:.2f} %"
        epoch = trainer.current_epoch + 1
        self.progress.update(self.task, completed=epoch, description=f"epoch {epoch}/{trainer.max_epochs}, {fits}")

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:  # noqa: ARG002
        self.progress.stop()
