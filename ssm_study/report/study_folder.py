"""What a figure is drawn from: the study's gathered table and the files of its runs."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import yaml  # type: ignore[import-untyped]

from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.refusal import BadRequest
from ssm_study.report.columns import text
from ssm_study.report.trajectories import (
    ClosedLoop,
    Excitation,
    Validation,
    read_closed_loop,
    read_excitation,
    read_validation,
)
from ssm_study.report.verdict import best_first


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """The files of one run, read when asked for; a file that is not there reads as None (a failed run leaves few)."""

    path: Path

    def _json(self, name: str) -> dict[str, Any] | None:
        path = self.path / name
        return json.loads(path.read_text()) if path.is_file() else None

    @cached_property
    def record(self) -> dict[str, Any]:
        return self._json("record.json") or {}

    @cached_property
    def certificate(self) -> dict[str, Any] | None:
        return self._json("certificate.json")

    @cached_property
    def model(self) -> SSM | None:
        """None for a baseline too: it is identified and scored, but nothing can be certified of it."""
        data = self._json("model.json")
        found = None if data is None else model_from_json(data)
        return found if isinstance(found, SSM) else None

    @cached_property
    def config(self) -> dict[str, Any]:
        path = self.path / ".hydra" / "config.yaml"
        return (yaml.safe_load(path.read_text()) or {}) if path.is_file() else {}

    @property
    def settling_band(self) -> float | None:
        """What counts as settled, in the output's unit; None where there was no plant."""
        return (self.config.get("plant") or {}).get("settling_band")

    @cached_property
    def curve(self) -> list[dict[str, Any]]:
        path = self.path / "training_curve.json"
        return json.loads(path.read_text()) if path.is_file() else []

    @cached_property
    def validation(self) -> Validation | None:
        path = self.path / "validation.mcap"
        return read_validation(path) if path.is_file() else None

    @cached_property
    def excitation(self) -> Excitation | None:
        """The training records' input; the validation record's where those were not kept."""
        path = self.path / "excitation.mcap"
        if path.is_file():
            return read_excitation(path)
        seen = self.validation
        if seen is None:
            return None
        u, label = (seen.u[:, 0],), seen.input_label
        return Excitation(u=u, step_s=seen.step_s, input_label=label, records="validation record")

    @cached_property
    def closed_loop(self) -> ClosedLoop | None:
        path = self.path / "closed_loop.mcap"
        return read_closed_loop(path) if path.is_file() else None


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study folder: `runs.parquet` as `table`, and its run folders by name.

    Raises `BadRequest` when the folder or its table is missing.
    """

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.resolve().name

    @cached_property
    def table(self) -> pd.DataFrame:
        path = self.folder / "runs.parquet"
        if not path.is_file():
            raise BadRequest("study", self.folder, "it has no runs.parquet", "run `ssm-study gather` on it first")
        return pd.read_parquet(path)

    @cached_property
    def comparison(self) -> pd.DataFrame:
        """The tables of controllers and situations that runs left beside their records, one below the other."""
        names = [name for name in text(self.table, "run") if name and (self.folder / name / "comparison.csv").is_file()]
        tables = [pd.read_csv(self.folder / name / "comparison.csv").assign(run=name) for name in names]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def run(self, name: str) -> RunFolder:
        return RunFolder(path=self.folder / name)

    @cached_property
    def best(self) -> RunFolder | None:
        """The best run that left a model (see `best_first`), or None."""
        for name in text(best_first(self.table), "run"):
            folder = self.run(name)
            if name and (folder.path / "model.json").is_file():
                return folder
        return None
