"""Rehearsals of a test that must not be opened: a servo fitted to the training record repeats its
motion, disturbed."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rehearsal.servo import Servo, fitted, tracked
from ssm_study.data.experiments import RecordedExperiments, find_record_file
from ssm_study.data.recorded import RecordedSource
from ssm_study.data.recording import Recording, decimate_record
from ssm_study.refusal import require, require_at_least
from ssm_study.signals import DataSet, Trajectory


@dataclass(frozen=True, kw_only=True)
class Rehearsal(RecordedSource):
    """Training and validation of `experiments`, tested on `rehearsals` simulated records; its test
    files stay closed.

    A `Servo` is fitted to the first training record and put under that record's controller (`kp`,
    `kv`) and `reference` column. Each rehearsal adds its own `pulses` voltage pulses of `pulse_s`
    at random times, uniform within plus and minus the largest voltage of the training record:
    inputs that the training record does not contain.
    """

    experiments: RecordedExperiments
    reference: str
    kp: float
    kv: float
    force_per_volt: float
    rehearsals: int = 4
    pulses: int = 50
    pulse_s: float = 0.02

    def __post_init__(self) -> None:
        for name in ("rehearsals", "pulses"):
            value = getattr(self, name)
            require_at_least(1, f"data.{name}", value, "use a positive whole number")
        one = (
            len(self.experiments.training[0].inputs)
            == len(self.experiments.training[0].outputs)
            == 1
        )
        require(
            one,
            "data.experiments",
            "several channels",
            "a servo has one voltage and one position",
            "name them",
        )

    def data_files(self) -> tuple[Path, ...]:
        return self._closed().data_files()

    def build(self, seed: int) -> DataSet:
        data = self._closed().build(seed)
        fine = self._build_record()
        recording = self.experiments.training[0]
        servo = fitted(fine.u[:, 0], fine.y[:, 0], fine.step_s, self.force_per_volt)
        test = tuple(
            self._rehearsed(servo, fine, recording.decimate, k) for k in range(self.rehearsals)
        )
        about = {
            "held_out": f"{self.rehearsals} rehearsals on a servo fitted to the training record"
        }
        return replace(data, test=test, metadata=data.metadata | about)

    def _closed(self) -> RecordedExperiments:
        """The experiments with their training records in the place of the test."""
        return replace(self.experiments, test=self.experiments.training)

    def _build_record(self, **changes: str) -> Trajectory:
        recording: Recording = replace(self.experiments.training[0], decimate=1, **changes)
        return replace(
            recording, path=str(find_record_file(self.experiments.records_folder(), recording.path))
        ).read_experiment()

    def _rehearsed(self, servo: Servo, fine: Trajectory, every: int, k: int) -> Trajectory:
        reference = self._build_record(output=self.reference).y[:, 0]
        rng = np.random.default_rng(k)
        disturbance = self._pulses(np.abs(fine.u).max(), len(fine), fine.step_s, rng)
        volt, position = tracked(servo, reference, disturbance, (self.kp, self.kv), fine.step_s)
        u, y = decimate_record(volt[:, None], position[:, None], every)
        return Trajectory(u=u, y=y, step_s=fine.step_s * every, name=f"rehearsal_{k + 1}")

    def _pulses(
        self, largest: float, samples: int, step_s: float, rng: np.random.Generator
    ) -> Float[np.ndarray, "T"]:
        disturbance = np.zeros(samples)
        width = max(round(self.pulse_s / step_s), 1)
        for start in rng.integers(0, samples - width, size=self.pulses):
            disturbance[start : start + width] += rng.uniform(-largest, largest)
        return disturbance
