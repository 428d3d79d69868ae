"""Trainings of one architecture in one program: each keeps its own optimiser, and their evaluations are one batch.

Small models spend their time in the calls, not in the numbers. Every member runs the optimiser it would run alone,
line search and all, in a greenlet; where it asks for a loss and a gradient it waits for the others, and all are
evaluated at once. Each number is then computed by the same operations in the same order as alone.
"""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from greenlet import getcurrent, greenlet
from torch import Tensor

from ssm_study.models.spec import ModelSpec, SSMSpec
from ssm_study.models.torch_recurrence import CHUNKS_FROM_SAMPLES
from ssm_study.models.torch_ssm import TorchSSM
from ssm_study.signals import DataSet
from ssm_study.training.fit import Fit, Keeper
from ssm_study.training.identification import Identification
from ssm_study.training.loggers import NoLogger
from ssm_study.training.objective import fit_of_loss
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.stack import Stack, Vector, architecture
from ssm_study.training.training import Training
from ssm_study.training.windows import Windows


def may_train_together(training: Training, spec: ModelSpec) -> bool:
    """Whether the settings allow it: the default optimiser over whole records in float64, one start, no logger."""
    plain = isinstance(training.optimiser, Lbfgs) and isinstance(training.logger, NoLogger)
    whole = training.windows == Windows() and training.initial_state != "estimated"
    once = training.starts == 1 and training.precision == 64 and training.hankel_weight == 0
    return isinstance(spec, SSMSpec) and plain and whole and once and training.accelerator == "cpu"


def records_gain(longest: int, start_up_samples: int) -> bool:
    """Records that start at rest, shorter than those the recurrence takes in chunks: longer ones keep a core busy."""
    return longest < CHUNKS_FROM_SAMPLES and start_up_samples == 0


@dataclass(kw_only=True, eq=False)
class Member:
    """One training among several: what it would have alone, and how it stands."""

    spec: ModelSpec
    data: DataSet
    seed: int
    training: Training
    fit: Fit = field(init=False)
    vector: Vector = field(init=False)
    keeper: Keeper = field(init=False)
    optimiser: torch.optim.Optimizer = field(init=False)
    rows: list[dict[str, float]] = field(default_factory=list)
    waits: greenlet | None = None
    best: float = -math.inf
    without_gain: int = 0
    seconds: float = 0.0

    def __post_init__(self) -> None:
        began = time.perf_counter()
        self.fit = self.training.prepared(self.spec, self.data, self.seed)
        self.keeper = Keeper(self.training.validation_tolerance_percent)
        self.vector = Vector(self.fit)
        self.optimiser = self.training.optimiser.build(self.vector)
        self.seconds = time.perf_counter() - began

    def kind(self) -> Hashable:
        """Members of equal kind can share a program; None for one that shares with nobody."""
        fit = self.fit
        parts = [architecture(part) for part in (fit.model, fit.training_records, fit.validation_records)]
        longest = max(fit.training_records.u.shape[1], fit.validation_records.u.shape[1])
        gains = records_gain(longest, self.data.start_up_samples) and fit.starts is None
        return (repr(self.training), *parts) if None not in parts and gains else None

    def start_step(self) -> None:
        """One epoch of the optimiser, up to the first evaluation that it asks for."""
        program = getcurrent()
        self.waits = greenlet(lambda: self.optimiser.step(program.switch))
        self.go_on(None)

    def go_on(self, value: Tensor | None) -> None:
        assert self.waits is not None
        self.waits.switch() if value is None else self.waits.switch(value)
        if self.waits.dead:
            self.waits = None

    def see(self, validation_loss: float, seconds: float) -> None:
        """The end of an epoch, as Lightning's callbacks see it: fits in single precision, then keep, then stop."""
        self.seconds += seconds
        training, validation = (
            np.float32(fit_of_loss(loss) if math.isfinite(loss) else -math.inf)
            for loss in (self.fit.last_loss, validation_loss)
        )
        epoch = len(self.rows)
        fits = {"fit_training_percent": float(training), "fit_validation_percent": float(validation)}
        self.rows.append({"epoch": float(epoch), "seconds": self.seconds, **fits})
        self.keeper.see(epoch, float(training), float(validation), self.fit)
        gained = float(validation - np.float32(self.training.min_gain_percent)) > self.best
        self.best, self.without_gain = (float(validation), 0) if gained else (self.best, self.without_gain + 1)
        if not self.keeper.ended and self.without_gain >= self.training.patience:
            self.keeper.ended = "validation fit no longer grows"
        elif not self.keeper.ended and len(self.rows) == self.training.max_epochs:
            self.keeper.ended = f"{self.training.max_epochs} epochs done"

    def conclude(self, folder: Path, members: int) -> Identification:
        """The model, stored and scored as after a training alone."""
        began = time.perf_counter()
        belongs_to = self.training.belongs_to(self.spec, self.data, self.seed)
        found = self.training.concluded(self.fit, self.data, self.keeper, self.rows, folder, belongs_to)
        spent = self.seconds + time.perf_counter() - began
        return replace(found, seconds=spent, trained_together=members)


Ended = Callable[[Member, int], Any]


def train_together(members: Sequence[Member], ended: Ended) -> list[Member]:
    """Train members of one kind together, one kind after the other; `ended(member, members)` as soon as one is done.

    Returns those of no kind that a program can train: they are not trained. One that has nobody to share with is.
    """
    kinds: defaultdict[Hashable, list[Member]] = defaultdict(list)
    for member in members:
        kinds[member.kind()].append(member)
    unable = kinds.pop(None, [])
    for group in kinds.values():
        Program(group, ended).run()
    return unable


class Program:
    """Members of one kind, epoch by epoch until each has ended; their number shrinks as they do."""

    def __init__(self, members: Sequence[Member], ended: Ended) -> None:
        self.members, self.ended, self.number = list(members), ended, len(members)

    def run(self) -> None:
        for member in self.members:
            member.keeper.begin(member.fit)
        self._stack()
        while self.members:
            began = time.perf_counter()
            self._epoch()
            losses = self._validation_losses()
            share = (time.perf_counter() - began) / len(self.members)
            for member, loss in zip(self.members, losses, strict=True):
                member.see(loss, share)
            over = [member for member in self.members if member.keeper.ended]
            if over:
                self.members = [member for member in self.members if not member.keeper.ended]
                self._stack()
            for member in over:
                self.ended(member, self.number)

    def _stack(self) -> None:
        if self.members:
            fits = [member.fit for member in self.members]
            models = [fit.model for fit in fits if isinstance(fit.model, TorchSSM)]
            self.model = Stack(models, [member.vector for member in self.members])
            self.training = Stack([fit.training_records for fit in fits]).joint
            self.validation = Stack([fit.validation_records for fit in fits]).joint

    def _epoch(self) -> None:
        for member in self.members:
            member.start_step()
        while any(member.waits for member in self.members):
            values = self._evaluate()
            for member, value in zip(self.members, values, strict=True):
                if member.waits:
                    member.go_on(value)

    def _evaluate(self) -> list[Tensor]:
        """Each member's objective, its gradients in place, its training loss noted."""
        self.model.load()
        records, penalties = self.training, self.members[0].fit.penalties
        y_hat = records.simulate(self.model.joint)
        values = records.objective(y_hat) + penalties.of(self.model.joint)
        values.sum().backward()
        self.model.hand_back()
        losses = records.loss(y_hat.detach())
        for member, loss in zip(self.members, losses.tolist(), strict=True):
            if member.waits:
                member.fit.last_loss = loss
        return list(values.detach().unbind(0))

    @torch.no_grad()
    def _validation_losses(self) -> list[float]:
        self.model.load()
        return list(self.validation.loss(self.validation.simulate(self.model.joint)).tolist())
