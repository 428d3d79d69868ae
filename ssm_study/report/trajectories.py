"""The recordings of a run folder as arrays a figure can draw."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.results.recordings import Case, read_cases, signal, stacked
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class Validation:
    """Input, measured and simulated output of the validation record; labels name the first channel and its unit."""

    time_s: Float[np.ndarray, "T"]
    u: Float[np.ndarray, "T m"]
    y: Float[np.ndarray, "T p"]
    simulated: Float[np.ndarray, "T p"]
    input_label: str
    output_label: str

    @property
    def step_s(self) -> float:
        return float(self.time_s[1] - self.time_s[0])


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """N controlled runs, and N uncontrolled runs from the same initial states (None where there is no plant)."""

    time_s: Float[np.ndarray, "T"]
    reference: Float[np.ndarray, "T p"]
    u: Float[np.ndarray, "N T m"]
    y: Float[np.ndarray, "N T p"]
    uncontrolled: Float[np.ndarray, "N T p"] | None
    input_label: str
    output_label: str

    @property
    def step_s(self) -> float:
        return float(self.time_s[1] - self.time_s[0])

    def rest_s(self, band: float | None) -> float:
        """A little after the last response has come to rest in the band, else the whole horizon."""
        if band is None:
            return float(self.time_s[-1])
        everything = self.y if self.uncontrolled is None else np.concatenate([self.y, self.uncontrolled])
        outside = (np.abs(everything - self.reference)[:, :, 0] > band).any(axis=0)
        last = int(np.flatnonzero(outside).max(initial=0))
        return float(min(1.4 * self.time_s[last] + 5 * self.step_s, self.time_s[-1]))


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """The first input channel of each record that excited the plant; `records` says which these are."""

    u: tuple[Float[np.ndarray, "_"], ...]
    step_s: float
    input_label: str
    records: str


def read_validation(path: Path) -> Validation:
    """Topics `/input`, `/measured`, `/simulated`; of several records (`/record_0/input`, ...) the first."""
    first = next(iter(read_cases(path)[0].values()))
    u, y, simulated = (signal(first, name, path) for name in ("input", "measured", "simulated"))
    return Validation(
        time_s=y.time_s,
        u=u.values,
        y=y.values,
        simulated=simulated.values,
        input_label=label(u.channels[0]),
        output_label=label(y.channels[0]),
    )


def read_closed_loop(path: Path) -> ClosedLoop:
    """Topics `/case_0/input`, `/case_0/output`, ...; `/case_0/uncontrolled` where the plant was left alone too."""
    cases = _named(path, "closed_loop", "holds no closed-loop case")
    first, left_alone = cases[0], all("uncontrolled" in topics for topics in cases)
    output = signal(first, "output", path)
    return ClosedLoop(
        time_s=output.time_s,
        reference=signal(first, "reference", path).values,
        u=stacked(cases, "input", path),
        y=stacked(cases, "output", path),
        uncontrolled=stacked(cases, "uncontrolled", path) if left_alone else None,
        input_label=label(signal(first, "input", path).channels[0]),
        output_label=label(output.channels[0]),
    )


def read_excitation(path: Path) -> Excitation:
    """Topics `/record_0/input`, `/record_1/input`, ... of the training records."""
    inputs = [signal(record, "input", path) for record in _named(path, "excitation", "holds no training record")]
    return Excitation(
        u=tuple(group.values[:, 0] for group in inputs),
        step_s=float(inputs[0].time_s[1] - inputs[0].time_s[0]),
        input_label=label(inputs[0].channels[0]),
        records="training records",
    )


def label(channel: Channel) -> str:
    """`load_speed`, `rad/s` -> `Load speed (rad/s)`."""
    return f"{channel.name.replace('_', ' ').capitalize()} ({channel.unit or '–'})"


def _named(path: Path, field: str, problem: str) -> list[Case]:
    cases = [case for prefix, case in read_cases(path)[0].items() if prefix]
    require(len(cases) > 0, field, path, problem, "run the study again")
    return cases
