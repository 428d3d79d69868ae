"""MCAP as columns: `field`, or `topic.field` where several topics have a field of that name."""

from pathlib import Path

import numpy as np

from ssm_study.data.mcap import SignalGroup
from ssm_study.data.mcap_reading import read_mcap
from ssm_study.data.table import Table
from ssm_study.refusal import BadRequest, require


def read_mcap_columns(path: Path, names: list[str]) -> Table:
    """The named fields, their units, and the log times they share."""
    groups, _ = read_mcap(path)
    columns, units, times = {}, {}, []
    for name in names:
        group, index = _find(path, groups, name)
        columns[name] = np.ascontiguousarray(group.values[:, index])
        units[name] = group.channels[index].unit
        times.append(group.time_s - groups[0].time_s[0])
    for name, time_s in zip(names, times, strict=True):
        require(
            np.array_equal(time_s, times[0]),
            f"{path.name} (topic of)",
            name,
            f"not logged at the times of {names[0]}",
            "log both in one topic, or resample them",
        )
    return Table(columns=columns, units={n: u for n, u in units.items() if u}, time_s=times[0], row_word="message")


def _find(path: Path, groups: tuple[SignalGroup, ...], name: str) -> tuple[SignalGroup, int]:
    matches = [
        (group, index)
        for group in groups
        for index, channel in enumerate(group.channels)
        if name in (channel.name, f"{group.topic}.{channel.name}")
    ]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(f"{group.topic}.{channel.name}" for group in groups for channel in group.channels)
    problem = "several topics have it" if matches else f"the recording has {known}"
    raise BadRequest(f"{path.name} (field)", name, problem, "name one as topic.field")
