"""Identify a model from data: what `conf/training/*.yaml` says, and the line from specification to stored numbers."""

import logging
import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import EarlyStopping
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.utils.data import DataLoader

from ssm_study.models.baseline_solved import SolvedSpec
from ssm_study.models.identified import Simulator
from ssm_study.models.spec import ModelSpec, SSMSpec
from ssm_study.models.torch_ssm import TorchModel, TorchSSM
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training.checkpoint import DurableCheckpointIO
from ssm_study.training.fit import Fit, Keeper
from ssm_study.training.identification import Identification, mean_fit
from ssm_study.training.loggers import LoggerSpec, NoLogger
from ssm_study.training.objective import Records
from ssm_study.training.optimisers import Levenberg, OptimiserSpec
from ssm_study.training.penalties import Penalties
from ssm_study.training.polish import polish
from ssm_study.training.progress import Curve, Line
from ssm_study.training.saving import BEST, Saver, fingerprint, load_state, resumable, write_best
from ssm_study.training.start_up import StartUp
from ssm_study.training.windows import Cut, Starts, Windows, simulated_states


@dataclass(frozen=True, kw_only=True)
class Training:
    """Simulation error until validation gains less than `min_gain_percent` in `patience` epochs.

    `precision` 32 trains in float32 and polishes in float64; 64 trains in float64. `initial_state` "estimated" fits
    one initial state per training record, "auto" does so where the data set has start-up samples.
    `validation_tolerance_percent`: see `Keeper`; the weights: see `Penalties`; `integrated_share`: see `Records`;
    `windows`: see `Windows`. `starts` trainings from different starting points, the best validation fit is returned.
    `accelerator` and `logger` go to Lightning.
    """

    optimiser: OptimiserSpec
    max_epochs: int
    patience: int
    min_gain_percent: float
    validation_tolerance_percent: float
    precision: int = 64
    initial_state: str = "auto"
    roughness_weight: float = 0.0
    hankel_weight: float = 0.0
    integrated_share: float = 0.0
    windows: Windows = field(default_factory=Windows)
    starts: int = 1
    logger: LoggerSpec = field(default_factory=NoLogger)
    checkpoint_every_s: float = 10.0
    accelerator: str = "cpu"

    def __post_init__(self) -> None:
        share = self.integrated_share
        require(0 <= share <= 1, "training.integrated_share", share, "is a share of the loss", "use 0 to 1")
        for name in ("max_epochs", "patience", "starts"):
            value = getattr(self, name)
            require(value >= 1, f"training.{name}", value, "must be at least one", "use a positive whole number")
        weights = ("roughness_weight", "hankel_weight")
        for name in ("min_gain_percent", "validation_tolerance_percent", "checkpoint_every_s", *weights):
            require(getattr(self, name) >= 0, f"training.{name}", getattr(self, name), "must not be negative", "use 0")
        require(self.precision in (32, 64), "training.precision", self.precision, "unknown", "use 32 or 64")
        known = self.initial_state in ("auto", "zero", "estimated")
        require(known, "training.initial_state", self.initial_state, "unknown", "use auto, zero or estimated")

    def identify(
        self, spec: ModelSpec, data: DataSet, seed: int, folder: Path, progress: bool = False
    ) -> Identification:
        """The model of `spec` fitted to `data`; `folder` receives `best.ckpt` and, while running, `last.ckpt`."""
        began = time.perf_counter()
        if isinstance(spec, SolvedSpec):
            return _scored(spec.solve(data), data, time.perf_counter() - began, [], "solved without training")
        found = [self._once(spec, data, seed, folder, progress)]
        for start in range(1, self.starts):
            again = spec.draw_start() if isinstance(spec, SSMSpec) else spec
            found.append(self._once(again, data, seed + 1000 * start, folder / f"start_{start}", progress))
        best = max(found, key=lambda one: one.fit_validation_percent)
        return replace(best, seconds=time.perf_counter() - began)

    def _once(self, spec: ModelSpec, data: DataSet, seed: int, folder: Path, progress: bool) -> Identification:
        belongs_to = self.belongs_to(spec, data, seed)
        fit = self.prepared(spec, data, seed)
        keeper, curve = self._run(fit, folder, belongs_to, progress)
        return self.concluded(fit, data, keeper, curve.rows, folder, belongs_to)

    def belongs_to(self, spec: ModelSpec, data: DataSet, seed: int) -> str:
        """What a checkpoint of this training names; more epochs or patience only continue it."""
        return fingerprint((spec, seed), replace(self, max_epochs=1, patience=1), data)

    def prepared(self, spec: ModelSpec, data: DataSet, seed: int) -> Fit:
        """The model at its starting point, with the records it will be trained and validated on."""
        fit = self._fit(spec.build(data, seed), data)
        return fit.to(torch.float32 if self.precision == 32 else torch.float64)

    def concluded(
        self, fit: Fit, data: DataSet, keeper: Keeper, rows: list[dict[str, float]], folder: Path, belongs_to: str
    ) -> Identification:
        """The kept state, stored in `folder` and scored; `seconds` is that of the last epoch."""
        if keeper.kept is not None:
            write_best(folder / BEST, keeper.kept, belongs_to)
            load_state(folder / BEST, fit)
        fit.to("cpu", torch.float64)
        if self.precision == 32 and not isinstance(self.optimiser, Levenberg):  # which leaves the penalties out
            polish(fit)
        seconds = rows[-1]["seconds"] if rows else 0.0
        return _scored(fit.model.freeze(data), data, seconds, rows, keeper.ended)

    def _fit(self, model: TorchModel, data: DataSet) -> Fit:
        sorts = not isinstance(self.optimiser, Levenberg)  # which differentiates forward
        able = sorts or model.differentiates_forward
        require(able, "training.optimiser", "levenberg", "this model has no forward derivatives", "use lbfgs or adam")
        cut = self.windows.cut(data.training, data.start_up_samples)
        records = cut.records(data, sorts, self.integrated_share)
        return Fit(
            model,
            records,
            Records(data.validation, data, sorts),
            self.optimiser,
            self.max_epochs,
            self._starts(model, data, records, cut),
            Penalties(roughness_weight=self.roughness_weight, hankel_weight=self.hankel_weight),
            self.windows.continuity(cut),
            Records(data.training, data, sorts) if cut.later else None,
            _start_up(model, data.validation, data),
        )

    def _starts(self, model: TorchModel, data: DataSet, records: Records, cut: Cut) -> Starts | None:
        moving = data.start_up_samples > 0 if self.initial_state == "auto" else self.initial_state == "estimated"
        shooting = self.windows.continuity_weight > 0
        problem, remedy = "this model has no state to start a window from", "use training.windows.washout instead"
        able = model.states > 0 or not shooting
        require(able, "training.windows.continuity_weight", self.windows.continuity_weight, problem, remedy)
        rows = [*(cut.first if moving and model.estimates_start else ()), *(cut.later if shooting else ())]
        return Starts(cut, sorted(rows), simulated_states(model, records, cut)) if rows else None

    def _run(self, fit: Fit, folder: Path, belongs_to: str, progress: bool) -> tuple[Keeper, Curve]:
        resume_from = resumable(folder, belongs_to)
        keeper, curve = Keeper(self.validation_tolerance_percent), Curve()
        stopping = EarlyStopping(
            "fit_validation_percent", self.min_gain_percent, self.patience, mode="max", check_finite=False
        )
        callbacks = [keeper, curve, stopping, Saver(folder, belongs_to, self.checkpoint_every_s)]
        one: DataLoader = DataLoader(range(1), batch_size=1)  # type: ignore[arg-type] # the records are in Fit
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="lightning")  # advice on Slurm, workers, loggers: of no use here
            trainer = self._trainer([*callbacks, *([Line(self.max_epochs)] if progress else [])], folder)
            trainer.fit(fit, one, one, ckpt_path=resume_from)
        if trainer.interrupted:
            raise KeyboardInterrupt
        if not keeper.ended:
            early = stopping.stopped_epoch > 0
            keeper.ended = "validation fit no longer grows" if early else f"{self.max_epochs} epochs done"
        return keeper, curve

    def _trainer(self, callbacks: list[pl.Callback], folder: Path) -> pl.Trainer:
        logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
        logger = self.logger.build(folder) or False
        try:
            return pl.Trainer(
                accelerator=self.accelerator,
                devices=1,
                max_epochs=self.max_epochs,
                callbacks=callbacks,
                plugins=[DurableCheckpointIO()],
                default_root_dir=folder,
                logger=logger,
                log_every_n_steps=1,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                num_sanity_val_steps=0,
            )
        except (MisconfigurationException, RuntimeError, ValueError) as error:
            raise BadRequest(
                "training.accelerator", self.accelerator, "not available on this machine", "use accelerator=cpu"
            ) from error


def _start_up(model: TorchModel, records: tuple[Trajectory, ...], data: DataSet) -> StartUp | None:
    """What `records` start from, where a free run of the stored model will estimate it."""
    return StartUp(records, data) if data.start_up_samples > 0 and isinstance(model, TorchSSM) else None


def _scored(
    model: Simulator, data: DataSet, seconds: float, curve: list[dict[str, float]], ended: str
) -> Identification:
    return Identification(
        model=model,
        fit_training_percent=mean_fit(model, data.training, data),
        fit_validation_percent=mean_fit(model, data.validation, data),
        seconds=seconds,
        curve=curve,
        ended=ended,
    )
