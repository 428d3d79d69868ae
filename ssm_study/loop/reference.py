"""Reference signals for the output, as offsets from the equilibrium over time, the same for every
output."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.plants.disturbance import Disturbance, NoDisturbance
from ssm_study.refusal import BadRequest, require

Reference = Disturbance
Times = Float[np.ndarray, "T"]

FIELD = "loop.reference.path"
REMEDY = "give a CSV file of two columns, time in seconds and offset"


class EquilibriumReference(NoDisturbance):
    """Constant reference at the equilibrium output."""


@dataclass(frozen=True, kw_only=True)
class StepReference(Reference):
    """Reference with a step at a given time. `r = before` until `at_s`, then `after`."""

    before: float
    after: float
    at_s: float

    def signal(self, time_s: Times) -> Times:
        """Step reference as offsets from the equilibrium at given times."""
        is_before = time_s < self.at_s - 1e-12
        before = float(self.before)
        after = float(self.after)
        return np.where(is_before, before, after)


@dataclass(frozen=True, kw_only=True)
class FileReference(Reference):
    """Reference that is read from a CSV file with two columns: time in seconds, and offset from the
    equilibrium.

    Straight lines join the rows; both ends are held.
    """

    path: str

    def signal(self, time_s: Times) -> Times:
        """Reference from a file, as offsets from the equilibrium interpolated at given times."""
        try:
            table = self._read_file()
        except (OSError, ValueError) as error:
            words = str(error).split()
            problem = " ".join(words)[:120]
            raise BadRequest(FIELD, self.path, problem, REMEDY) from error
        row_shape = table.shape[1:]
        has_two_columns = row_shape == (2,) and len(table) > 0
        is_sound = has_two_columns and bool(np.isfinite(table).all())
        require(is_sound, FIELD, self.path, "not two columns of finite numbers", REMEDY)
        time_steps = np.diff(table[:, 0])
        is_rising = bool((time_steps > 0).all())
        require(is_rising, FIELD, self.path, "times do not increase", "sort the rows by time")
        return np.interp(time_s, *table.T)

    def _read_file(self) -> Float[np.ndarray, "rows columns"]:
        """Read the times and offsets of a reference from its CSV file."""
        reference_file = Path(self.path)
        text = reference_file.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if line.strip()]
        if not lines:
            return np.empty((0, 2))
        return np.loadtxt(lines, delimiter=",", ndmin=2, comments="#")
