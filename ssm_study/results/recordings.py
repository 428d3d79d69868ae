"""The recordings of a run folder, written and read back: simulated beside measured output, and every closed loop."""

import json
import re
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.mcap_reading import read_mcap
from ssm_study.loop.rollout import STAYED, Rollouts
from ssm_study.models.free_run import free_run
from ssm_study.models.identified import Simulator
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Trajectory

NO_BOUND = 1e300  # a recorded bound is finite

Case = dict[str, SignalGroup]


def write_simulation(path: Path, model: Simulator, records: tuple[Trajectory, ...], data: DataSet) -> None:
    """`/input`, `/measured` and `/simulated` (free run of the model), physical; several records under `/record_<i>`."""
    groups: list[SignalGroup] = []
    for i, record in enumerate(records):
        prefix = "" if len(records) == 1 else f"/record_{i}"
        signals = {
            "input": (data.inputs, record.u),
            "measured": (data.outputs, record.y),
            "simulated": (data.outputs, free_run(model, record, data.start_up_samples)),
        }
        for name, (channels, values) in signals.items():
            groups.append(_group(f"{prefix}/{name}", record.time_s, channels, values))
    about = {"start_up_samples": str(data.start_up_samples), "step_s": repr(data.step_s)}
    write_mcap(path, tuple(groups), data.metadata | about)


def write_excitation(path: Path, data: DataSet) -> None:
    """`/record_<i>/input`: what the training records were excited by, physical."""
    groups = [
        _group(f"/record_{i}/input", record.time_s, data.inputs, record.u) for i, record in enumerate(data.training)
    ]
    write_mcap(path, tuple(groups), data.metadata | {"step_s": repr(data.step_s)})


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What `write_simulation` kept: the records, the free runs beside them, and how many samples are not scored."""

    records: tuple[Trajectory, ...]
    simulated: tuple[Float[np.ndarray, "T p"], ...]
    start_up_samples: int


def read_simulation(path: Path) -> Simulation:
    """Raises `BadRequest` if the file lacks a topic."""
    cases, about = read_cases(path)
    step_s = float(about["step_s"])
    records, simulated = [], []
    for prefix, case in cases.items():
        u, y, y_hat = (signal(case, name, path).values for name in ("input", "measured", "simulated"))
        records.append(Trajectory(u=u, y=y, step_s=step_s, name=prefix or path.stem))
        simulated.append(y_hat)
    return Simulation(
        records=tuple(records), simulated=tuple(simulated), start_up_samples=int(about["start_up_samples"])
    )


def write_rollouts(path: Path, run: Rollouts, alone: Rollouts | None, plant: Plant, about: dict[str, str]) -> None:
    """`/case_<i>/` reference, input, true and measured output, estimate (scaled), states; the output left alone."""
    estimates = tuple(Channel(name=f"x{i + 1}", unit="1") for i in range(run.estimate.shape[2]))
    groups: list[SignalGroup] = []
    for case in range(len(run.y)):
        signals = {
            "reference": (plant.outputs, run.reference),
            "input": (plant.inputs, run.u[case]),
            "output": (plant.outputs, run.y[case]),
            "measured": (plant.outputs, run.measured[case]),
            "estimate": (estimates, run.estimate[case]),
            "states": (plant.states, run.states[case]),
        }
        if alone is not None:
            signals["uncontrolled"] = (plant.outputs, alone.y[case])
        for name, (channels, values) in signals.items():
            groups.append(_group(f"/case_{case}/{name}", run.time_s, channels, values))
    facts = {
        "step_s": repr(run.step_s),
        "settling_band": repr(plant.settling_band),
        "input_equilibrium": json.dumps(plant.equilibrium().u.tolist()),
        "left_at_sample": json.dumps(run.left_at_sample.tolist()),
        "bound": json.dumps(np.minimum(run.bound, NO_BOUND).tolist()),
    }
    write_mcap(path, tuple(groups), about | facts)


@dataclass(frozen=True, kw_only=True)
class RecordedLoop:
    """What `write_rollouts` kept: the runs, the same left alone, the band that counts as settled, the input at rest.

    `alone` and `input_equilibrium` are None where the recording, an older one perhaps, does not say.
    """

    run: Rollouts
    settling_band: float
    alone: Rollouts | None = None
    input_equilibrium: Float[np.ndarray, "m"] | None = None


def read_rollouts(path: Path) -> RecordedLoop:
    """Raises `BadRequest` if the file lacks a topic."""
    found, about = read_cases(path)
    cases = list(found.values())
    run = Rollouts(
        step_s=float(about["step_s"]),
        reference=stacked(cases, "reference", path)[0],
        u=stacked(cases, "input", path),
        y=stacked(cases, "output", path),
        measured=stacked(cases, "measured", path),
        estimate=stacked(cases, "estimate", path),
        states=stacked(cases, "states", path),
        bound=np.array(json.loads(about["bound"]), dtype=float),
        left_at_sample=np.array(json.loads(about["left_at_sample"]), dtype=int),
    )
    left_alone = None
    if "uncontrolled" in cases[0]:
        left_alone = replace(run, y=stacked(cases, "uncontrolled", path), left_at_sample=np.full(len(cases), STAYED))
    rest = np.array(json.loads(about["input_equilibrium"]), dtype=float) if "input_equilibrium" in about else None
    band = float(about["settling_band"])
    return RecordedLoop(run=run, settling_band=band, alone=left_alone, input_equilibrium=rest)


def _group(
    topic: str, time_s: Float[np.ndarray, "T"], channels: tuple[Channel, ...], values: Float[np.ndarray, "T c"]
) -> SignalGroup:
    return SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values)


def read_cases(path: Path) -> tuple[dict[str, Case], dict[str, str]]:
    """Signals by what stands before the last `/` of their topic, in the order of its number, and the metadata.

    `/case_3/output` is the signal `output` of the case `/case_3`; `/input` belongs to the one case without a name.
    """
    groups, about = read_mcap(path)
    cases: dict[str, Case] = defaultdict(dict)
    for group in groups:
        prefix, _, name = group.topic.rpartition("/")
        cases[prefix][name] = group
    return dict(sorted(cases.items(), key=lambda case: _number(case[0]))), about


def _number(prefix: str) -> int:
    found = re.search(r"\d+$", prefix)
    return int(found.group()) if found else 0


def signal(case: Case, name: str, path: Path) -> SignalGroup:
    """Raises `BadRequest` if the recording lacks it."""
    require(name in case, "topic", name, f"{path.name} lacks it", "run the study again")
    return case[name]


def stacked(cases: list[Case], name: str, path: Path) -> Float[np.ndarray, "N T c"]:
    """One signal of all cases; raises `BadRequest` if one of them lacks it."""
    return np.stack([signal(case, name, path).values for case in cases])
