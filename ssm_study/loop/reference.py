"""References that the output should follow: signals like disturbances, of offsets from rest, the
same for every output."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.plants.disturbance import Disturbance, NoDisturbance
from ssm_study.refusal import BadRequest, require

Reference = Disturbance


class Rest(NoDisturbance):
    """`r = y_eq`: bring the plant to rest."""


@dataclass(frozen=True, kw_only=True)
class StepReference(Reference):
    """`r = before` until `at_s`, then `after`."""

    before: float
    after: float
    at_s: float

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.where(time_s < self.at_s - 1e-12, float(self.before), float(self.after))


@dataclass(frozen=True, kw_only=True)
class FileReference(Reference):
    """Two columns of a CSV file, time (s) and offset, joined by straight lines and held at both
    ends."""

    path: str

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        remedy = "give a CSV file of two columns, time in seconds and offset"
        try:
            lines = [
                line
                for line in Path(self.path).read_text(encoding="utf-8").splitlines()
                if line.strip()
            ]
            table = (
                np.loadtxt(lines, delimiter=",", ndmin=2, comments="#")
                if lines
                else np.empty((0, 2))
            )
        except (OSError, ValueError) as error:
            raise BadRequest(
                "loop.reference.path", self.path, " ".join(str(error).split())[:120], remedy
            ) from error
        sound = table.shape[1:] == (2,) and len(table) > 0 and bool(np.isfinite(table).all())
        require(
            sound, "loop.reference.path", self.path, "not two columns of finite numbers", remedy
        )
        rising = bool((np.diff(table[:, 0]) > 0).all())
        require(
            rising,
            "loop.reference.path",
            self.path,
            "times do not increase",
            "sort the rows by time",
        )
        return np.interp(time_s, *table.T)
