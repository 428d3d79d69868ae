"""The two recordings of a run folder: what the model says beside what was measured, and every closed loop."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.loop.regulation import ClosedLoop
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.signals import Channel, DataSet, Trajectory


def write_simulation(path: Path, model: SSM, records: tuple[Trajectory, ...], data: DataSet) -> None:
    """`/input`, `/measured` and `/simulated` (free run of the model) over one record, in physical units.

    Several records stand under `/record_<i>/...`.
    """
    groups: list[SignalGroup] = []
    for i, record in enumerate(records):
        prefix = "" if len(records) == 1 else f"/record_{i}"
        signals = (
            ("input", data.inputs, record.u),
            ("measured", data.outputs, record.y),
            ("simulated", data.outputs, model.simulate(record.u)),
        )
        for name, channels, values in signals:
            groups.append(SignalGroup(topic=f"{prefix}/{name}", time_s=record.time_s, channels=channels, values=values))
    write_mcap(path, tuple(groups), data.metadata | {"start_up_samples": str(data.start_up_samples)})


def write_closed_loop(path: Path, loop: ClosedLoop, plant: Plant, metadata: dict[str, str]) -> None:
    """`/case_<i>/` reference, input, true and measured output, estimate (scaled), states, and uncontrolled output."""
    run, inputs, outputs, states = loop.controlled, plant.inputs, plant.outputs, plant.states
    estimates = tuple(Channel(name=f"x{i + 1}", unit="1") for i in range(run.estimate.shape[2]))

    def group(case: int, name: str, channels: tuple[Channel, ...], values: Float[np.ndarray, "T c"]) -> SignalGroup:
        return SignalGroup(topic=f"/case_{case}/{name}", time_s=run.time_s, channels=channels, values=values)

    groups: list[SignalGroup] = []
    for case in range(len(run.y)):
        groups += [
            group(case, "reference", outputs, run.reference),
            group(case, "input", inputs, run.u[case]),
            group(case, "output", outputs, run.y[case]),
            group(case, "measured", outputs, run.measured[case]),
            group(case, "estimate", estimates, run.estimate[case]),
            group(case, "states", states, run.states[case]),
            group(case, "uncontrolled", outputs, loop.uncontrolled.y[case]),
        ]
    write_mcap(path, tuple(groups), metadata | {"settling_band": repr(loop.settling_band)})
