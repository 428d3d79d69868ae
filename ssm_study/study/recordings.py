"""Recordings in a run folder, and how they are written and read: simulations, measurements and
closed-loop trials."""

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.models.metrics import Simulation
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, DataSet, Trajectories, Trajectory

TRIALS = "trials.mcap"  # the records that serve the mismatch alone
LOOPS = "trials_in_loop.mcap"  # the same of trials in closed loop
NUMBER_AT_END = re.compile(r"\d+$")

Case = dict[str, SignalGroup]
Outputs = Sequence[Float[np.ndarray, "T p"]]
Signals = dict[str, tuple[tuple[Channel, ...], Float[np.ndarray, "T c"]]]
Pairs = dict[str, tuple[Any, Any]]


@dataclass(frozen=True, kw_only=True)
class RecordedCases:
    """Signals of a recording by name, each for all simulations or measurements (cases) in the
    recording. `loop["output"]` is `(N, T, c)` for N cases.

    `about` is its metadata. Cases are named by what stands before the last `/` of their topics, in
    the order of its number: `/case_3/output` is the signal `output` of the case `/case_3`; `/input`
    belongs to the one case without a name. A closed loop has reference, input, output, uncontrolled
    (the plant left alone); a record has input, measured, simulated. Raises `BadRequest` for a
    signal that a case lacks.
    """

    path: Path
    cases: dict[str, Case]
    about: dict[str, str]

    @classmethod
    def from_file(cls, path: Path) -> "RecordedCases":
        """Read the signals of a recording from an MCAP file. Raises `BadRequest` for a damaged
        file."""
        groups, about = read_mcap(path)
        cases: dict[str, Case] = defaultdict(dict)
        for group in groups:
            prefix, _, name = group.topic.rpartition("/")
            cases[prefix][name] = group
        # By number, not by text: case 10 comes after case 9.
        prefixes = sorted(cases, key=_trailing_number)
        return cls(path=path, cases={name: cases[name] for name in prefixes}, about=about)

    def signals(self, name: str) -> list[SignalGroup]:
        """Values of a named signal, one array for each simulation or measurement in a recording."""
        is_there = all(name in case for case in self.cases.values())
        require(is_there, "topic", name, f"{self.path.name} lacks it", "run the study again")
        return [case[name] for case in self.cases.values()]

    def __getitem__(self, name: str) -> Float[np.ndarray, "N T c"]:
        """Signal of all simulations in a recording as one array; all must have the same length."""
        return np.stack([signal.values for signal in self.signals(name)])

    def time_s(self, name: str) -> Float[np.ndarray, "T"]:
        """Times of the samples of a recorded signal, in seconds."""
        return self.signals(name)[0].time_s

    def step_s(self, name: str) -> float:
        """Sampling time of a recorded signal, in seconds."""
        times = self.time_s(name)
        return float(times[1] - times[0])

    def label(self, name: str) -> str:
        """Printed name of a recorded signal's first channel with its unit: `load_speed`, `rad/s` ->
        `Load speed (rad/s)`."""
        return self.labels(name)[0]

    def labels(self, name: str) -> list[str]:
        """Printed names of all channels of a recorded signal, with their units where these are
        known."""
        labels = []
        for channel in self.signals(name)[0].channels:
            words = channel.name.replace("_", " ").capitalize()
            labels.append(f"{words} ({channel.unit})" if channel.unit else words)
        return labels

    def unit(self, name: str) -> str:
        """Unit of the first channel of a recorded signal."""
        return self.signals(name)[0].channels[0].unit

    @property
    def settling_band(self) -> float:
        """Half width of the band, in the output's unit, within which a recorded closed loop counts
        as settled."""
        return float(self.about["settling_band"])

    @property
    def time_after_settling_s(self) -> float:
        """Time in seconds shortly after the last recorded closed-loop simulation has settled.

        The whole horizon where one does not.
        """
        time_s = self.time_s("output")
        responses = np.concatenate([self["output"], self["uncontrolled"]])[:, :, 0]
        distance = np.abs(responses - self["reference"][0, :, 0])
        is_outside = (distance > self.settling_band).any(axis=0)
        last = int(np.flatnonzero(is_outside).max(initial=0))
        a_little_later = 1.4 * time_s[last] + 5 * self.step_s("output")
        return float(min(a_little_later, time_s[-1]))

    @property
    def records(self) -> Trajectories:
        """Input, measured output and measured disturbances of every recorded simulation or
        measurement."""
        step_s = float(self.about["step_s"])
        names = [prefix or self.path.stem for prefix in self.cases]
        records = []
        disturbances = [case.get("disturbance") for case in self.cases.values()]
        inputs = self.signals("input")
        outputs = self.signals("measured")
        for name, u, y, measured in zip(names, inputs, outputs, disturbances, strict=True):
            d = None if measured is None else measured.values
            trajectory = Trajectory(u=u.values, y=y.values, d=d, step_s=step_s, name=name)
            records.append(trajectory)
        return tuple(records)


def _trailing_number(prefix: str) -> int:
    """Number at the end of the name of a recorded simulation or measurement; 0 if there is none."""
    number = NUMBER_AT_END.search(prefix)
    return int(number[0]) if number else 0


def signal_groups(
    prefix: str, time_s: Float[np.ndarray, "T"], signals: Signals
) -> list[SignalGroup]:
    """Signals with their sample times, as the topics of a recording."""
    groups = []
    for name, (channels, values) in signals.items():
        topic = f"{prefix}/{name}"
        groups.append(SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values))
    return groups


def write_records(
    path: Path,
    data: DataSet,
    records: Trajectories,
    *,
    outputs: bool = True,
    simulated: Outputs = (),
    **about: str,
) -> None:
    """Write records of inputs and outputs into a recording file, in physical units.

    Topics `/record_<i>/` input, measured disturbances, measured output where `outputs`, and the
    model's free run where there is one.
    """
    written: list[SignalGroup] = []
    for i, record in enumerate(records):
        signals: Signals = {"input": (data.inputs, record.u)}
        if record.d is not None:
            signals["disturbance"] = (data.disturbances, record.d)
        if outputs:
            signals["measured"] = (data.outputs, record.y)
        if simulated:
            signals["simulated"] = (data.outputs, simulated[i])
        written += signal_groups(f"/record_{i}", record.time_s, signals)
    facts = data.metadata | about | {"step_s": repr(data.step_s)}
    write_mcap(path, tuple(written), facts)


def read_mismatch_records(folder: Path) -> Trajectories:
    """Read the records that only serve to measure the model error, open loop first; empty if the
    run has no such file."""
    records: list[Trajectory] = []
    for path in (folder / TRIALS, folder / LOOPS):
        if path.is_file():
            is_closed_loop = path.name == LOOPS
            of_file = RecordedCases.from_file(path).records
            records += [replace(record, closed_loop=is_closed_loop) for record in of_file]
    return tuple(records)


def read_free_runs(path: Path) -> Simulation:
    """Read a model's free runs and the measured records from a recording file.

    Raises `BadRequest` if the file lacks a topic.
    """
    recording = RecordedCases.from_file(path)
    simulated = tuple(signal.values for signal in recording.signals("simulated"))
    start_up_samples = int(recording.about["start_up_samples"])
    states = initial_states_from_text(recording.about.get("start_states", ""), len(simulated))
    return Simulation(
        records=recording.records,
        simulated=simulated,
        start_up_samples=start_up_samples,
        starts=states,
    )


def initial_states_to_text(states: Sequence[Any]) -> str:
    """Write the initial states of several records as a JSON text. Null stands for a record whose
    initial state is estimated from its first samples."""
    return json.dumps([None if state is None else np.asarray(state).tolist() for state in states])


def initial_states_from_text(text: str, records: int) -> tuple[Any, ...]:
    """Read the initial states of several records from a JSON text. An empty text gives None for
    each record.

    Raises `BadRequest` for what is no list of them.
    """
    if not text:
        return (None,) * records
    try:
        states = [
            None if state is None else np.array(state, dtype=np.float64)
            for state in json.loads(text)
        ]
    except (TypeError, ValueError) as error:
        raise BadRequest(
            "start_states", text[:40], "is no list of states", "run the study again"
        ) from error
    sound = len(states) == records and all(state is None or state.ndim == 1 for state in states)
    problem = f"does not hold one state for each of {records} records"
    require(sound, "start_states", text[:40], problem, "run the study again")
    return tuple(states)


def record_signal_pairs(stored: Trajectories, recomputed: Trajectories) -> Pairs:
    """Signals and sampling times of stored records, each paired with its recomputed value."""
    pairs: Pairs = {"records": (len(stored), len(recomputed))}
    for i, (before, now) in enumerate(zip(stored, recomputed, strict=False)):
        for name in ("u", "y", "d", "step_s", "closed_loop"):
            pairs[f"{name} {i}"] = (getattr(before, name), getattr(now, name))
    return pairs


def largest_relative_difference(stored: Any, recomputed: Any) -> float:
    """Largest difference between a stored and a recomputed array, relative to the largest
    recomputed entry.

    Infinite for another shape or a missing side; NaN where a number is none, which agrees with
    nothing.
    """
    if stored is None or recomputed is None:
        return 0.0 if stored is recomputed else float("inf")
    before = np.asarray(stored, dtype=float)
    now = np.asarray(recomputed, dtype=float)
    if before.shape != now.shape:
        return float("inf")
    difference = float(np.abs(before - now).max(initial=0.0))
    largest = float(np.abs(now).max(initial=0.0))
    if largest > 0 and difference > 0:
        return difference / largest
    return difference
