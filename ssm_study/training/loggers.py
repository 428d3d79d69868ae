"""Loggers that may record the training curve in further formats. Each yaml of the group
`training/logger` is one of these."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ssm_study.refusal import BadRequest

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger


@dataclass(frozen=True, kw_only=True)
class NoLogger:
    """Setting of a training without a logger for its training curve. Other loggers are Lightning's
    and write below the training's own folder."""

    def build_logger(self, folder: Path) -> "Logger | None":  # noqa: ARG002 - nothing is written
        """Build the logger of a training curve; None for the setting without a logger."""
        return None


@dataclass(frozen=True, kw_only=True)
class Csv(NoLogger):
    """Setting that writes the training curve to a CSV file. One row per epoch in
    `csv/metrics.csv`."""

    def build_logger(self, folder: Path) -> "Logger":
        from lightning.pytorch.loggers import CSVLogger

        return CSVLogger(folder, name="csv", version="")


@dataclass(frozen=True, kw_only=True)
class TensorBoard(NoLogger):
    """Setting that writes the training curve for TensorBoard. Event files in `tensorboard/`; needs
    the extra `tensorboard`."""

    def build_logger(self, folder: Path) -> "Logger":
        from lightning.pytorch.loggers import TensorBoardLogger

        try:
            return TensorBoardLogger(folder, name="tensorboard", version="")
        except ImportError as error:
            remedy = "pip install 'ssm-study[tensorboard]'"
            raise BadRequest("training.logger", "tensorboard", "not installed", remedy) from error
