"""The recordings of a run folder, written and read back: simulated beside measured output, and
every closed loop."""

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
from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Trajectories, Trajectory

TRIALS = "trials.mcap"  # the records that serve the mismatch alone
LOOPS = "trials_in_loop.mcap"  # the same of trials in closed loop

Case = dict[str, SignalGroup]
Outputs = Sequence[Float[np.ndarray, "T p"]]
Shown = dict[str, tuple[tuple[Channel, ...], Float[np.ndarray, "T c"]]]


@dataclass(frozen=True, kw_only=True)
class RecordedCases:
    """A recording by signal, `loop["output"] (N, T, c)` over its N cases; `about` is its metadata.

    Cases are named by what stands before the last `/` of their topics, in the order of its number:
    `/case_3/output` is the signal `output` of the case `/case_3`; `/input` belongs to the one case
    without a name. A closed loop has reference, input, output, uncontrolled (the plant left alone);
    a record has input, measured, simulated. Raises `BadRequest` for a signal that a case lacks.
    """

    path: Path
    cases: dict[str, Case]
    about: dict[str, str]

    @classmethod
    def of(cls, path: Path) -> "RecordedCases":
        """Raises `BadRequest` for a damaged recording."""
        groups, about = read_mcap(path)
        cases: dict[str, Case] = defaultdict(dict)
        for group in groups:
            prefix, _, name = group.topic.rpartition("/")
            cases[prefix][name] = group
        # By number, not by text: case 10 comes after case 9.
        numbered = sorted(
            cases.items(), key=lambda case: int((re.findall(r"\d+$", case[0]) or ["0"])[0])
        )
        return cls(path=path, cases=dict(numbered), about=about)

    def signals(self, name: str) -> list[SignalGroup]:
        """One signal of every case; the cases may differ in length."""
        there = all(name in case for case in self.cases.values())
        require(there, "topic", name, f"{self.path.name} lacks it", "run the study again")
        return [case[name] for case in self.cases.values()]

    def __getitem__(self, name: str) -> Float[np.ndarray, "N T c"]:
        return np.stack([signal.values for signal in self.signals(name)])

    def time_s(self, name: str) -> Float[np.ndarray, "T"]:
        return self.signals(name)[0].time_s

    def step_s(self, name: str) -> float:
        return float(self.time_s(name)[1] - self.time_s(name)[0])

    def label(self, name: str) -> str:
        """The first channel with its unit: `load_speed`, `rad/s` -> `Load speed (rad/s)`."""
        return self.labels(name)[0]

    def labels(self, name: str) -> list[str]:
        """Every channel with its unit."""
        return [
            f"{channel.name.replace('_', ' ').capitalize()} ({channel.unit or '–'})"
            for channel in self.signals(name)[0].channels
        ]

    def unit(self, name: str) -> str:
        """Unit of the first channel."""
        return self.signals(name)[0].channels[0].unit

    @property
    def settling_band(self) -> float:
        """Band within which a closed loop counts as settled, in the output's unit."""
        return float(self.about["settling_band"])

    @property
    def rest_s(self) -> float:
        """A little after the last response of a closed loop has come to rest in the band, else the
        whole horizon."""
        time_s = self.time_s("output")
        responses = np.concatenate([self["output"], self["uncontrolled"]])[:, :, 0]
        outside = (np.abs(responses - self["reference"][0, :, 0]) > self.settling_band).any(axis=0)
        last = int(
            np.flatnonzero(outside).max(initial=0)
        )  # the last sample at which any of them is outside
        return float(min(1.4 * time_s[last] + 5 * self.step_s("output"), time_s[-1]))

    @property
    def records(self) -> Trajectories:
        """Input and measured output of every case."""
        step_s = float(self.about["step_s"])
        names = (prefix or self.path.stem for prefix in self.cases)
        parts = zip(names, self.signals("input"), self.signals("measured"), strict=True)
        return tuple(
            Trajectory(u=u.values, y=y.values, step_s=step_s, name=name) for name, u, y in parts
        )


def groups(prefix: str, time_s: Float[np.ndarray, "T"], shown: Shown) -> list[SignalGroup]:
    """Signals sampled together, each under a topic of its own."""
    return [
        SignalGroup(topic=f"{prefix}/{name}", time_s=time_s, channels=channels, values=values)
        for name, (channels, values) in shown.items()
    ]


def write_records(
    path: Path,
    data: DataSet,
    records: Trajectories,
    *,
    outputs: bool = True,
    simulated: Outputs = (),
    **about: str,
) -> None:
    """`/record_<i>/` input, measured output where `outputs`, and what the model `simulated` (free
    run), physical."""
    written: list[SignalGroup] = []
    for i, record in enumerate(records):
        shown: Shown = {"input": (data.inputs, record.u)}
        shown |= {"measured": (data.outputs, record.y)} if outputs else {}
        shown |= {"simulated": (data.outputs, simulated[i])} if simulated else {}
        written += groups(f"/record_{i}", record.time_s, shown)
    write_mcap(path, tuple(written), data.metadata | about | {"step_s": repr(data.step_s)})


def read_trials(folder: Path) -> Trajectories:
    """The records for the mismatch alone, open loop first; none where the run has no such file."""
    found: list[Trajectory] = []
    for path in (folder / TRIALS, folder / LOOPS):
        records = RecordedCases.of(path).records if path.is_file() else ()
        found += [replace(one, closed_loop=path.name == LOOPS) for one in records]
    return tuple(found)


def read_simulation(path: Path) -> Simulation:
    """Raises `BadRequest` if the file lacks a topic."""
    kept = RecordedCases.of(path)
    simulated = tuple(signal.values for signal in kept.signals("simulated"))
    return Simulation(
        records=kept.records,
        simulated=simulated,
        start_up_samples=int(kept.about["start_up_samples"]),
    )


def of_records(
    kept: tuple[Trajectory, ...], made: tuple[Trajectory, ...]
) -> dict[str, tuple[Any, Any]]:
    """The signals of two sets of records, and their sampling times, side by side."""
    names = ("u", "y", "step_s", "closed_loop")
    both = enumerate(zip(kept, made, strict=False))
    pairs = {
        f"{name} {i}": (getattr(one, name), getattr(other, name))
        for i, (one, other) in both
        for name in names
    }
    return {"records": (len(kept), len(made))} | pairs


def distance(stored: Any, made: Any) -> float:
    """`max |stored - made| / max |made|`; infinite for another shape, a missing side or a number
    that is none."""
    if stored is None or made is None:
        return 0.0 if stored is made else float("inf")
    one = np.asarray(stored, dtype=float)
    other = np.asarray(made, dtype=float)
    if one.shape != other.shape:
        return float("inf")
    apart = float(np.abs(one - other).max(initial=0.0))
    largest = float(np.abs(other).max(initial=0.0))
    return (
        apart / largest if largest > 0 and apart > 0 else apart
    )  # NaN passes through, and agrees with nothing
