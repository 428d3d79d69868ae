"""The recordings of a run folder, written and read back: simulated beside measured output, and
every closed loop."""

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import STAYED, Rollouts
from ssm_study.models.metrics import Simulation
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.robustness.mismatch import Mismatch, View
from ssm_study.signals import Channel, DataSet, Trajectories, Trajectory

TRIALS = "trials.mcap"  # the records that serve the mismatch alone
LOOPS = "trials_in_loop.mcap"  # the same of trials in closed loop
MISMATCH = "mismatch.json"
NOISE_FREE = (
    "closed_loop_noise_free.mcap"  # in runs where measurement noise alone crosses the settling band
)

Case = dict[str, SignalGroup]
Outputs = Sequence[Float[np.ndarray, "T p"]]
Shown = dict[str, tuple[tuple[Channel, ...], Float[np.ndarray, "T c"]]]
# What is recorded of each closed loop, topic by field of `Rollouts`.
TOPICS = {
    "u": "input",
    "y": "output",
    "measured": "measured",
    "estimate": "estimate",
    "states": "states",
}


@dataclass(frozen=True, kw_only=True)
class RecordedCases:
    """A recording by signal, `loop["output"] (N, T, c)` over its N cases; `about` is its metadata.

    Cases are named by what stands before the last `/` of their topics, in the order of its number:
    `/case_3/output` is
    the signal `output` of the case `/case_3`; `/input` belongs to the one case without a name. A
    closed loop has
    reference, input, output, uncontrolled (the plant left alone); a record has input, measured,
    simulated.
    Raises `BadRequest` for a signal that a case lacks.
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
        channel = self.signals(name)[0].channels[0]
        return f"{channel.name.replace('_', ' ').capitalize()} ({channel.unit or '–'})"

    @property
    def settling_band(self) -> float:
        """What counts as settled, in the output's unit; of a closed loop."""
        return float(self.about["settling_band"])

    @property
    def rest_s(self) -> float:
        """A little after the last response of a closed loop has come to rest in the band, else the
        whole horizon."""
        time_s, responses = (
            self.time_s("output"),
            np.concatenate([self["output"], self["uncontrolled"]])[:, :, 0],
        )
        outside = (np.abs(responses - self["reference"][0, :, 0]) > self.settling_band).any(axis=0)
        last = int(
            np.flatnonzero(outside).max(initial=0)
        )  # the last sample at which any of them is outside
        return float(min(1.4 * time_s[last] + 5 * self.step_s("output"), time_s[-1]))

    @property
    def records(self) -> Trajectories:
        """Input and measured output of every case."""
        step_s, names = (
            float(self.about["step_s"]),
            (prefix or self.path.stem for prefix in self.cases),
        )
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


def write_rollouts(
    path: Path, run: Rollouts, alone: Rollouts | None, plant: Plant, about: dict[str, str]
) -> None:
    """`/case_<i>/` reference, input, true and measured output, estimate (scaled), states; the
    output left alone."""
    estimates = tuple(Channel(name=f"x{i + 1}", unit="1") for i in range(run.estimate.shape[2]))
    channels = {"u": plant.inputs, "estimate": estimates, "states": plant.states}
    written: list[SignalGroup] = []
    for case in range(len(run.y)):
        shown = {"reference": (plant.outputs, run.reference)}
        for name, topic in TOPICS.items():
            shown[topic] = channels.get(name, plant.outputs), getattr(run, name)[case]
        if alone is not None:
            shown["uncontrolled"] = (plant.outputs, alone.y[case])
        written += groups(f"/case_{case}", run.time_s, shown)
    facts = {
        "step_s": repr(run.step_s),
        "settling_band": repr(plant.settling_band),
        "input_equilibrium": json.dumps(plant.equilibrium().u.tolist()),
        "left_at_sample": json.dumps(run.left_at_sample.tolist()),
        "bound": json.dumps(run.bound.tolist()),
    }
    write_mcap(path, tuple(written), about | facts)


def read_rollouts(path: Path) -> tuple[Rollouts, RecordedCases]:
    """The loops, and the recording that they were read from. Raises `BadRequest` if the file lacks
    a topic."""
    kept = RecordedCases.of(path)
    signals: dict[str, Any] = {name: kept[topic] for name, topic in TOPICS.items()}
    run = Rollouts(
        step_s=float(kept.about["step_s"]),
        reference=kept["reference"][0],
        bound=np.array(json.loads(kept.about["bound"]), dtype=float),
        left_at_sample=np.array(json.loads(kept.about["left_at_sample"]), dtype=int),
        **signals,
    )
    return run, kept


def closed_on(plant: Plant | None) -> str:
    """The word of a recording for what its loop was closed on; without a plant on the identified
    model."""
    return "identified model" if plant is None else "device" if plant.real else "plant"


def write_experiment(
    folder: Path, closed: LoopRuns, on: Plant, twin: Plant, about: dict[str, str]
) -> None:
    """Every closed loop of a run into its file; `on` is the plant, `twin` the identified model."""
    about = about | {"plant": type(on).__name__}
    write_rollouts(folder / "closed_loop.mcap", closed.controlled, closed.uncontrolled, on, about)
    if closed.noise_free is not None:
        write_rollouts(folder / NOISE_FREE, closed.noise_free, None, on, about)
    if closed.on_model is not None:
        write_rollouts(folder / "closed_loop_model.mcap", closed.on_model, None, twin, about)


def read_experiment(folder: Path) -> tuple[LoopRuns, str]:
    """What `write_experiment` kept, and what the loop was closed on. Raises `BadRequest` if a file
    lacks a topic."""
    path, on_model, noise_free = (
        folder / name for name in ("closed_loop.mcap", "closed_loop_model.mcap", NOISE_FREE)
    )
    run, kept = read_rollouts(path)
    alone = kept["uncontrolled"]
    closed = LoopRuns(
        controlled=run,
        uncontrolled=replace(
            run, y=alone, left_at_sample=np.full(len(alone), STAYED)
        ),  # left alone, none is stopped
        on_model=read_rollouts(on_model)[0] if on_model.is_file() else None,
        settling_band=kept.settling_band,
        input_equilibrium=np.array(json.loads(kept.about["input_equilibrium"]), dtype=float),
        noise_free=read_rollouts(noise_free)[0] if noise_free.is_file() else None,
    )
    return closed, kept.about["loop_on"]


def write_mismatch(folder: Path, shown: Mismatch) -> None:
    """Every number as the text that reads back to the same float; a complex one as two."""
    told = json.dumps(
        asdict(shown), default=lambda array: np.ascontiguousarray(array).view(float).tolist()
    )
    (folder / MISMATCH).write_text(told, encoding="utf-8")


def read_mismatch(folder: Path) -> Mismatch:
    """The views at each amplitude, as they were computed."""
    told = json.loads((folder / MISMATCH).read_text(encoding="utf-8"))
    views, loop = tuple(map(_view, told.pop("views"))), told.pop("loop")
    others: dict[str, Any] = {
        name: tuple(one) if isinstance(one, list) else one for name, one in told.items()
    }
    return Mismatch(views=views, loop=loop and _view(loop), **others)


def _view(told: dict[str, Any]) -> View:
    parts: dict[str, Any] = {
        name: np.array(one) if isinstance(one, list) else one for name, one in told.items()
    }
    return View(**parts | {"linear": parts["linear"].view(complex)})


def of_records(
    kept: tuple[Trajectory, ...], made: tuple[Trajectory, ...]
) -> dict[str, tuple[Any, Any]]:
    """The signals of two sets of records, and their sampling times, side by side."""
    names, both = ("u", "y", "step_s", "closed_loop"), enumerate(zip(kept, made, strict=False))
    pairs = {
        f"{name} {i}": (getattr(one, name), getattr(other, name))
        for i, (one, other) in both
        for name in names
    }
    return {"records": (len(kept), len(made))} | pairs


def of_rollouts(kept: Rollouts | None, made: Rollouts | None) -> dict[str, tuple[Any, Any]]:
    """The signals of two sets of closed loops side by side; those that left their bound count up to
    there."""
    if kept is None or made is None:
        return {"recording": (kept is not None, made is not None)}
    return {name: (stored, getattr(made, name)) for name, stored in vars(kept).items()}


def distance(stored: Any, made: Any) -> float:
    """`max |stored - made| / max |made|`; infinite for another shape, a missing side or a number
    that is none."""
    if stored is None or made is None:
        return 0.0 if stored is made else float("inf")
    one, other = np.asarray(stored, dtype=float), np.asarray(made, dtype=float)
    if one.shape != other.shape:
        return float("inf")
    apart = float(np.abs(one - other).max(initial=0.0))
    largest = float(np.abs(other).max(initial=0.0))
    return (
        apart / largest if largest > 0 and apart > 0 else apart
    )  # NaN passes through, and agrees with nothing
