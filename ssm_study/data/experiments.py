"""Data sets whose training, validation and test records are separate recordings, such as public
benchmarks."""

import importlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from ssm_study.data.assembly import Parts
from ssm_study.data.metrics import SCORES
from ssm_study.data.recorded import ScaledRecordedSource
from ssm_study.data.recording import Recording
from ssm_study.data.splits import cut_out_fold
from ssm_study.refusal import BadRequest, require, require_one_of
from ssm_study.signals import DataSet, Trajectory

RECORDS_VARIABLE = "SSM_STUDY_DATA"  # a folder with one folder per benchmark
RECORDS_BESIDE = Path(
    "../shared/data"
)  # where a clone may have them, relative to the folder one works in
DOWNLOADERS = {
    "emps": "EMPS",
    "ced": "CED",
    "cascaded_tanks": "Cascaded_Tanks",
    "silverbox": "Silverbox",
}


@dataclass(frozen=True, kw_only=True)
class RecordedExperiments(ScaledRecordedSource):
    """Data set whose training, validation and test records are separate recordings, as in public
    benchmarks. Their paths are relative to a folder.

    `folder` null searches for the `benchmark` (`benchmark_folder`). `score`: see
    `data.metrics.SCORES`. A `fold` is held out of every training recording and scored in place of
    `test`, whose files are then not opened.
    """

    benchmark: str
    training: list[Recording]
    validation: list[Recording]
    test: list[Recording]
    score: str = "rmse"
    folder: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(SCORES, "data.score", self.score)
        for part in ("training", "validation", "test"):
            problem = "no recording is named"
            remedy = "name at least one"
            records = getattr(self, part)
            require(len(records) > 0, f"data.{part}", "none", problem, remedy)

    def data_files(self) -> tuple[Path, ...]:
        apart = (*self.validation, *self.test) if self.fold is None else ()
        all_recordings = (*self.training, *apart)
        names = dict.fromkeys(recording.path for recording in all_recordings)
        files = (find_record_file(self.records_folder(), name) for name in names)
        return tuple(files)

    def build(self, seed: int) -> DataSet:
        seed_text = str(seed)
        about = {"benchmark": self.benchmark, "score": self.score, "seed": seed_text}
        if self.fold is not None:
            about["held_out"] = f"fold {self.fold} of {self.folds}, of the training records"
        first = self.training[0]
        channels = (first.inputs, first.outputs)
        parts = self._read_parts()
        return self.assemble_about_equilibrium(parts, channels, **about)

    def _read_parts(self) -> Parts:
        """Read the recordings for training, validation and test. With folds, the remaining part
        also validates, as it does without folds."""
        folder = self.records_folder()
        if self.fold is None:
            training = _read_recordings(folder, self.training)
            validation = _read_recordings(folder, self.validation)
            test = _read_recordings(folder, self.test)
            return (training, validation, test)
        records = _read_recordings(folder, self.training)
        parts = [cut_out_fold(record, self.fold, self.folds) for record in records]
        pieces = [piece for pieces, _ in parts for piece in pieces]
        test_pieces = [piece for _, piece in parts]
        return pieces, pieces, test_pieces

    def records_folder(self) -> Path:
        """Folder that contains the recordings of a data set. Raises `BadRequest` if it does not
        exist."""
        if self.folder is None:
            return benchmark_folder(self.benchmark)
        problem = "no such folder"
        remedy = "check the spelling"
        records_folder = Path(self.folder)
        require(records_folder.is_dir(), "data.folder", self.folder, problem, remedy)
        return Path(self.folder)


def benchmark_folder(benchmark: str) -> Path:
    """Folder with the files of a public benchmark, which are downloaded if they are missing. It is
    in $SSM_STUDY_DATA, in ../shared/data, or in the official package's own place.

    That package downloads it; it needs the extra `benchmarks` and a network. Raises `BadRequest`
    where it is nowhere.
    """
    stated = os.environ.get(RECORDS_VARIABLE)
    around = [] if stated is None else [Path(stated)]
    for place in (*around, RECORDS_BESIDE):
        if (place / benchmark).is_dir():
            return place / benchmark
    problem = f"the {benchmark} records are neither in ${RECORDS_VARIABLE} nor in {RECORDS_BESIDE}"
    remedy = "give data.folder=PATH, or pip install 'ssm-study[benchmarks]' to download them"
    try:
        benchmarks = importlib.import_module("nonlinear_benchmarks")
        download = getattr(benchmarks, DOWNLOADERS[benchmark])
        downloaded = download(data_file_locations=True)
    except (ImportError, KeyError) as error:
        raise BadRequest("data.folder", None, problem, remedy) from error
    except Exception as error:  # whatever the network and the archive readers raise (2026-11)
        raise BadRequest(
            "data.folder", None, f"{problem}, and downloading failed ({error})", remedy
        ) from error
    first_file = downloaded if isinstance(downloaded, str | os.PathLike) else downloaded[0]
    return Path(first_file).parent


def find_record_file(folder: Path, name: str) -> Path:
    """Find a recording by its file name, with or without the suffix `.csv` or `.mat`. Records are
    distributed in both formats. Raises `BadRequest` if there is none."""
    exact = folder / name
    files = folder.iterdir()
    same_stem = [path for path in files if path.stem == exact.stem]
    alike = (path for path in same_stem if path.suffix.lower() in (".mat", ".csv"))
    twins = sorted(alike)
    exists = exact.is_file()
    candidates = [exact] if exists else twins
    problem = f"has no {name}"
    remedy = "point it at the benchmark's own folder"
    require(candidates, "data.folder", folder, problem, remedy)
    return candidates[0]


def _read_recordings(folder: Path, recordings: list[Recording]) -> list[Trajectory]:
    """Read several recorded experiments from files in one folder."""
    records = []
    for recording in recordings:
        path = find_record_file(folder, recording.path)
        path_text = str(path)
        recording_in_folder = replace(recording, path=path_text)
        records.append(recording_in_folder.read_experiment())
    return records
