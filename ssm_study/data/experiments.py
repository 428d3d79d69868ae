"""Experiments assigned to training, validation and test one by one: how the benchmark records are described."""

from dataclasses import dataclass, replace
from pathlib import Path

from ssm_study.data.benchmark_files import benchmark_folder, file_in
from ssm_study.data.recorded import RecordedSource, assembled, check_recorded
from ssm_study.data.recording import Recording
from ssm_study.data.scores import SCORES
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory


@dataclass(frozen=True, kw_only=True)
class RecordedExperiments(RecordedSource):
    """`training`, `validation` and `test` recordings, with paths relative to a folder.

    `folder` null searches for the `benchmark` (`benchmark_folder`). `score` is "rmse" in the unit of the output,
    "rmse_mm" of an output in m, or "position_mm" for what a velocity integrates to. Equilibrium: as in `RecordedData`.
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

    def __post_init__(self) -> None:
        check_recorded(self.start_up_samples, self.equilibrium)
        require(self.score in SCORES, "data.score", self.score, f"is none of {', '.join(SCORES)}", "use one of these")
        for part in ("training", "validation", "test"):
            require(len(getattr(self, part)) > 0, f"data.{part}", "none", "no recording is named", "name at least one")

    def files(self) -> tuple[Path, ...]:
        folder = self._folder()
        names = dict.fromkeys(r.path for r in (*self.training, *self.validation, *self.test))
        return tuple(file_in(folder, name) for name in names)

    def build(self, seed: int) -> DataSet:
        folder = self._folder()
        return assembled(
            training=_read(folder, "training", self.training),
            validation=_read(folder, "validation", self.validation),
            test=_read(folder, "test", self.test),
            inputs=self.training[0].inputs,
            outputs=self.training[0].outputs,
            start_up_samples=self.start_up_samples,
            equilibrium=(self.equilibrium, self.input_equilibrium, self.output_equilibrium),
            metadata={"source": "recorded", "benchmark": self.benchmark, "score": self.score, "seed": str(seed)},
        )

    def _folder(self) -> Path:
        if self.folder is not None:
            require(Path(self.folder).is_dir(), "data.folder", self.folder, "no such folder", "check the spelling")
            return Path(self.folder)
        return benchmark_folder(self.benchmark)


def _read(folder: Path, part: str, recordings: list[Recording]) -> tuple[Trajectory, ...]:
    return tuple(
        replace(r, path=str(file_in(folder, r.path)), name=f"{part}_{k + 1}").read() for k, r in enumerate(recordings)
    )
