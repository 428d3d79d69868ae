"""Split of a log into training, validation and test: by time, at given intervals, in alternating
blocks, or by folds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Int

from ssm_study.refusal import require
from ssm_study.signals import Trajectory, find_repetition

Pieces = tuple[list[Trajectory], list[Trajectory], list[Trajectory]]
Intervals = Sequence[list[float]]

BLOCKS = 10  # interleaved: of every five blocks three train, one validates, one tests
SHORTEST_REST = 8  # samples
FEWEST = 50  # samples a block needs beyond the start-up window
# training deviations by which the output's mean at the end may differ; its deviation: a factor of
# two
UNLIKE = 1.0


def split_log_with_gaps(
    log_pieces: Sequence[Trajectory], split_record: Callable[[Trajectory], Pieces], min_samples: int
) -> Pieces:
    """Split a log that has gaps into training, validation and test records, as if the log had no
    gaps. Its samples are counted over the gaps.

    Parts of a piece that are shorter than `min_samples` samples are left out.
    """
    if len(log_pieces) == 1:
        return split_record(log_pieces[0])
    whole = replace(Trajectory.concatenate(log_pieces), first=0)
    parts: Pieces = ([], [], [])
    for part, records in zip(parts, split_record(whole), strict=True):
        for record in records:
            part += _cut_record_at_gaps(record, log_pieces, min_samples)
    return parts


def _cut_record_at_gaps(
    record: Trajectory, log_pieces: Sequence[Trajectory], min_samples: int
) -> list[Trajectory]:
    """Cut a record of a log at the gaps of the log."""
    stretches = []
    start = 0
    for piece in log_pieces:
        begin = record.first - start
        a = max(begin, 0)
        b = min(begin + len(record), len(piece))
        if b - a >= min_samples:
            stretches.append(piece[a:b])
        start += len(piece)
    return stretches


def split_by_time(record: Trajectory, validation: float, test: float) -> Pieces:
    """Split a record by time into training, validation and test, in this order. Contiguous pieces,
    in the order of time: training first."""
    samples = len(record)
    first = round(samples * (1 - validation - test))
    second = round(samples * (1 - test))
    training = record[:first]
    validating = record[first:second]
    testing = record[second:]
    return [training], [validating], [testing]


def split_into_blocks(record: Trajectory) -> Pieces:
    """Split a record into equal blocks that alternate between training, validation and test. Of
    `BLOCKS` equal pieces, 1, 2, 3 train, 4 validates, 5 tests, and so on."""
    edges = np.linspace(0, len(record), BLOCKS + 1)
    samples = edges.round().astype(int)
    blocks = [record[a:b] for a, b in pairwise(samples)]
    training = [block for k, block in enumerate(blocks) if k % 5 < 3]
    validating = blocks[3::5]
    testing = blocks[4::5]
    return training, validating, testing


def split_at_intervals(record: Trajectory, intervals: Mapping[str, Intervals]) -> Pieces:
    """Split a record into validation and test at stated time intervals, and training from
    everything else. `intervals` holds intervals in seconds for `validation` and `test`; the rest,
    piece by piece, trains.

    Raises `BadRequest` for an interval that is empty, outside the log, or shared by two parts.
    """
    part = np.zeros(len(record), dtype=int)
    for number, name in enumerate(("validation", "test"), start=1):
        for interval in intervals.get(name, ()):
            field = f"data.{name}"
            pair = np.asarray(interval)  # of a flat list: a number
            start, end = _interval_samples(record, pair, field)
            is_free = not part[start:end].any()
            problem = "overlaps another interval"
            remedy = "give each sample to one part"
            require(is_free, field, pair.tolist(), problem, remedy)
            part[start:end] = number
    return _cut_into_parts(record, part)


def _interval_samples(record: Trajectory, interval_s: np.ndarray, field: str) -> tuple[int, int]:
    """First sample of a time interval given in seconds, and the sample after the last. Raises
    `BadRequest` for any other value."""
    is_pair = interval_s.shape == (2,) and interval_s.dtype.kind in "iuf"
    ends = np.zeros(2)
    if is_pair:
        ends = np.rint(interval_s / record.step_s)
    inside = 0 <= ends[0] < ends[1] <= len(record)
    duration_s = len(record) * record.step_s
    problem = f"the log lasts {duration_s:g} s"
    remedy = "give a list of pairs [from, to] in seconds, within it: [[0,20]]"
    require(inside, field, interval_s.tolist(), problem, remedy)
    start, end = ends.astype(int)
    return int(start), int(end)


def split_by_fold(record: Trajectory, fold: int, folds: int) -> Pieces:
    """Split a record into equal folds, of which one is for test, the one before it for validation,
    and all others for training. The last fold counts as the one before the first; all others
    train."""
    samples = len(record)
    piece = folds * np.arange(samples) // samples
    is_tested = piece == fold
    validates = piece == (fold - 1) % folds
    part = np.select([is_tested, validates], [2, 1], 0)
    return _cut_into_parts(record, part)


def cut_out_fold(record: Trajectory, fold: int, folds: int) -> tuple[list[Trajectory], Trajectory]:
    """Cut one of several equal folds out of a record, and return the remaining pieces and the
    fold."""
    samples = len(record)
    start = round(samples * fold / folds)
    end = round(samples * (fold + 1) / folds)
    sides = (record[:start], record[end:])
    remaining = [piece for piece in sides if len(piece)]
    return remaining, record[start:end]


def rest_segments(record: Trajectory) -> list[Trajectory]:
    """Segments of a record in which the input is constant at the value that it has at the end. A
    record that ends in motion has none. Measured disturbances count as inputs.

    A segment counts if it lasts at least half as long as the last one. Segments serve as evidence;
    no fit uses them.
    """
    return [record[a:b] for a, b in _rest_ranges(record)]


def periodic_segments(record: Trajectory, start_up_samples: int) -> list[Trajectory]:
    """Segments of a record in which the input is periodic, between segments of constant input. Half
    of the constant segment before and all of the one behind belong to each.

    `ssm-study excite` writes one for each amplitude: the part of the output in which the periods
    differ is noise. A log that also moves otherwise has none, because a few equal pulses would then
    stand for the whole log.
    """
    rests = _rest_ranges(record, includes_beginning=True)
    if not rests or rests[0][0] != 0:
        return []
    between = []
    for (a, b), (_, end) in pairwise(rests):
        between.append(record[(a + b) // 2 : end])
    for piece in between:
        scored_input = piece.inputs_and_disturbances[start_up_samples:]
        if not find_repetition(scored_input):
            return []
    return between


def _rest_ranges(record: Trajectory, includes_beginning: bool = False) -> list[tuple[int, int]]:
    """Index ranges of a record in which the input is constant at the value that it has at the end.
    With `includes_beginning`, a range at the beginning of the record counts, too."""
    moving = record.inputs_and_disturbances
    is_elsewhere = (moving != moving[-1]).any(axis=1)
    moved = np.flatnonzero(is_elsewhere)
    if not len(moved):
        return []
    last_rest = len(record) - moved[-1]
    if last_rest <= SHORTEST_REST:
        return []
    before = [-1] if includes_beginning else []
    ends = [*before, *moved.tolist(), len(record)]
    long = [(a, b) for a, b in pairwise(ends) if b - a > last_rest / 2]
    return [(max(a, 0), b) for a, b in long]


def _cut_into_parts(record: Trajectory, codes: Int[np.ndarray, "T"]) -> Pieces:
    """Cut a record into pieces for training, validation and test, according to a code for each
    sample. 0 trains, 1 validates, 2 tests."""
    pieces: Pieces = ([], [], [])
    changes = np.diff(codes, prepend=-1, append=-1)
    edges = np.flatnonzero(changes)
    for a, b in pairwise(edges):
        pieces_of_part = pieces[codes[a]]
        pieces_of_part.append(record[a:b])
    return pieces


def is_test_output_different(parts: Pieces) -> bool:
    """Whether the output in the test records differs in mean or standard deviation from that in the
    training records."""
    if not parts[0] or not parts[2]:
        return True
    training, _, testing = parts
    trained = np.concatenate([record.y for record in training])
    tested = np.concatenate([record.y for record in testing])
    spread = trained.std(axis=0) + np.finfo(float).tiny
    other = tested.std(axis=0)
    shift = tested.mean(axis=0) - trained.mean(axis=0)
    has_moved = np.abs(shift) > UNLIKE * spread
    is_wider = other > 2 * spread
    is_narrower = other < spread / 2
    return bool((has_moved | is_wider | is_narrower).any())
