"""Experiments assigned to training, validation and test one by one: how the benchmark records are described."""

from dataclasses import dataclass, replace
from pathlib import Path

from ssm_study.data.assembly import assemble
from ssm_study.data.benchmark_files import benchmark_folder, file_in
from ssm_study.data.recorded import RecordedSource, check_recorded, rest_of
from ssm_study.data.recording import Recording
from ssm_study.data.scores import SCORES
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory


@dataclass(frozen=True, kw_only=True)
class RecordedExperiments(RecordedSource):
    """`training`, `validation` and `test` recordings, with paths relative to a folder.

    `folder` null searches for the `benchmark` (`benchmark_folder`). `score` is "rmse" in the unit of the output,
    "rmse_mm" of an output in m, or "position_mm" for what a velocity integrates to. Equilibrium: as in `RecordedData`.
    `fold` k of `folds`, counted from 0, holds out the k-th of so many equal pieces of every training recording: it is
    scored in place of `test`, whose files are then not opened, so that settings can be chosen without them.
    """

    benchmark: str
    training: list[Recording]
    validation: list[Recording]
    test: list[Recording]
    start_up_samples: int
    equilibrium: str = "mean"
    input_equilibrium: list[float] | None = None
    output_equilibrium: list[float] | None = None
    score: str = "rmse"
    folder: str | None = None
    fold: int | None = None
    folds: int = 4

    def __post_init__(self) -> None:
        check_recorded(self.start_up_samples, self.equilibrium)
        require(self.folds >= 2, "data.folds", self.folds, "nothing would be left to train on", "use 4 or so")
        inside = self.fold is None or 0 <= self.fold < self.folds
        require(inside, "data.fold", self.fold, f"there are {self.folds} folds", "count them from 0")
        require(self.score in SCORES, "data.score", self.score, f"is none of {', '.join(SCORES)}", "use one of these")
        for part in ("training", "validation", "test"):
            require(len(getattr(self, part)) > 0, f"data.{part}", "none", "no recording is named", "name at least one")

    def files(self) -> tuple[Path, ...]:
        folder, apart = self.located(), (*self.validation, *self.test) if self.fold is None else ()
        names = dict.fromkeys(r.path for r in (*self.training, *apart))
        return tuple(file_in(folder, name) for name in names)

    def build(self, seed: int) -> DataSet:
        training, validation, test = self._parts(self.located())
        return assemble(
            training=training,
            validation=validation,
            test=test,
            inputs=self.training[0].inputs,
            outputs=self.training[0].outputs,
            start_up_samples=self.start_up_samples,
            **rest_of(training, self.equilibrium, self.input_equilibrium, self.output_equilibrium),
            metadata={"source": "recorded", "benchmark": self.benchmark, "score": self.score, "seed": str(seed)}
            | ({} if self.fold is None else {"held_out": f"fold {self.fold} of {self.folds}, of the training records"}),
        )

    def _parts(self, folder: Path) -> tuple[tuple[Trajectory, ...], ...]:
        """Training, validation and test; of a fold, what is kept also validates, as it does without folds."""
        training = _read(folder, "training", self.training)
        if self.fold is None:
            return training, _read(folder, "validation", self.validation), _read(folder, "test", self.test)
        kept = tuple(piece for record in training for piece in _around(record, self.fold, self.folds))
        return kept, kept, tuple(_piece(record, self.fold, self.fold + 1, self.folds) for record in training)

    def located(self) -> Path:
        """The folder of the records; `BadRequest` where there is none."""
        if self.folder is not None:
            require(Path(self.folder).is_dir(), "data.folder", self.folder, "no such folder", "check the spelling")
            return Path(self.folder)
        return benchmark_folder(self.benchmark)


def _read(folder: Path, part: str, recordings: list[Recording]) -> tuple[Trajectory, ...]:
    return tuple(
        replace(r, path=str(file_in(folder, r.path)), name=f"{part}_{k + 1}").read() for k, r in enumerate(recordings)
    )


def _around(record: Trajectory, fold: int, folds: int) -> list[Trajectory]:
    """What lies before and behind the fold."""
    return [_piece(record, first, last, folds) for first, last in ((0, fold), (fold + 1, folds)) if first < last]


def _piece(record: Trajectory, first: int, last: int, folds: int) -> Trajectory:
    """Folds `first` to before `last` of a record cut into `folds` equal pieces."""
    samples = slice(round(len(record) * first / folds), round(len(record) * last / folds))
    return replace(record, u=record.u[samples], y=record.y[samples], name=f"{record.name}_fold_{first + 1}")
