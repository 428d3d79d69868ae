"""Windows of the training records, trained on as one batch, and what ties one window to the next."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ssm_study.models.torch_ssm import TorchModel
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training.objective import Records

UNMOVED = 1e-12  # scaled units, squared: a state that never moves has no size to measure its defects by


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Window i of a record is its samples `[i stride, i stride + samples)`; `samples=None` leaves records whole.

    The first window of a record starts as the record does. Later ones start at rest and their first `washout` samples
    are simulated but not scored; by default `stride = samples - washout`, so that every sample is scored once.
    A positive `continuity_weight` is multiple shooting: the state `s_i` at the start of each later window is a
    parameter, and the objective gains `continuity_weight mean_j (sum_i d_ij^2 / sum_i x_ij^2)` with the defect
    `d_i = x_i - s_i`, `x_i` the state in which the window before ends, state by state j.
    Source: Bock & Plitt (1984); Ribeiro, Tiels, Umenberger, Schön & Aguirre (2020) for its effect on smoothness.
    """

    samples: int | None = None
    washout: int = 0
    stride: int | None = None
    continuity_weight: float = 0.0

    def __post_init__(self) -> None:
        field, weight = "training.windows", self.continuity_weight
        require(0 <= weight < float("inf"), f"{field}.continuity_weight", weight, "must not be negative", "use 0 or 1")
        if self.samples is None:
            given = (self.washout, self.stride, weight)
            alone = given == (0, None, 0.0)
            require(alone, f"{field}.samples", None, "washout, stride and continuity need windows", "give their length")
            return
        require(
            self.samples >= 2, f"{field}.samples", self.samples, "a window has two samples or more", "use 200 or so"
        )
        fits = 0 <= self.washout < self.samples
        require(fits, f"{field}.washout", self.washout, f"must lie in [0, {self.samples})", "leave samples to score")
        stride = self.stride is None or 1 <= self.stride <= self.samples
        require(stride, f"{field}.stride", self.stride, f"must lie in [1, {self.samples}]", "use null")
        joined = self.step == self.samples
        remedy = "use washout 0 and stride null"
        problem = "continuity joins the end of a window to the start of the next, so they must follow each other"
        require(weight == 0 or joined, f"{field}.washout, stride", (self.washout, self.stride), problem, remedy)

    @property
    def step(self) -> int:
        """Samples from the start of one window to the start of the next."""
        assert self.samples is not None
        return self.stride or self.samples - self.washout

    def continuity(self, cut: "Cut") -> "Continuity | None":
        joined = self.continuity_weight > 0 and cut.later
        return Continuity(torch.tensor(cut.later), self.continuity_weight) if joined else None

    def cut(self, records: Sequence[Trajectory], start_up_samples: int) -> "Cut":
        """Raises `BadRequest` where a record is shorter than a window, or its start-up samples fill one."""
        if self.samples is None:
            return Cut(tuple(records), (start_up_samples,) * len(records), tuple(range(len(records))))
        shortest = min(records, key=len)
        problem = f"the record {shortest.name} has only {len(shortest)} samples"
        remedy = "shorten the windows or leave them out (null)"
        require(self.samples <= len(shortest), "training.windows.samples", self.samples, problem, remedy)
        room = self.samples > start_up_samples
        problem = f"the {start_up_samples} start-up samples leave nothing to score"
        require(room, "training.windows.samples", self.samples, problem, "lengthen the windows")
        pieces: list[Trajectory] = []
        unscored: list[int] = []
        first: list[int] = []
        for record in records:
            first.append(len(pieces))
            last = len(record) - max(self.samples - self.step, self.washout)  # from here on nothing new to score
            for start in range(0, max(last, 1), self.step):
                stop = start + self.samples
                pieces.append(_part(record, start, stop))
                unscored.append(max(self.washout if start else 0, start_up_samples - start))
        return Cut(tuple(pieces), tuple(unscored), tuple(first))


@dataclass(frozen=True)
class Cut:
    """Windows in order, the samples at the start of each that are not scored, and which of them start a record."""

    pieces: tuple[Trajectory, ...]
    unscored: tuple[int, ...]
    first: tuple[int, ...]

    @property
    def later(self) -> list[int]:
        return sorted(set(range(len(self.pieces))) - set(self.first))

    def records(self, data: DataSet, sorts: bool, integrated_share: float) -> Records:
        return Records(self.pieces, data, sorts, integrated_share, self.unscored)


class Starts(nn.Module):
    """The states `(e, n)` that windows start from: rest, but for the rows that are parameters."""

    rows: Tensor
    first: Tensor

    def __init__(self, cut: Cut, rows: Sequence[int], values: Float[Tensor, "e n"]) -> None:
        super().__init__()
        self.count = len(cut.pieces)
        self.register_buffer("rows", torch.tensor(rows, dtype=torch.int64), persistent=False)
        self.register_buffer("first", torch.tensor(cut.first, dtype=torch.int64), persistent=False)
        self.free = nn.Parameter(values[self.rows].clone())

    def forward(self) -> Float[Tensor, "e n"]:
        return self.free.new_zeros(self.count, self.free.shape[1]).index_copy(0, self.rows, self.free)

    def of_records(self) -> Float[Tensor, "r n"]:
        """What each whole record starts from."""
        return self.forward()[self.first]


class Continuity(nn.Module):
    """The defects of multiple shooting as residuals whose squared sum is the penalty, see `Windows`."""

    later: Tensor

    def __init__(self, later: Int[Tensor, "k"], weight: float) -> None:
        super().__init__()
        self.weight = weight
        self.register_buffer("later", later, persistent=False)

    def forward(self, ends: Float[Tensor, "e n"], starts: Float[Tensor, "e n"]) -> Float[Tensor, "k n"]:
        reached = ends[self.later - 1]
        size = (reached.square().sum(0) + UNMOVED) * reached.shape[1] / self.weight
        return (reached - starts[self.later]) / torch.sqrt(size)


@torch.no_grad()
def simulated_states(model: TorchModel, records: Records, cut: Cut) -> Float[Tensor, "e n"]:
    """The state of a simulation of the whole records from rest at each window's start: shooting begins without defects.

    Records start at rest too: an estimate by the untrained model is far off in slow modes, and traps the optimiser.
    """
    states = records.u.new_zeros(len(cut.pieces), model.states)
    for later in cut.later:
        states[later] = model.advance(records.u[later - 1 : later], states[later - 1 : later])[1][0]
    return states


def _part(record: Trajectory, start: int, stop: int) -> Trajectory:
    part = slice(start, stop)
    return Trajectory(u=record.u[part], y=record.y[part], step_s=record.step_s, name=f"{record.name}[{start}]")
