"""Findings that speak against a judgement of the plant. Each is one sentence with its number and
what to do, at one of three levels."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ssm_study.models.metrics import Simulation
from ssm_study.models.structured import Model
from ssm_study.signals import DataSet, Trajectories, Trajectory, lagged

Level = Literal["note", "doubt", "cannot judge"]
SOUND = "sound"
DOUBT = "doubt"
CANNOT_JUDGE = "cannot judge"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One sentence about the records with its severity. A `note` leaves the evidence sound, a
    `doubt` qualifies a prediction, `cannot judge` forbids one.

    Levels follow size, never a p-value alone: every free run of a nonlinear plant fails a whiteness
    test.
    """

    level: Level
    sentence: str


Inputs = Float[np.ndarray, "T m"]
Outputs = Float[np.ndarray, "T p"]
ScoredRecord = tuple[Inputs, Outputs, Outputs]
ScaledRecord = tuple[Inputs, Outputs]


@dataclass(frozen=True, kw_only=True)
class Case:
    """Data set, model and records whose evidence is judged. Case to be judged: the records, and
    the model's free runs of validation and test."""

    data: DataSet
    model: Model
    validation: Simulation
    test: Simulation

    def scaled(self, record: Trajectory) -> ScaledRecord:
        """Input and output of a record as deviations from the equilibrium, scaled."""
        scale = self.data.scale
        return scale.scaled_input(record.u), scale.scaled_output(record.y)

    def driven(self, record: Trajectory) -> ScaledRecord:
        """Scaled record with measured disturbances as further inputs. `scaled`, with measured
        disturbances beside the input: all that moves the output."""
        scale = self.data.scale.with_disturbances_as_inputs()
        return scale.scaled_input(record.driven_by), scale.scaled_output(record.y)

    def regression(
        self, records: Trajectories, lags: int
    ) -> tuple[Float[np.ndarray, "K d"], Float[np.ndarray, "K p"]]:
        """Regression of the output on past inputs. Rows `(u[k], ..., u[k - lags], 1)` beside
        `y[k]`, scaled, of the records longer than twice the lags."""
        scale = self.data.scale
        inputs = [np.empty((lags, scale.inputs))]  # of these no row follows
        outputs = [np.empty((lags, scale.outputs))]
        for record in records:
            if len(record) > 2 * lags:
                u, y = self.scaled(record)
                inputs.append(u)
                outputs.append(y)
        past = np.concatenate([lagged(u, lags) for u in inputs])
        return past, np.concatenate([y[lags:] for y in outputs])

    def scored(self) -> Iterator[ScoredRecord]:
        """Scaled `u`, `y` and `y - y_model` of every record of validation, then of test. Start-up
        samples are left out."""
        for part in (self.validation, self.test):
            start = part.start_up_samples
            for record, simulated in zip(part.records, part.simulated, strict=True):
                u, y = self.scaled(record)
                error = (record.y - simulated) / self.data.scale.output_scale
                yield u[start:], y[start:], error[start:]


def note(sentence: str) -> Finding:
    """Construct a finding of level `note`."""
    return Finding(level="note", sentence=sentence)


def doubt(sentence: str) -> Finding:
    """Construct a finding of level `doubt`."""
    return Finding(level="doubt", sentence=sentence)


def finding_by_size(size: float, doubtful: float, hopeless: float, sentence: str) -> list[Finding]:
    """Finding whose level depends on the size of a number. A doubt from `doubtful` on, `cannot
    judge` from `hopeless` on, nothing below."""
    if size >= hopeless:
        return [Finding(level="cannot judge", sentence=sentence)]
    return [doubt(sentence)] if size >= doubtful else []
