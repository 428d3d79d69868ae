"""Where Lightning logs the curve besides our own record: each yaml of the group `training/logger` is one of these."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger

from ssm_study.refusal import BadRequest


class LoggerSpec(ABC):
    """`build` returns Lightning's logger, writing below the training's own folder."""

    @abstractmethod
    def build(self, folder: Path) -> Logger | None: ...


@dataclass(frozen=True, kw_only=True)
class NoLogger(LoggerSpec):
    """Nothing besides our own record."""

    def build(self, folder: Path) -> Logger | None:  # noqa: ARG002 - nothing is written
        return None


@dataclass(frozen=True, kw_only=True)
class Csv(LoggerSpec):
    """One row per epoch in `csv/metrics.csv`."""

    def build(self, folder: Path) -> Logger:
        return CSVLogger(folder, name="csv", version="")


@dataclass(frozen=True, kw_only=True)
class TensorBoard(LoggerSpec):
    """Event files in `tensorboard/`; needs the package tensorboard."""

    def build(self, folder: Path) -> Logger:
        try:
            return TensorBoardLogger(folder, name="tensorboard", version="")
        except ImportError as error:
            raise BadRequest("training.logger", "tensorboard", "not installed", "pip install tensorboard") from error


@dataclass(frozen=True, kw_only=True)
class Mlflow(LoggerSpec):
    """A run of `experiment` at `tracking_uri`; needs the package mlflow."""

    tracking_uri: str
    experiment: str

    def build(self, folder: Path) -> Logger:  # noqa: ARG002 - mlflow keeps its own
        try:
            return MLFlowLogger(experiment_name=self.experiment, tracking_uri=self.tracking_uri)
        except ImportError as error:
            raise BadRequest("training.logger", "mlflow", "not installed", "pip install mlflow") from error
