"""A table that one run leaves beside its record: many controllers, or many situations, on the run's own model."""

import csv
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.signals import Trajectory
from ssm_study.systems import JacobianBall

if TYPE_CHECKING:  # a loop may carry a table, and a table runs the loop
    from ssm_study.loop.regulation import Loop

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Identified:
    """What every controller may know: the model, the balls of its Jacobians (S_u, S_y), the validation record."""

    model: SSM
    balls: tuple[JacobianBall, JacobianBall]
    validation: tuple[Trajectory, ...]


class Table(ABC):
    """`rows(plant, known, loop, seed)`: one flat row per case, missing values None, same columns in every row."""

    @abstractmethod
    def rows(self, plant: Plant, known: Identified, loop: "Loop", seed: int) -> list[Row]: ...


def write_rows(path: Path, rows: list[Row]) -> None:
    """CSV with a header; None becomes an empty field. All columns of all rows, in the order they first appear."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
