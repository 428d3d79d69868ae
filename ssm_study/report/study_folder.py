"""Access to the files of a run and of a study. Data that figures are drawn from: the study's
gathered table and the files of its runs."""

import io
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import pandas as pd
import yaml  # type: ignore[import-untyped]

from ssm_study.certificates.certificate import Design
from ssm_study.durable import read_limited_bytes
from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.refusal import BadRequest, require
from ssm_study.report.words import PlantUnits
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.signals import Trajectories
from ssm_study.stored_yaml import read_stored_yaml
from ssm_study.study.recordings import RecordedCases, read_mismatch_records
from ssm_study.systems import Gains
from ssm_study.table.columns import text_column
from ssm_study.table.gather import gather, record_file_states, rows_differ_from_records
from ssm_study.table.rank import sort_best_first


class NothingToDraw(Exception):
    """Error that says in one sentence why a figure would be empty. The sentence is drawn
    instead."""


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """Files of one run for the study's figures and web page, each read when first needed. A
    missing file reads as None (a failed run has few)."""

    path: Path

    def _parse_file(self, name: str, parse: Callable[[str], Any] = json.loads) -> Any:
        """Read and parse a file of the run; None if there is no such file. Raises `BadRequest` that
        names a damaged file."""
        path = self.path / name
        try:
            return parse(read_limited_bytes(path).decode()) if path.is_file() else None
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            cause = " ".join(str(error).split())[:200]
            raise BadRequest(
                "report", path, f"the file is damaged ({cause})", "run the study again"
            ) from error

    def _read_recording(self, name: str, max_cases: int | None = None) -> RecordedCases | None:
        """Read a recording of the run; None if there is no such file."""
        path = self.path / f"{name}.mcap"
        if not path.is_file():
            return None
        recording = RecordedCases.from_file(path)
        return replace(recording, cases=dict(islice(recording.cases.items(), max_cases)))

    @cached_property
    def record(self) -> dict[str, Any]:
        """Content of the file `record.json` of a run, with settings and results."""
        return self._parse_file("record.json") or {}

    @cached_property
    def certificate(self) -> dict[str, Any] | None:
        """Content of the file `certificate.json` of a run; None for a run without one."""
        return self._parse_file("certificate.json")

    @cached_property
    def model(self) -> SSM | None:
        """Identified model of a run, if the model can be certified; None for a baseline or a model
        with neurons."""
        return self.any_model if isinstance(self.any_model, SSM) else None

    @cached_property
    def any_model(self) -> Model | None:
        """Identified model of a run, with or without neurons; None for a baseline."""
        data = self._parse_file("model.json")
        stored_model = None if data is None else model_from_json(data)
        return stored_model if isinstance(stored_model, SSM | StructuredSSM) else None

    @cached_property
    def design(self) -> Design | None:
        """Controller and observer of a run with their certificates; None if the run stored none."""
        return None if self.certificate is None else Design.from_json(self.certificate)

    @property
    def gains(self) -> Gains | None:
        """Gains of a run's controller and observer; None if one of them is missing."""
        return self.design.gain_pair if self.design is not None and self.design.feasible else None

    @property
    def start_up_samples(self) -> int:
        """Number of samples at the beginning of each record from which the initial state is
        estimated."""
        return int(self.record.get("start_up_samples") or 0)

    @cached_property
    def mismatch_records(self) -> Trajectories:
        """Records of a run that only serve to measure the model error."""
        return read_mismatch_records(self.path)

    @cached_property
    def validation_records(self) -> Trajectories:
        """All validation records of a run; empty if the run left no recording."""
        path = self.path / "validation.mcap"
        return RecordedCases.from_file(path).records if path.is_file() else ()

    @cached_property
    def mismatch(self) -> Mismatch | None:
        """Model error of a run by frequency and amplitude, measured again from the recordings; None
        if a needed file is missing."""
        if self.any_model is None or not self.validation_records:
            return None
        return measure_model_error(
            self.any_model, self.validation_records, self.start_up_samples, self.mismatch_records
        )

    @property
    def controller_comparison(self) -> pd.DataFrame | None:
        """Table that compares controllers on the plant of a run; None if there is none."""
        return self._parse_file("comparison.csv", lambda content: pd.read_csv(io.StringIO(content)))

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration of a run, with all values resolved."""
        path = self.path / ".hydra" / "config.yaml"
        return (yaml.safe_load(read_stored_yaml(path)) if path.is_file() else None) or {}

    @cached_property
    def curve(self) -> pd.DataFrame | None:
        """Training curve of a run's model with one row per epoch."""
        rows = self._parse_file("training_curve.json")
        return pd.DataFrame(rows) if rows else None

    @cached_property
    def validation(self) -> RecordedCases | None:
        """First validation record of a run with the model's free run."""
        return self._read_recording("validation", max_cases=1)

    @cached_property
    def test(self) -> RecordedCases | None:
        """First test record of a run with the model's free run."""
        return self._read_recording("test", max_cases=1)

    @cached_property
    def excitation(self) -> RecordedCases | None:
        """Excitation of a run, that is, the inputs of its training records."""
        return self._read_recording("excitation")

    @cached_property
    def closed_loop(self) -> RecordedCases | None:
        """Recording of a run's closed loop; None if no loop was closed."""
        return self._read_recording("closed_loop")


@dataclass(frozen=True, kw_only=True)
class StudyFolder:
    """Files of a study for figures and page: its table and its run folders by name. `others` are
    studies shown beside it.

    A run of another study is named by its path from `folder`; `shown` names a run that is shown in
    place of the best. Raises `BadRequest` where a table is missing.
    """

    folder: Path
    others: tuple[Path, ...] = ()
    shown: str | None = None

    @property
    def name(self) -> str:
        """Name of the study, which is the name of its folder."""
        return " and ".join(folder.resolve().name for folder in (self.folder, *self.others))

    @cached_property
    def table(self) -> pd.DataFrame:
        """Results table of a study with one row per run."""
        tables = [gather_table(self.folder)]
        for other in self.others:
            place = Path(os.path.relpath(other, self.folder))
            table = gather_table(other)
            tables.append(table.assign(run=[str(place / run) for run in table["run"]]))
        return tables[0] if len(tables) == 1 else pd.concat(tables, ignore_index=True)

    @cached_property
    def controller_comparison(self) -> pd.DataFrame:
        """Table of compared controllers over all runs of a study."""
        found = {
            name: self.run_folder(name).controller_comparison
            for name in text_column(self.table, "run")
            if name
        }
        tables = [table.assign(run=name) for name, table in found.items() if table is not None]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def run_folder(self, name: str) -> RunFolder:
        """Result folder of a single run, found in the study by the name of the run."""
        return RunFolder(path=self.folder / name)

    @cached_property
    def best_run(self) -> RunFolder | None:
        """Best run of the study that has a model; None if there is none."""
        names = (
            [self.shown]
            if self.shown
            else [name for name in text_column(sort_best_first(self.table), "run") if name]
        )
        return next(
            (
                self.run_folder(name)
                for name in names
                if (self.folder / name / "model.json").is_file()
            ),
            None,
        )

    @cached_property
    def units(self) -> PlantUnits:
        """Units of input and output of a study's plant; empty where they are not known or
        differ."""
        record = None if self.best_run is None else self.best_run.validation
        is_one_plant = text_column(self.table, "plant").nunique() < 2
        if record is None or not is_one_plant or self.others:
            return PlantUnits()
        return PlantUnits(input=record.unit("input"), output=record.unit("measured"))

    def read_from_best(self, *parts: str, otherwise: str) -> list[Any]:
        """Read files of the study's best run, such as model or closed loop, by name. Raises
        `NothingToDraw` that names a missing part."""
        values = [getattr(self.best_run, part, None) for part in parts]
        if any(part is None for part in values):
            raise NothingToDraw(otherwise)
        return values


def gather_table(folder: Path) -> pd.DataFrame:
    """Gather the results table of a study, again from the start if it contradicts the records of
    the runs. Raises `BadRequest` for a folder without a table or with a damaged one."""
    path = folder / "runs.parquet"
    require(
        path.is_file(),
        "study",
        folder,
        "it has no runs.parquet",
        "run `ssm-study gather` on it first",
    )
    try:
        table = pd.read_parquet(path)
    except ValueError as error:  # what Arrow raises
        raise BadRequest(
            "study", path, "the table is damaged", "run `ssm-study gather` on the study"
        ) from error
    names = set(record_file_states(folder))  # none where the table alone was kept
    is_stale = bool(names) and names != set(table["run"])
    if is_stale or (names and rows_differ_from_records(folder, table)):
        return gather(folder, anew=True, must_write=False)
    return table
