"""A table that one run leaves beside its record: many controllers, or many situations, on the run's own model."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ssm_study.models.identified import SSM
from ssm_study.signals import Trajectory
from ssm_study.systems import JacobianBall

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Identified:
    """What every controller may know: the model, the balls of its Jacobians (S_u, S_y), the validation record."""

    model: SSM
    balls: tuple[JacobianBall, JacobianBall]
    validation: tuple[Trajectory, ...]


def write_rows(path: Path, rows: list[Row]) -> None:
    """CSV with a header; None becomes an empty field. All columns of all rows, in the order they first appear."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
