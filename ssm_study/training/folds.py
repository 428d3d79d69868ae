"""Folds of the training and validation records, on which a choice of models is made."""

from collections.abc import Sequence
from dataclasses import replace

from ssm_study.data.splits import cut_out_fold
from ssm_study.signals import DataSet, Trajectories, Trajectory

FOLDS = 4
START_UP = 20  # samples of a held-out piece that estimate its state, where a data set names none
SHORTEST_FOLD = 3 * START_UP  # samples: shorter held-out pieces cannot tell two models apart
SHORTEST_PIECE = 2 * START_UP  # samples: of what is left between two folds, to be trained on
MOST_SAMPLES = 12_000  # of training and validation together: of longer records, stretches


def with_joined_records(data: DataSet) -> DataSet:
    """Data set with training and validation records as one part. Pieces that follow each other in
    the same log are joined."""
    records = sorted(
        (*data.training, *data.validation), key=lambda record: (record.log, record.first)
    )
    joined = tuple(joined_pieces(records))
    return replace(data, training=joined, validation=joined)


def joined_pieces(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Join records that follow one another in the same log."""
    joined: list[Trajectory] = []
    for record in records:
        before = joined[-1] if joined else None
        if before is not None and before.log == record.log > 0 and follows(record, before):
            joined[-1] = Trajectory.concatenate([before, record])
        else:
            joined.append(record)
    return joined


def follows(record: Trajectory, before: Trajectory) -> bool:
    """Whether a record begins at the sample after the last one of another."""
    return record.first == before.first + len(before)


def folds_of(data: DataSet) -> tuple[DataSet, ...]:
    """Data sets without one fold each, which is their `test` part. None for short records.

    Whole records are held out where there are enough, else pieces of the long ones. A piece starts
    in motion, so its first samples estimate its state and are not scored. No test record of `data`
    is looked at.
    """
    joined = with_joined_records(data).training
    whole = len(joined) >= FOLDS
    if not whole and len(max(joined, key=len)) < FOLDS * SHORTEST_FOLD:
        return ()
    unscored = data.start_up_samples or START_UP
    folds = []
    for k in range(FOLDS):
        kept, held_out = without_whole_records(joined, k) if whole else without_pieces(joined, k)
        folds.append(
            replace(
                data,
                training=shortened(kept),
                validation=held_out,
                test=held_out,
                start_up_samples=unscored,
            )
        )
    return tuple(folds)


def without_whole_records(records: Trajectories, fold: int) -> tuple[Trajectories, Trajectories]:
    """Records that train, and every `FOLDS`-th record, which is held out."""
    kept = tuple(record for k, record in enumerate(records) if k % FOLDS != fold)
    return kept, records[fold::FOLDS]


def without_pieces(records: Trajectories, fold: int) -> tuple[Trajectories, Trajectories]:
    """Records without one piece of each that is long enough, and the removed pieces."""
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


def shortened(records: Trajectories) -> Trajectories:
    """Records cut to `MOST_SAMPLES` together, each to the same share of its length, at its end."""
    share = MOST_SAMPLES / sum(len(record) for record in records)
    if share >= 1.0:
        return records
    return tuple(record[: max(SHORTEST_PIECE, round(share * len(record)))] for record in records)
