"""Reader of MCAP recordings. Columns are named `field`, or `topic.field` where several topics have
a field of that name."""

import re
from pathlib import Path

import numpy as np

from ssm_study.data.mcap import read_mcap
from ssm_study.data.readers.reader import Reader, Table
from ssm_study.refusal import require


class McapReader(Reader, names=(".mcap",)):
    """Reader of MCAP recordings, which reads numeric fields with their units and log times."""

    def read_columns(self, path: Path, names: list[str]) -> Table:
        groups, _ = read_mcap(path, "data.path")
        fields = [
            (group, index, channel)
            for group in groups
            for index, channel in enumerate(group.channels)
        ]
        known_names = ", ".join(f"{group.topic}.{channel.name}" for group, _, channel in fields)
        columns = {}
        units = {}
        time_s = None
        for name in names:
            slashed = re.sub(
                r"^(/[^.]*)\.(\w+\.)", r"\1/\2", name
            )  # `/case_0.output.speed`, as Foxglove plots it
            matches = [
                one
                for one in fields
                if {name, slashed} & {one[2].name, f"{one[0].topic}.{one[2].name}"}
            ]
            problem = "several topics have it" if matches else f"the recording has {known_names}"
            remedy = "name one as topic.field"
            require(len(matches) == 1, f"{path.name} (field)", name, problem, remedy)
            ((group, index, channel),) = matches
            columns[name] = np.ascontiguousarray(group.values[:, index])
            units[name] = channel.unit
            since_s = group.time_s - groups[0].time_s[0]
            time_s = since_s if time_s is None else time_s
            together = np.array_equal(since_s, time_s)
            problem = f"is not logged at the times of {names[0]}"
            remedy = "log both in one topic, or resample them"
            require(together, f"{path.name} (field)", name, problem, remedy)
        return Table(columns=columns, units=units, time_s=time_s, row_word="message")

    def read_all_columns(self, path: Path) -> Table:
        """Read every numeric field of all MCAP topics that have the same times as the first
        topic."""
        groups, _ = read_mcap(path, "data.path")
        first = groups[0].time_s
        columns = {}
        units = {}
        skipped = {}
        for group in groups:
            for index, channel in enumerate(group.channels):
                name = f"{group.topic}.{channel.name}"
                if np.array_equal(group.time_s, first):
                    columns[name] = np.ascontiguousarray(group.values[:, index])
                    units[name] = channel.unit
                else:
                    skipped[name] = f"logged at other times than {groups[0].topic}"
        return Table(
            columns=columns,
            units=units,
            time_s=first - first[0],
            row_word="message",
            skipped=skipped,
        )
