"""Windows into which training records are cut."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require, require_at_least, require_positive
from ssm_study.signals import Trajectories, Trajectory

if TYPE_CHECKING:
    from ssm_study.models.initial_system import Pairs


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Settings that cut training records into windows of equal length. `samples=None` leaves
    records whole.

    Multiple shooting: the first window of a record starts as the record does, the state `s_i` at
    the start of each later window is a parameter, and the objective gains
    `continuity_weight mean_j (sum_i d_ij^2 / sum_i x_ij^2)` with the defect `d_i = x_i - s_i`,
    `x_i` the state in which the window before ends, state by state j. Source: Bock & Plitt (1984);
    Ribeiro, Tiels, Umenberger, Schön & Aguirre (2020) for its effect on smoothness.
    """

    samples: int | None = None
    continuity_weight: float = 1.0

    def __post_init__(self) -> None:
        field = "training.windows"
        if self.samples is not None:
            require_at_least(2, f"{field}.samples", self.samples, "use 200 or so")
            require_positive(f"{field}.continuity_weight", self.continuity_weight, "use 1")

    def cut_records(self, records: Sequence[Trajectory], start_up_samples: int) -> "RecordWindows":
        """Cut the training records into windows of equal length. Raises `BadRequest` if a record is
        shorter than a window, or its start-up samples fill one."""
        if self.samples is None:
            unscored = (start_up_samples,) * len(records)
            whole_records = tuple(records)
            record_count = len(records)
            numbers = tuple(range(record_count))
            return RecordWindows(whole_records, unscored, numbers)
        self._refuse_short_records(records, start_up_samples)
        pieces: list[Trajectory] = []
        unscored_samples: list[int] = []
        first: list[int] = []
        for record in records:
            first.append(len(pieces))
            for start in range(0, len(record), self.samples):
                name = f"{record.name}[{start}]"
                piece = record[start : start + self.samples]
                named_piece = replace(piece, name=name)
                pieces.append(named_piece)
                unscored_piece = max(0, start_up_samples - start)
                unscored_samples.append(unscored_piece)
        all_pieces = tuple(pieces)
        first_windows = tuple(first)
        return RecordWindows(all_pieces, tuple(unscored_samples), first_windows)

    def _refuse_short_records(self, records: Sequence[Trajectory], start_up_samples: int) -> None:
        """Raise `BadRequest` for training records that are shorter than a training window."""
        assert self.samples is not None
        field = "training.windows.samples"
        shortest = min(records, key=len)
        problem = f"the record {shortest.name} has only {len(shortest)} samples"
        remedy = "shorten the windows or use null"
        require(self.samples <= len(shortest), field, self.samples, problem, remedy)
        problem = f"the {start_up_samples} start-up samples leave nothing to score"
        fits = self.samples > start_up_samples
        require(fits, field, self.samples, problem, "lengthen the windows")


@dataclass(frozen=True)
class RecordWindows:
    """Windows cut from the training records, and how many samples at each window's beginning do not
    count in the error. `first` says which windows begin a record."""

    pieces: Trajectories
    unscored: tuple[int, ...]
    first: tuple[int, ...]

    @property
    def continuing_window_indices(self) -> list[int]:
        """Indices of the training windows that continue an earlier window of the same record."""
        window_count = len(self.pieces)
        all_windows = set(range(window_count))
        return sorted(all_windows - set(self.first))


def pad_records(pairs: "Pairs") -> tuple[Float[np.ndarray, "e T m"], Float[np.ndarray, "e T p"]]:
    """Pad records with zeros at their ends to a common length."""
    lengths = (len(u) for u, _ in pairs)
    longest = max(lengths)
    inputs = [pad_with_zeros(u, longest) for u, _ in pairs]
    outputs = [pad_with_zeros(y, longest) for _, y in pairs]
    all_inputs = np.stack(inputs)
    all_outputs = np.stack(outputs)
    return all_inputs, all_outputs


def pad_with_zeros(values: Float[np.ndarray, "T c"], samples: int) -> Float[np.ndarray, "T2 c"]:
    """Pad a signal with zeros at its end to a given length."""
    missing_samples = samples - len(values)
    rows_after = (0, missing_samples)
    return np.pad(values, (rows_after, (0, 0)))
