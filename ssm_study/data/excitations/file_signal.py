"""Excitation signal that the user supplies in a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.channel_names import Names, as_name_tuple
from ssm_study.data.excitations.excitation import Excitation, SignalRequest
from ssm_study.data.readers.reader import read_table
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class FileSignal(Excitation):
    """Excitation signal that is read from a file of the user. One column per input, with offsets
    from the equilibrium in the input's unit; one row per sampling period.

    Records shorter than the file start at a random row of it. `amplitude` None takes the values as
    they are; a number scales each column to that peak.
    """

    kind = "file"

    path: str
    column: Names

    def signal(self, request: SignalRequest, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
        values = self._read_columns(request)
        if self.amplitude is not None:
            largest = np.abs(values).max(axis=0)
            amplitude = np.array(self._apply_own_amplitude_and_clock(request).amplitude)
            values = values / largest * amplitude
        start = int(rng.integers(len(values) - request.samples + 1))
        return values[start : start + request.samples]

    def unit_signal(
        self, request: SignalRequest, rng: np.random.Generator
    ) -> Float[np.ndarray, "T m"]:
        u = self.signal(request, rng)
        return u / np.abs(u).max(axis=0)

    def _read_columns(self, request: SignalRequest) -> Float[np.ndarray, "T2 m"]:
        """Read one column of the user's excitation file for every input, and check the number of
        rows."""
        names = as_name_tuple(self.column)
        problem = f"the plant has {request.inputs} inputs"
        require(
            len(names) == request.inputs,
            "excitation.column",
            names,
            problem,
            "name one column per input",
        )
        table = read_table(Path(self.path), dict.fromkeys(names, ""))
        columns = [table.columns[name] for name in names]
        values = np.stack(columns, axis=1)
        problem = f"has {len(values)} rows, fewer than the {request.samples} samples of a record"
        remedy = "lengthen the file, or shorten data.samples"
        require(len(values) >= request.samples, "excitation.path", self.path, problem, remedy)
        for name, column in zip(names, values.T, strict=True):
            require(
                float(np.ptp(column)) > 0,
                f"{self.path}, column {name}",
                column[0],
                "constant",
                "vary it",
            )
        return values
