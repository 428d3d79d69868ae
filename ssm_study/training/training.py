"""Identify a model from data: what `conf/training/*.yaml` says, and the line from specification to
stored numbers."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ssm_study.refusal import at_least, one_of, require
from ssm_study.signals import DataSet
from ssm_study.training.loggers import NoLogger
from ssm_study.training.optimisers import OptimiserSpec
from ssm_study.training.windows import Windows

if TYPE_CHECKING:
    from ssm_study.models.spec import ModelSpec
    from ssm_study.models.structured_spec import StructuredSpec
    from ssm_study.training.metrics import Identification


@dataclass(frozen=True, kw_only=True)
class Training:
    """Simulation error until validation gains less than `min_gain_percent` in `patience` epochs.

    The settings: conf/training/default.yaml. `validation_tolerance_percent`: see
    `BestModelCheckpoint`; the weights: see `penalty`; `integrated_share`: see `Records`; `windows`:
    see `Windows`. Precision 32 is polished in float64.
    """

    optimiser: OptimiserSpec
    max_epochs: int
    patience: int
    min_gain_percent: float
    validation_tolerance_percent: float
    precision: int = 64
    initial_state: str = "auto"
    roughness_weight: float = 0.0
    integrated_share: float = 0.0
    windows: Windows = field(default_factory=Windows)
    starts: int = 1
    logger: NoLogger = field(default_factory=NoLogger)
    checkpoint_every_s: float = 10.0
    accelerator: str = "cpu"

    def __post_init__(self) -> None:
        share = self.integrated_share
        require(
            0 <= share <= 1,
            "training.integrated_share",
            share,
            "is a share of the loss",
            "use 0 to 1",
        )
        for name in ("max_epochs", "patience", "starts"):
            at_least(1, f"training.{name}", getattr(self, name), "use a positive whole number")
        for name in (
            "min_gain_percent",
            "validation_tolerance_percent",
            "checkpoint_every_s",
            "roughness_weight",
        ):
            at_least(0, f"training.{name}", getattr(self, name), "use 0")
        one_of((32, 64), "training.precision", self.precision)
        one_of(("auto", "zero", "estimated"), "training.initial_state", self.initial_state)

    def identify(
        self,
        spec: "ModelSpec",
        data: DataSet,
        seed: int,
        folder: Path,
        progress: bool = False,
        keep_on_interrupt: bool = False,
    ) -> "Identification":
        """The model of `spec` fitted to `data`; `folder` receives `best.ckpt` and, while running,
        `last.ckpt`.

        With `keep_on_interrupt` Ctrl-C ends the training, and the best model so far is returned if
        there is one.
        """
        from ssm_study.models.baselines.solved import SolvedSpec
        from ssm_study.models.structured_spec import StructuredSpec
        from ssm_study.training.metrics import Identification

        began = time.perf_counter()
        if isinstance(spec, SolvedSpec):
            model = spec.solve(data)
            seconds = time.perf_counter() - began
            return Identification.of(
                model, data, seconds=seconds, curve=[], ended="solved without training"
            )
        from ssm_study.training import saving  # loads torch's compiler, as any optimiser does

        began = time.perf_counter()  # the imports are no training
        choice: list[dict[str, object]] = []
        if isinstance(spec, StructuredSpec):
            spec, choice = _chosen_by_records(spec, data, seed)
        choice_s = time.perf_counter() - began
        if isinstance(spec, StructuredSpec) and spec.neurons == 0:
            spec = spec.one_layer()
        found: list[Identification] = []
        for k in range(getattr(spec, "trainings", self.starts)):
            into = folder / f"start_{k}" if k else folder
            start = spec.at_start(k), data, seed + 1000 * k, into, progress
            try:
                found.append(saving.trained(self, *start, keep_on_interrupt))
            except KeyboardInterrupt:
                if not keep_on_interrupt or not found:
                    raise
                break
            if found[-1].ended.startswith(saving.INTERRUPTED):
                break
        rule = getattr(spec, "among_starts", None)
        best = rule(found) if rule else max(found, key=lambda one: one.fit_validation_percent)
        return replace(
            best, seconds=choice_s + sum(one.seconds for one in found), choice=tuple(choice)
        )


def _chosen_by_records(
    spec: "StructuredSpec", data: DataSet, seed: int
) -> tuple["StructuredSpec", list[dict[str, object]]]:
    """The spec with everything that is `auto` chosen by folds, and the table of what was tried."""
    from ssm_study.models.structured_spec import AUTO

    rows: list[dict[str, object]] = []
    if spec.feedthrough == AUTO:
        from ssm_study.training.path_choice import choose_feedthrough

        feedthrough, tried = choose_feedthrough(data)
        spec = replace(spec, feedthrough=feedthrough)
        rows += tried
    if spec.order == AUTO:
        from ssm_study.training.structured_choice import choose

        spec, tried = choose(spec, data, seed)
        rows += tried
    return spec, rows
