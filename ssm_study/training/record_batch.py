"""Scaled training records as one batch of equal lengths, and smaller batches cut out of it."""

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ssm_study.models.initial_system import Pairs
from ssm_study.refusal import require
from ssm_study.training.windows import pad_records

STILL = 0.1  # of the records' deviation: where they move less, no start is made


class RecordBatch(NamedTuple):
    """Scaled records as one batch of equal length, with shorter ones padded by zeros. `weight` is 0
    where padded, and such that `|r|^2 = (1 - fit / 100)^2`."""

    u: Float[np.ndarray, "N T m"]
    y: Float[np.ndarray, "N T p"]
    weight: Float[np.ndarray, "N T 1"]

    @classmethod
    def from_pairs(cls, pairs: Pairs) -> "RecordBatch":
        """Combine input and output records of different lengths to one batch, padded at the
        ends."""
        u, y = pad_records(pairs)
        outputs_of_records = [output for _, output in pairs]
        outputs = np.concatenate(outputs_of_records)
        mean_output = outputs.mean(axis=0)
        deviation = np.linalg.norm(outputs - mean_output)
        record_lengths = [len(record) for record, _ in pairs]
        lengths = np.array(record_lengths)
        sample_count = u.shape[1]
        sample = np.arange(sample_count)
        is_recorded = sample[None, :, None] < lengths[:, None, None]
        return cls(u=u, y=y, weight=is_recorded / deviation)

    def cut_whole_records(self, samples: int) -> "RecordBatch":
        """Smaller batch of the first whole records that together have at least a given number of
        samples. If the first is longer, its beginning is taken."""
        padded_samples = self.u.shape[1]
        count = max(1, samples // padded_samples)
        parts = (part[:count, :samples] for part in self)
        return RecordBatch(*parts)

    def cut_varying_part(self, samples: int) -> "RecordBatch":
        """Smaller batch, of given length, in which input and output vary enough for a first fit. It
        is `cut_whole_records(samples)` if they move there, else the part of one record that moves
        most. Raises `BadRequest` if none moves."""
        beginning = self.cut_whole_records(samples)
        if self._relative_variation(beginning) >= STILL:
            return beginning
        stride = max(1, samples // 2)
        firsts = range(0, self.u.shape[1], stride)
        record_count = len(self.u)
        places = product(range(record_count), firsts)
        stretches = [self._cut_stretch(*place, samples) for place in places]
        moving = max(stretches, key=self._relative_variation)
        problem = "no stretch of the training records moves in input and output"
        remedy = "log an experiment in which the input moves the output"
        movement = self._relative_variation(moving)
        require(movement > 0, "data.training", "at rest", problem, remedy)
        return moving

    def _cut_stretch(self, record: int, first: int, samples: int) -> "RecordBatch":
        """Cut a range of samples out of one record of a batch."""
        parts = (part[record : record + 1, first : first + samples] for part in self)
        return RecordBatch(*parts)

    def _relative_variation(self, stretch: "RecordBatch") -> float:
        """Standard deviation in a part of a batch relative to the whole batch, the smaller of those
        of input and output."""
        if not stretch.recorded_mask.any():
            return 0.0
        input_pair = (stretch.u, self.u)
        output_pair = (stretch.y, self.y)
        pairs = (input_pair, output_pair)
        shares = []
        for signal_inside, signal in pairs:
            values_inside = signal_inside[stretch.recorded_mask]
            inside = values_inside.std(axis=0)
            recorded_values = signal[self.recorded_mask]
            everywhere = recorded_values.std(axis=0)
            deviation = float(np.linalg.norm(everywhere))
            positive_deviation = max(deviation, 1e-300)
            shares.append(float(np.linalg.norm(inside)) / positive_deviation)
        return min(shares)

    @property
    def recorded_mask(self) -> np.ndarray:
        """For each sample of a batch, whether it was recorded rather than padded."""
        return self.weight[..., 0] > 0
