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
    """Event files in `tensorboard/`; extra `tensorboard`."""

    def build(self, folder: Path) -> Logger:
        try:
            return TensorBoardLogger(folder, name="tensorboard", version="")
        except ImportError as error:
            raise BadRequest(
                "training.logger", "tensorboard", "not installed", "pip install 'ssm-study[tensorboard]'"
            ) from error


@dataclass(frozen=True, kw_only=True)
class Mlflow(LoggerSpec):
    """A run of `experiment` at `tracking_uri`, by default in `mlflow.db` of the training's folder; extra `mlflow`."""

    tracking_uri: str | None
    experiment: str

    def build(self, folder: Path) -> Logger:
        address, own = self.tracking_uri, folder.absolute()
        try:
            logger = MLFlowLogger(
                experiment_name=self.experiment,
                tracking_uri=address or f"sqlite:///{own / 'mlflow.db'}",
                artifact_location=None if address else (own / "mlflow").as_uri(),
            )
            _ = logger.run_id  # reaches the tracker, which may refuse
        except ImportError as error:
            remedy = "pip install 'ssm-study[mlflow]'"
            raise BadRequest("training.logger", "mlflow", "not installed", remedy) from error
        except Exception as error:  # MlflowException is not importable without mlflow
            problem, remedy = f"the tracker refuses: {str(error).split('. ')[0]}", "use null or sqlite:///FILE"
            raise BadRequest("training.logger.tracking_uri", address, problem, remedy) from error
        return logger
