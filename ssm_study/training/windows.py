"""Windows of the training records, trained on as one batch, and what ties one window to the
next."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ssm_study.refusal import at_least, require
from ssm_study.signals import Trajectories, Trajectory


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Window i of a record is its samples `[i stride, i stride + samples)`; `samples=None` leaves
    records whole.

    The first window of a record starts as the record does, later ones at rest. A positive
    `continuity_weight` is
    multiple shooting: the state `s_i` at the start of each later window is a parameter, and the
    objective gains
    `continuity_weight mean_j (sum_i d_ij^2 / sum_i x_ij^2)` with the defect `d_i = x_i - s_i`,
    `x_i` the state in which
    the window before ends, state by state j.
    Source: Bock & Plitt (1984); Ribeiro, Tiels, Umenberger, Schön & Aguirre (2020) for its effect
    on smoothness.
    """

    samples: int | None = None
    washout: int = 0
    stride: int | None = None
    continuity_weight: float = 0.0

    def __post_init__(self) -> None:
        field, weight = "training.windows", self.continuity_weight
        at_least(0, f"{field}.continuity_weight", weight, "use 0 or 1")
        if self.samples is None:
            alone = (self.washout, self.stride, weight) == (0, None, 0.0)
            require(
                alone,
                f"{field}.samples",
                None,
                "washout, stride and continuity need windows",
                "give their length",
            )
            return
        at_least(2, f"{field}.samples", self.samples, "use 200 or so")
        fits = 0 <= self.washout < self.samples
        require(
            fits,
            f"{field}.washout",
            self.washout,
            f"must lie in [0, {self.samples})",
            "leave samples to score",
        )
        stride = self.stride is None or 1 <= self.stride <= self.samples
        require(
            stride, f"{field}.stride", self.stride, f"must lie in [1, {self.samples}]", "use null"
        )
        problem = "continuity joins the end of a window to the start of the next, so they must follow each other"
        fits, remedy = weight == 0 or self.step == self.samples, "use washout 0 and stride null"
        require(fits, f"{field}.washout, stride", (self.washout, self.stride), problem, remedy)

    @property
    def step(self) -> int:
        """Samples from the start of one window to the start of the next."""
        assert self.samples is not None
        return self.stride or self.samples - self.washout

    def cut(self, records: Sequence[Trajectory], start_up_samples: int) -> "Cut":
        """Raises `BadRequest` where a record is shorter than a window, or its start-up samples fill
        one."""
        if self.samples is None:
            return Cut(
                tuple(records), (start_up_samples,) * len(records), tuple(range(len(records)))
            )
        shortest, field = min(records, key=len), "training.windows.samples"
        problem = f"the record {shortest.name} has only {len(shortest)} samples"
        require(
            self.samples <= len(shortest),
            field,
            self.samples,
            problem,
            "shorten the windows or use null",
        )
        problem = f"the {start_up_samples} start-up samples leave nothing to score"
        require(
            self.samples > start_up_samples, field, self.samples, problem, "lengthen the windows"
        )
        pieces: list[Trajectory] = []
        unscored: list[int] = []
        first: list[int] = []
        for record in records:
            first.append(len(pieces))
            last = len(record) - max(
                self.samples - self.step, self.washout
            )  # from here on nothing new to score
            for start in range(0, max(last, 1), self.step):
                pieces.append(
                    replace(record[start : start + self.samples], name=f"{record.name}[{start}]")
                )
                unscored.append(max(self.washout if start else 0, start_up_samples - start))
        return Cut(tuple(pieces), tuple(unscored), tuple(first))


@dataclass(frozen=True)
class Cut:
    """Windows in order, the samples at the start of each that are not scored, and which of them
    start a record."""

    pieces: Trajectories
    unscored: tuple[int, ...]
    first: tuple[int, ...]

    @property
    def later(self) -> list[int]:
        return sorted(set(range(len(self.pieces))) - set(self.first))
