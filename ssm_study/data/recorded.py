"""Data sets from recorded logs. Data from files: one or several logs, each cut into training,
validation and test."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data import splits
from ssm_study.data.assembly import Channels, Parts, assemble_dataset
from ssm_study.data.channel_names import Names, as_name_tuple, name_channels
from ssm_study.data.closed_loop import project_inputs_on_set_points, reconstruct_pi_set_point
from ssm_study.data.log_checks import output_angle_remarks
from ssm_study.data.readers.reader import has_columns
from ssm_study.data.recording import ColumnSettings
from ssm_study.data.splits import (
    BLOCKS,
    FEWEST,
    Pieces,
    is_test_output_different,
    split_at_intervals,
    split_by_fold,
    split_by_time,
    split_into_blocks,
)
from ssm_study.refusal import require, require_at_least, require_one_of
from ssm_study.signals import DataSet, Trajectory

Splitter = Callable[[Trajectory], Pieces]


class RecordedSource(ABC):
    """Base class of data sources that build a data set from recorded files."""

    @abstractmethod
    def data_files(self) -> tuple[Path, ...]:
        """Paths of all files from which a recorded data set is built. Raises `BadRequest` if one
        does not exist."""

    @abstractmethod
    def build(self, seed: int) -> DataSet:
        """Build the data set of a recorded data source from its files. `seed` only appears in the
        name of the run, as nothing here is random."""


@dataclass(frozen=True, kw_only=True)
class ScaledRecordedSource(RecordedSource):
    """Base class of recorded data sources whose signals are scaled as deviations from an
    equilibrium. The equilibrium is "zero", "mean" (of the training samples), or one number per
    channel.

    `start_up_samples` at the beginning of each record are simulated, not scored: a record seldom
    starts at rest. `fold` k of `folds`, counted from 0, tests on the k-th of so many equal pieces
    of every record.
    """

    fold: int | None = None
    folds: int = 5
    start_up_samples: int = 0
    equilibrium: str = "mean"
    input_equilibrium: list[float] | None = None
    output_equilibrium: list[float] | None = None

    def __post_init__(self) -> None:
        require_at_least(0, "data.start_up_samples", self.start_up_samples, "use 0")
        require_one_of(("zero", "mean"), "data.equilibrium", self.equilibrium)
        require_at_least(2, "data.folds", self.folds, "use 4 or so")
        inside = self.fold is None or 0 <= self.fold < self.folds
        problem = f"there are {self.folds} folds"
        remedy = "count them from 0"
        require(inside, "data.fold", self.fold, problem, remedy)

    def assemble_about_equilibrium(
        self, parts: Parts, channels: tuple[Channels, ...], **about: str
    ) -> DataSet:
        """Assemble a data set from recorded training, validation and test records, scaled about
        their equilibrium. Raises `BadRequest` as `assemble_dataset` does."""
        remedy = "leave more of the records to training"
        require(len(parts[0]) > 0, "data.training", "none", "no record is left to train on", remedy)
        inputs = np.concatenate([record.u for record in parts[0]])
        outputs = np.concatenate([record.y for record in parts[0]])
        rest = [
            self._channel_equilibrium("input", inputs, self.input_equilibrium),
            self._channel_equilibrium("output", outputs, self.output_equilibrium),
        ]
        if len(channels) > len(rest):  # of a disturbance no equilibrium is chosen: its mean
            measured = [record.d for record in parts[0] if record.d is not None]
            disturbances = np.concatenate(measured)
            rest.append(disturbances.mean(axis=0))
        about = {"source": "recorded", **about}
        return assemble_dataset(parts, tuple(rest), channels, self.start_up_samples, metadata=about)

    def _channel_equilibrium(
        self, side: str, values: Float[np.ndarray, "T c"], stated: list[float] | None
    ) -> Float[np.ndarray, "c"]:
        """Equilibrium of the inputs or outputs: a stated value, zero, or the mean of the training
        samples."""
        mean = values.mean(axis=0)
        fits = stated is None or len(stated) == len(mean)
        problem = f"there are {len(mean)} channels"
        remedy = "give one number per channel"
        require(fits, f"data.{side}_equilibrium", stated, problem, remedy)
        if stated is not None:
            return np.array(stated, dtype=np.float64)
        return mean if self.equilibrium == "mean" else np.zeros_like(mean)


@dataclass(frozen=True, kw_only=True)
class RecordedData(ColumnSettings, ScaledRecordedSource):
    """Data set from recorded logs of one plant, each of which is cut into training, validation and
    test.

    Segments at rest of whole logs are `mismatch_records` (`splits.rest_segments`), and so are
    repeated periods if every log consists of such (`splits.periodic_segments`), although these
    train, too. If `reference` or `controller` is stated, the logs were recorded in a closed loop,
    and the input is replaced by the part that the set point explains (`closed_loop`). The columns
    `disturbance` are measured but not commanded: they drive model and observer by a path of their
    own. The settings: conf/data/recorded.yaml.
    """

    path: Names
    output_path: Names | None = None
    test_path: Names | None = None
    test_output_path: Names | None = None
    split: str = "auto"
    validation: list[list[float]] | None = None
    test: list[list[float]] | None = None
    validation_fraction: float = 0.2
    test_fraction: float = 0.2
    reference: Names | None = None
    controller: list[float] | None = None
    disturbance: Names | None = None
    disturbance_unit: Names = ""

    def __post_init__(self) -> None:
        ColumnSettings.__post_init__(self)
        ScaledRecordedSource.__post_init__(self)
        self._check_fractions()
        self._check_split_settings()
        self._check_closed_loop()
        self._check_disturbance_columns()
        has_file = len(as_name_tuple(self.path)) > 0
        problem = "names no file"
        require(has_file, "data.path", self.path, problem, "give a path")
        self.pair_input_and_output_files("path", "output_path")
        self.pair_input_and_output_files("test_path", "test_output_path")

    def _check_fractions(self) -> None:
        """Raise `BadRequest` for validation and test fractions that leave nothing of a log for
        training."""
        for name in ("validation_fraction", "test_fraction"):
            value = getattr(self, name)
            remedy = "use 0.2 or so"
            require(0 < value < 1, f"data.{name}", value, "not inside (0, 1)", remedy)
        tested = self.test_fraction if self.test_path is None else 0.0
        total = self.validation_fraction + tested
        both = "data.validation_fraction, data.test_fraction"
        problem = "nothing is left to train on"
        require(total < 1, both, total, problem, "leave more of the records to training")

    def _check_split_settings(self) -> None:
        """Raise `BadRequest` for validation and test intervals that are stated only in part, or
        together with a fold."""
        require_one_of(("auto", "time", "blocks"), "data.split", self.split)
        named = (self.validation, self.test)
        has_test = self.test is not None or self.test_path is not None
        is_unnamed = named == (None, None)
        is_whole = is_unnamed or (self.validation is not None and has_test)
        remedy = "name intervals for data.validation and data.test"
        require(is_whole, "data.validation, data.test", named, "one is missing", remedy)
        is_free = self.split == "auto" and is_unnamed and not has_test
        problem = "validation and test are stated as well"
        remedy = "leave out data.split, validation, test and test_path"
        require(self.fold is None or is_free, "data.fold", self.fold, problem, remedy)

    def _check_closed_loop(self) -> None:
        """Raise `BadRequest` for impossible PI controller settings, or for such settings together
        with a set point."""
        both = (self.reference, self.controller)
        is_single = None in both
        problem = "only one of them can be given"
        remedy = "name the set point alone"
        require(is_single, "data.reference, data.controller", both, problem, remedy)
        if self.controller is None:
            return
        is_pair = len(self.controller) == 2
        gain, integral_s = self.controller if is_pair else (0.0, 0.0)
        is_pi = 0 < abs(gain) < np.inf and integral_s > 0
        remedy = "give [gain, integral time in seconds]"
        problem = "is no PI, which has a gain and a positive integral time"
        require(is_pi, "data.controller", self.controller, problem, remedy)

    def _check_disturbance_columns(self) -> None:
        """Raise `BadRequest` for a disturbance column that is named twice or is also an input or
        output."""
        names = as_name_tuple(self.disturbance or ())
        require(all(names), "data.disturbance", names, "names no column", "name one, or none")
        twice = [name for name in names if names.count(name) > 1]
        problem = "the same column twice"
        require(not twice, "data.disturbance", twice[:1], problem, "name each column once")
        outputs = () if self.has_output_files else as_name_tuple(self.output)
        signal_names = {
            "an input": as_name_tuple(self.input),
            "an output": outputs,
            "the set point": as_name_tuple(self.reference or ()),
        }
        if self.time is not None:
            signal_names["the clock"] = (str(self.time),)
        for role, columns in signal_names.items():
            both = sorted(set(names) & set(columns))
            remedy = "name a column that is measured and nothing else"
            require(not both, "data.disturbance", both, f"is {role} too", remedy)

    @property
    def disturbances(self) -> Channels:
        """Names and units of the measured disturbances of a recorded data set."""
        if not self.disturbance:
            return ()
        units = self.disturbance_unit
        return name_channels(self.disturbance, units, "disturbance", self.has_output_files)

    @property
    def has_output_files(self) -> bool:
        return self.output_path is not None

    def pair_input_and_output_files(self, field: str, outputs: str) -> list[tuple[Path, ...]]:
        """Pair each input file with its output file, if the outputs are recorded in files of their
        own. Raises `BadRequest` if there are too few or too many."""
        names = as_name_tuple(getattr(self, field) or ())
        others = as_name_tuple(getattr(self, outputs) or ())
        expected = len(names) if self.has_output_files else 0
        problem = f"{len(others)} files of outputs, {expected} expected"
        remedy = "name one for each file of inputs"
        is_paired = len(others) == expected
        require(is_paired, f"data.{outputs}", list(others), problem, remedy)
        pairs = zip(names, others, strict=True) if others else zip(names)
        return [tuple(map(Path, pair)) for pair in pairs]

    def data_files(self) -> tuple[Path, ...]:
        pairs = self.pair_input_and_output_files("path", "output_path")
        pairs += self.pair_input_and_output_files("test_path", "test_output_path")
        paths = tuple(path for pair in pairs for path in pair)
        for path in paths:
            problem = "no such file"
            remedy = "check the spelling, and go to the folder from which it is named"
            require(path.is_file(), "data.path", path, problem, remedy)
        return paths

    def build(self, seed: int) -> DataSet:
        logs = self._read_logs("path", "output_path")
        cuts, split = self._split_logs([log.pieces for log in logs])
        training = [piece for pieces in cuts for piece in pieces[0]]
        validation = [piece for pieces in cuts for piece in pieces[1]]
        test = [piece for pieces in cuts for piece in pieces[2]]
        if self.test_path is not None:
            tested = self._read_logs("test_path", "test_output_path", before=len(logs))
            test = [piece for log in tested for piece in log.pieces]
        about = {"path": ", ".join(as_name_tuple(self.path)), "seed": str(seed), "split": split}
        remarks = dict.fromkeys(log.remark for log in logs)
        pieces = [piece for log in logs for piece in log.pieces]
        turns = output_angle_remarks([piece.y for piece in pieces], self.outputs)
        about["reading"] = "; ".join([". ".join(remarks), *turns])
        share = logs[0].share_by_set_point
        about |= {} if share is None else {"by_set_point": f"{share:.2f}"}
        channels: tuple[Channels, ...] = (self.inputs, self.outputs)
        channels = (*channels, self.disturbances) if self.disturbances else channels
        data = self.assemble_about_equilibrium((training, validation, test), channels, **about)
        return replace(data, mismatch_records=self._cut_mismatch_records(logs))

    def _cut_mismatch_records(self, logs: "list[_LogWithRemarks]") -> tuple[Trajectory, ...]:
        """Cut from the logs the records that only measure the model error: segments of constant
        input, and repeated periods."""
        pieces = [piece for log in logs for piece in log.pieces]
        rests = [splits.rest_segments(piece) for piece in pieces]
        periodic = [splits.periodic_segments(piece, self.start_up_samples) for piece in pieces]
        segments = [*rests, *(periodic if all(periodic) else [])]
        # A rest within the start-up window would be simulated and never scored.
        least = self.start_up_samples + 1
        return tuple(one for found in segments for one in found if len(one) > least)

    def _log_files(self, field: str, outputs: str) -> list[tuple[Path, ...]]:
        """Files of each log: a single file, or one file for the inputs and one for the outputs."""
        files = self.pair_input_and_output_files(field, outputs)
        if len(files) != 2 or self.has_output_files:
            return files
        (first,), (second,) = files
        settings = self.text_settings
        inputs = as_name_tuple(self.input)
        measured = as_name_tuple(self.output)
        alone = has_columns(first, measured, settings) or not has_columns(first, inputs, settings)
        apart = not alone and has_columns(second, measured, settings)
        return [(first, second)] if apart else files

    def _read_logs(self, field: str, outputs: str, before: int = 0) -> "list[_LogWithRemarks]":
        """Read every log, and replace the input of closed-loop logs by the part that the set point
        explains. The share of the input's power in that part is noted."""
        source = self
        if self.reference is not None:
            columns = [*as_name_tuple(self.input), *as_name_tuple(self.reference)]
            source = replace(self, input=columns, input_unit="", reference=None)
        logs = []
        for number, files in enumerate(self._log_files(field, outputs), start=before + 1):
            pieces, remark = source.read_pieces(*files)
            numbered = [replace(piece, log=number) for piece in pieces]
            logs.append(_LogWithRemarks(pieces=numbered, remark=remark))
        if self.reference is None and self.controller is None:
            return logs
        return self._project_inputs(logs)

    def read_pieces(
        self,
        path: Path,
        output_path: Path | None = None,
        *,
        first: int = 0,
        last: int | None = None,
    ) -> tuple[list[Trajectory], str]:
        """Read one log as pieces without gaps, together with its measured disturbances.
        Disturbances are read, held and averaged like inputs."""
        if self.disturbance is None:
            return super().read_pieces(path, output_path, first=first, last=last)
        columns = [*as_name_tuple(self.input), *as_name_tuple(self.disturbance)]
        source = replace(self, input=columns, input_unit="", disturbance=None)
        pieces, remark = source.read_pieces(path, output_path, first=first, last=last)
        count = len(self.inputs)
        apart = []
        for piece in pieces:
            u, d = np.split(piece.u, [count], axis=1)
            apart.append(replace(piece, u=u, d=d))
        return apart, remark

    def _project_inputs(self, logs: "list[_LogWithRemarks]") -> "list[_LogWithRemarks]":
        """Replace the input of closed-loop logs by the part that the set point explains."""
        pieces = [piece for log in logs for piece in log.pieces]
        count = len(self.inputs)
        if self.controller is not None:
            gain, integral_s = self.controller
            references = [reconstruct_pi_set_point(piece, gain, integral_s) for piece in pieces]
        else:
            references = [piece.u[:, count:] for piece in pieces]
            pieces = [replace(piece, u=piece.u[:, :count]) for piece in pieces]
        made, share = project_inputs_on_set_points(pieces, references)
        projected = []
        first = logs[0].pieces[0].log
        for number, log in enumerate(logs, start=first):
            own = [piece for piece in made if piece.log == number]
            projected.append(replace(log, pieces=own, share_by_set_point=share))
        return projected

    def _split_logs(self, logs: list[list[Trajectory]]) -> tuple[list[Pieces], str]:
        """Split every log into training, validation and test, and describe the split in words."""
        splitter, words = self._choose_splitter(logs)
        cuts = [self._split_log(log, splitter) for log in logs]
        samples = sum(len(piece) for log in logs for piece in log)
        used_samples = sum(len(record) for cut in cuts for part in cut for record in part)
        short = f"; {samples - used_samples} samples in stretches that are too short are left out"
        return cuts, words + (short if used_samples < samples else "")

    def _split_log(self, log: list[Trajectory], splitter: Splitter) -> Pieces:
        """Split one log, which may have gaps, into training, validation and test."""
        return splits.split_log_with_gaps(log, splitter, self.start_up_samples + 2)

    def _choose_splitter(self, logs: list[list[Trajectory]]) -> tuple[Splitter, str]:
        """Choose the function that splits a log into training, validation and test, and describe
        its rule in words."""
        if self.validation is not None:
            named = {"validation": self.validation, "test": self.test or []}
            return partial(split_at_intervals, intervals=named), "into named intervals"
        if self.fold is not None:
            description = (
                f"into {self.folds} folds, of which number {self.fold} tests "
                "and the one before it validates"
            )
            return partial(split_by_fold, fold=self.fold, folds=self.folds), description
        own_test = self.test_path is None
        test = self.test_fraction if own_test else 0.0
        in_time = partial(split_by_time, validation=self.validation_fraction, test=test)
        if self.split == "time" or not own_test:
            return in_time, "in the order of time"
        if self.split == "auto":
            shortest = self.start_up_samples + FEWEST
            able = all(sum(map(len, log)) // BLOCKS >= shortest for log in logs)
            cuts = [self._split_log(log, in_time) for log in logs]
            if not able or not any(map(is_test_output_different, cuts)):
                return in_time, "in the order of time"
        why = "" if self.split == "blocks" else ", because its end is unlike its beginning"
        return split_into_blocks, f"in {BLOCKS} interleaved blocks{why}"


@dataclass(frozen=True, kw_only=True)
class _LogWithRemarks:
    """One log, split into pieces without gaps, with remarks on how the log was read."""

    pieces: list[Trajectory]
    remark: str
    share_by_set_point: float | None = None
