"""Data from files: one or several logs cut in time, or experiments assigned to parts one by one."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.assembly import assemble
from ssm_study.data.recording import Names, Recording, listed
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory


class RecordedSource(ABC):
    """Data that lies in files: what is read from where, and the data set it makes."""

    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """Every file that `build` reads; each exists, or `BadRequest` is raised."""

    @abstractmethod
    def build(self, seed: int) -> DataSet:
        """The data set; `seed` only names the run, for nothing here is random."""


def existing(path: Path) -> Path:
    """The path, which must be a file."""
    require(path.is_file(), "data.path", path, "no such file", "check the spelling")
    return path


@dataclass(frozen=True, kw_only=True)
class RecordedData(RecordedSource):
    """Logs of one system, each cut in time: training first, then validation, then test.

    `path` names one log or several (of any lengths); `input`, `output`, `time` name columns. `test_path` gives separate
    test logs, and nothing is then cut for the test. The equilibrium is "zero" or "mean" (of the training samples),
    unless `input_equilibrium` and `output_equilibrium` give it, one number per channel.
    `start_up_samples` at the beginning of each record are simulated, not scored: a record seldom starts at rest.
    """

    path: Names
    input: Names
    output: Names
    step_s: float | None = None
    time: str | None = None
    test_path: Names | None = None
    validation_fraction: float = 0.2
    test_fraction: float = 0.2
    start_up_samples: int = 0
    equilibrium: str = "mean"
    input_equilibrium: list[float] | None = None
    output_equilibrium: list[float] | None = None
    input_unit: Names = ""
    output_unit: Names = ""
    jitter_tolerance: float = 0.05
    resample: bool = False
    decimate: int = 1
    differentiate: bool = False

    def __post_init__(self) -> None:
        for name in ("validation_fraction", "test_fraction"):
            value = getattr(self, name)
            require(0 < value < 1, f"data.{name}", value, "not inside (0, 1)", "use 0.2 or so")
        total = self.validation_fraction + (self.test_fraction if self.test_path is None else 0.0)
        require(
            total < 1, "data.validation_fraction, data.test_fraction", total, "nothing is left to train on", "cut less"
        )
        check_recorded(self.start_up_samples, self.equilibrium)
        require(len(listed(self.path)) > 0, "data.path", self.path, "names no file", "give a path")

    def files(self) -> tuple[Path, ...]:
        return tuple(existing(Path(path)) for path in (*listed(self.path), *listed(self.test_path or ())))

    def build(self, seed: int) -> DataSet:
        logs = [self._recording(path) for path in listed(self.path)]
        read = [log.read() for log in logs]
        own_test = self.test_path is None
        parts = [_cut(record, self.validation_fraction, self.test_fraction if own_test else 0.0) for record in read]
        test = (
            [part[2] for part in parts]
            if own_test
            else [self._recording(p).read() for p in listed(self.test_path or ())]
        )
        training = _named("training", [part[0] for part in parts])
        return assemble(
            training=training,
            validation=_named("validation", [part[1] for part in parts]),
            test=_named("test", test),
            inputs=logs[0].inputs,
            outputs=logs[0].outputs,
            start_up_samples=self.start_up_samples,
            **rest_of(training, self.equilibrium, self.input_equilibrium, self.output_equilibrium),
            metadata={"source": "recorded", "path": ", ".join(listed(self.path)), "seed": str(seed)},
        )

    def _recording(self, path: str) -> Recording:
        return Recording(
            path=path,
            input=self.input,
            output=self.output,
            step_s=self.step_s,
            time=self.time,
            input_unit=self.input_unit,
            output_unit=self.output_unit,
            jitter_tolerance=self.jitter_tolerance,
            resample=self.resample,
            decimate=self.decimate,
            differentiate=self.differentiate,
        )


def check_recorded(start_up_samples: int, equilibrium: str) -> None:
    """What every kind of recorded data is asked before it is read."""
    require(start_up_samples >= 0, "data.start_up_samples", start_up_samples, "must not be negative", "use 0")
    known = ("zero", "mean")
    require(equilibrium in known, "data.equilibrium", equilibrium, f"is none of {', '.join(known)}", "use one of these")


def rest_of(
    training: tuple[Trajectory, ...], rule: str, u_given: list[float] | None, y_given: list[float] | None
) -> dict[str, Float[np.ndarray, "_"]]:
    """The equilibrium of a data set, by the rule or as given: `input_equilibrium (m,)`, `output_equilibrium (p,)`."""
    return {
        "input_equilibrium": _rest([record.u for record in training], rule, u_given, "data.input_equilibrium"),
        "output_equilibrium": _rest([record.y for record in training], rule, y_given, "data.output_equilibrium"),
    }


def _rest(
    values: list[Float[np.ndarray, "_ c"]], rule: str, given: list[float] | None, field: str
) -> Float[np.ndarray, "c"]:
    mean = np.concatenate(values).mean(axis=0)
    if given is None:
        return mean if rule == "mean" else np.zeros_like(mean)
    require(len(given) == len(mean), field, given, f"there are {len(mean)} channels", "give one number per channel")
    return np.array(given, dtype=np.float64)


def _cut(record: Trajectory, validation: float, test: float) -> tuple[Trajectory, Trajectory, Trajectory]:
    """Contiguous pieces, in the order of time."""
    first = round(len(record) * (1 - validation - test))
    second = round(len(record) * (1 - test))
    pieces = [slice(0, first), slice(first, second), slice(second, None)]
    return tuple(replace(record, u=record.u[p], y=record.y[p]) for p in pieces)  # type: ignore[return-value]  # three


def _named(part: str, records: list[Trajectory]) -> tuple[Trajectory, ...]:
    return tuple(replace(record, name=f"{part}_{k + 1}") for k, record in enumerate(records))
