"""The recordings of a run folder as arrays a figure can draw."""

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.mcap import SignalGroup
from ssm_study.data.mcap_reading import read_mcap
from ssm_study.refusal import require
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
    _, topics = min(_by_case(path).items())
    u, y, simulated = (_topic(topics, name, path) for name in ("input", "measured", "simulated"))
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
    cases = [topics for case, topics in sorted(_by_case(path).items()) if case]
    require(len(cases) > 0, "closed_loop", path, "holds no closed-loop case", "run the study again")
    first, left_alone = cases[0], all("uncontrolled" in topics for topics in cases)
    output = _topic(first, "output", path)
    return ClosedLoop(
        time_s=output.time_s,
        reference=_topic(first, "reference", path).values,
        u=_stack(cases, "input", path),
        y=_stack(cases, "output", path),
        uncontrolled=_stack(cases, "uncontrolled", path) if left_alone else None,
        input_label=label(_topic(first, "input", path).channels[0]),
        output_label=label(output.channels[0]),
    )


def read_excitation(path: Path) -> Excitation:
    """Topics `/record_0/input`, `/record_1/input`, ... of the training records."""
    records = [topics for case, topics in sorted(_by_case(path).items()) if case]
    require(len(records) > 0, "excitation", path, "holds no training record", "run the study again")
    inputs = [_topic(topics, "input", path) for topics in records]
    return Excitation(
        u=tuple(group.values[:, 0] for group in inputs),
        step_s=float(inputs[0].time_s[1] - inputs[0].time_s[0]),
        input_label=label(inputs[0].channels[0]),
        records="training records",
    )


def label(channel: Channel) -> str:
    """`load_speed`, `rad/s` -> `Load speed (rad/s)`."""
    return f"{channel.name.replace('_', ' ').capitalize()} ({channel.unit or '–'})"


def _by_case(path: Path) -> dict[tuple[int, ...], dict[str, SignalGroup]]:
    """Groups by the numbers in their topic, then by its last word: `/case_3/output` -> `(3,)`, `output`."""
    cases: dict[tuple[int, ...], dict[str, SignalGroup]] = defaultdict(dict)
    for group in read_mcap(path)[0]:
        *parents, name = group.topic.strip("/").split("/")
        cases[tuple(int(n) for n in re.findall(r"\d+", "/".join(parents)))][name] = group
    return cases


def _topic(topics: dict[str, SignalGroup], name: str, path: Path) -> SignalGroup:
    require(name in topics, "topic", name, f"{path.name} lacks it", "run the study again")
    return topics[name]


def _stack(cases: list[dict[str, SignalGroup]], name: str, path: Path) -> Float[np.ndarray, "N T c"]:
    return np.stack([_topic(topics, name, path).values for topics in cases])
