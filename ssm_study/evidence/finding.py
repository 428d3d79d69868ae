"""Findings about the records and the model, each a sentence with a level of severity. Each is one
sentence with its number and what to do, at one of three levels."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ssm_study.models.metrics import Simulation
from ssm_study.models.structured import Model
from ssm_study.signals import DataSet, Trajectories, Trajectory, lagged_inputs

Level = Literal["note", "doubt", "cannot judge"]
SOUND = "sound"
DOUBT = "doubt"
CANNOT_JUDGE = "cannot judge"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One sentence about the records or the model, with its level of severity. A `note` leaves the
    evidence sound, a `doubt` qualifies a prediction, `cannot judge` forbids one.

    Levels follow size, never a p-value alone: every free run of a nonlinear plant fails a whiteness
    test.
    """

    level: Level
    sentence: str


def evidence_text(level: str, reasons: str | None, place_of_notes: str) -> str:
    """Text that states the level of the evidence (sound, doubt or cannot judge) and, for sound
    evidence, the number of notes."""
    count = len(re.findall(r"(?:^| )note: ", reasons or ""))
    if level != SOUND or not count:
        return level
    plural = "" if count == 1 else "s"
    return f"{level}, {count} note{plural} ({place_of_notes})"


Inputs = Float[np.ndarray, "T m"]
Outputs = Float[np.ndarray, "T p"]
ScoredRecord = tuple[Inputs, Outputs, Outputs]
ScaledRecord = tuple[Inputs, Outputs]


@dataclass(frozen=True, kw_only=True)
class EvidenceCase:
    """Data set, model and simulated records from which reasons to doubt predictions are sought. The
    free runs are of the validation and test records."""

    data: DataSet
    model: Model
    validation: Simulation
    test: Simulation

    def scale_record(self, record: Trajectory) -> ScaledRecord:
        """Input and output of a record in scaled units, as deviations from the equilibrium."""
        scale = self.data.scale
        return scale.scaled_input(record.u), scale.scaled_output(record.y)

    def scale_record_with_disturbances(self, record: Trajectory) -> ScaledRecord:
        """Input and output of a record in scaled units, with measured disturbances as further
        inputs."""
        scale = self.data.scale.with_disturbances_as_inputs()
        return scale.scaled_input(record.inputs_and_disturbances), scale.scaled_output(record.y)

    def fir_regression_arrays(
        self, records: Trajectories, lags: int
    ) -> tuple[Float[np.ndarray, "K d"], Float[np.ndarray, "K p"]]:
        """Regressors (past inputs) and targets (outputs) of a finite-impulse-response model of
        several records. Rows `(u[k], ..., u[k - lags], 1)` beside `y[k]`, scaled, of the records
        that are longer than twice the lags."""
        scale = self.data.scale
        inputs = [np.empty((lags, scale.inputs))]  # of these no row follows
        outputs = [np.empty((lags, scale.outputs))]
        for record in records:
            if len(record) > 2 * lags:
                u, y = self.scale_record(record)
                inputs.append(u)
                outputs.append(y)
        past = np.concatenate([lagged_inputs(u, lags) for u in inputs])
        return past, np.concatenate([y[lags:] for y in outputs])

    def scored_records(self) -> Iterator[ScoredRecord]:
        """Scaled input, output and simulation error of every validation and test record, without
        start-up samples. Start-up samples are left out."""
        for part in (self.validation, self.test):
            start = part.start_up_samples
            for record, simulated in zip(part.records, part.simulated, strict=True):
                u, y = self.scale_record(record)
                error = (record.y - simulated) / self.data.scale.output_scale
                yield u[start:], y[start:], error[start:]


def make_note(sentence: str) -> Finding:
    """Make a finding of the level `note`, which does not put a prediction in doubt."""
    return Finding(level="note", sentence=sentence)


def make_doubt(sentence: str) -> Finding:
    """Make a finding of the level `doubt`, which puts a prediction in doubt."""
    return Finding(level="doubt", sentence=sentence)


def findings_by_size(
    value: float, doubt_limit: float, rejection_limit: float, sentence: str
) -> list[Finding]:
    """Finding whose level of severity depends on the size of a number; an empty list for a small
    number. It is a doubt from `doubt_limit` on and `cannot judge` from `rejection_limit` on."""
    if value >= rejection_limit:
        return [Finding(level="cannot judge", sentence=sentence)]
    return [make_doubt(sentence)] if value >= doubt_limit else []
