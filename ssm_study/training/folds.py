"""Cross-validation folds of the training and validation records, by which model settings are
chosen."""

from collections.abc import Sequence
from dataclasses import replace

from ssm_study.data.splits import cut_out_fold
from ssm_study.signals import DataSet, Trajectories, Trajectory

FOLDS = 4
START_UP = 20  # samples of a held-out piece that estimate its state, where a data set names none
SHORTEST_FOLD = 3 * START_UP  # samples: shorter held-out pieces cannot tell two models apart
SHORTEST_PIECE = 2 * START_UP  # samples: of what is left between two folds, to be trained on
MOST_SAMPLES = 12_000  # of training and validation together: of longer records, stretches


def join_training_and_validation(data: DataSet) -> DataSet:
    """Copy of a data set in which training and validation records are joined and serve both
    purposes. Pieces that follow each other in the same log are joined."""
    both = (*data.training, *data.validation)
    records = sorted(both, key=lambda record: (record.log, record.first))
    joined = tuple(join_consecutive_records(records))
    return replace(data, training=joined, validation=joined)


def join_consecutive_records(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Join records that follow each other directly in the same log."""
    joined: list[Trajectory] = []
    for record in records:
        before = joined[-1] if joined else None
        if (
            before is not None
            and before.log == record.log > 0
            and is_direct_continuation(record, before)
        ):
            record_pair = [before, record]
            joined[-1] = Trajectory.concatenate(record_pair)
        else:
            joined.append(record)
    return joined


def is_direct_continuation(record: Trajectory, previous: Trajectory) -> bool:
    """Whether a record begins directly after the end of another record of the same log."""
    samples_before = len(previous)
    return record.first == previous.first + samples_before


def make_folds(data: DataSet) -> tuple[DataSet, ...]:
    """Data sets for cross-validation, each with a different part held out as test; empty if the
    records are too short.

    Whole records are held out where there are enough, else pieces of the long ones. A piece starts
    in motion, so its first samples estimate its state and are not scored. No test record of `data`
    is looked at.
    """
    joined = join_training_and_validation(data).training
    whole = len(joined) >= FOLDS
    if not whole and len(max(joined, key=len)) < FOLDS * SHORTEST_FOLD:
        return ()
    unscored = data.start_up_samples or START_UP
    folds = []
    for k in range(FOLDS):
        trained, held_out = hold_out_records(joined, k) if whole else hold_out_pieces(joined, k)
        shortened = limit_total_length(trained)
        fold_data = replace(
            data, training=shortened, validation=held_out, test=held_out, start_up_samples=unscored
        )
        folds.append(fold_data)
    return tuple(folds)


def hold_out_records(records: Trajectories, fold: int) -> tuple[Trajectories, Trajectories]:
    """Split whole records for one cross-validation fold into training and held-out ones."""
    remaining = (record for k, record in enumerate(records) if k % FOLDS != fold)
    trained = tuple(remaining)
    return trained, records[fold::FOLDS]


def hold_out_pieces(records: Trajectories, fold: int) -> tuple[Trajectories, Trajectories]:
    """Cut a part out of each record for one cross-validation fold, and return the rest and the
    parts held out."""
    training: list[Trajectory] = []
    held_out: list[Trajectory] = []
    for record in records:
        if len(record) < FOLDS * SHORTEST_FOLD:
            training.append(record)
            continue
        pieces, out = cut_out_fold(record, fold, FOLDS)
        training += [piece for piece in pieces if len(piece) >= SHORTEST_PIECE]
        held_out.append(out)
    return tuple(training), tuple(held_out)


def limit_total_length(records: Trajectories) -> Trajectories:
    """Cut off the ends of records so that their total length stays below the limit for
    cross-validation."""
    lengths = (len(record) for record in records)
    total = sum(lengths)
    share = MOST_SAMPLES / total
    if share >= 1.0:
        return records
    shortened = (record[: max(SHORTEST_PIECE, round(share * len(record)))] for record in records)
    return tuple(shortened)
