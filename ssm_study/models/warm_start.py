"""Choice of a record's initial state: estimated from its first samples, or simulated over the
preceding log.

A piece that is cut out of a log has a past: the model, run from the beginning of the log to the
piece, arrives there in a state that owes nothing to the piece's outputs. The first samples of the
piece give another start (`models.metrics.estimate_initial_state`). Neither is better everywhere: a
slow mode is badly seen in twenty samples, a drift of the plant is not in the past's inputs. So both
are tried on pieces of the training and validation records that have a past, and the one that
predicts them better is taken for every piece.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.columns import ITERATED
from ssm_study.models.identified import SSM, ScaffoldedModel
from ssm_study.models.metrics import Simulation, estimate_initial_state
from ssm_study.signals import DataSet, Trajectories, Trajectory

PAST = "past"
SAMPLES = "samples"
PIECES = 10  # of the training and validation records, at most, on which the starts are compared
SHORTEST_PAST = 2  # start-up windows that the past has to last
CAPPED = 1.0  # largest share of a piece's power that an error counts for

State = Float[np.ndarray, "n"]
States = tuple[State | None, ...]


@dataclass(frozen=True, kw_only=True)
class InitialStateChoice:
    """Initial states of validation and test records, simulated over the preceding log, and whether
    they give smaller errors than estimated ones.

    `choice` is None where no record has a past: then initial states can only be estimated from
    first samples. `is_undecided` says that the two are so near that rounding on another machine may
    choose the other.
    """

    choice: str | None
    validation: States
    test: States
    is_undecided: bool = False

    def chosen_initial_states(self, part: str) -> States:
        """Chosen initial states of the validation or test records; None where the first samples are
        used to estimate them."""
        from_past: States = getattr(self, part)
        return from_past if self.choice == PAST else (None,) * len(from_past)


def choose_initial_state_source(model: Any, data: DataSet) -> InitialStateChoice:
    """Choose whether records' initial states are estimated from first samples or simulated over the
    preceding log.

    Nothing of the test records is used but the inputs and outputs that precede them in their logs.
    """
    none = InitialStateChoice(
        choice=None, validation=(None,) * len(data.validation), test=(None,) * len(data.test)
    )
    if data.start_up_samples == 0 or not isinstance(model, ScaffoldedModel):
        return none
    validation = states_from_preceding_log(model, data, data.validation)
    test = states_from_preceding_log(model, data, data.test)
    if all(state is None for state in (*validation, *test)):
        return none
    errors = errors_by_initial_state_source(model, data)
    if errors is None:
        return InitialStateChoice(choice=SAMPLES, validation=validation, test=test)
    return InitialStateChoice(
        choice=PAST if errors[PAST] < errors[SAMPLES] else SAMPLES,
        validation=validation,
        test=test,
        is_undecided=bool(np.isclose(errors[PAST], errors[SAMPLES], rtol=ITERATED, atol=0)),
    )


def errors_by_initial_state_source(model: Any, data: DataSet) -> dict[str, float] | None:
    """Mean simulation errors with two kinds of initial states: estimated from first samples, or
    simulated over the preceding log.

    Of every piece the error's power counts as a share of the
    piece's own, at most one: one divergent piece must not decide.
    """
    pieces = initial_state_comparison_records(data)
    from_past = states_from_preceding_log(model, data, pieces)
    pairs = zip(pieces, from_past, strict=True)
    with_past = [(piece, state) for piece, state in pairs if state is not None]
    if not with_past:
        return None
    records = tuple(piece for piece, _ in with_past)
    states = tuple(state for _, state in with_past)
    return {
        PAST: mean_relative_error_power(model, data, records, states),
        SAMPLES: mean_relative_error_power(model, data, records, (None,) * len(records)),
    }


def initial_state_comparison_records(data: DataSet) -> Trajectories:
    """Training and validation records on which estimated initial states are compared with states
    simulated over the preceding log. Long ones are cut into pieces as long as a test record."""
    records = [record for record in (*data.training, *data.validation) if record.log]
    tested = max((len(record) for record in data.test), default=0)
    total = sum(len(record) for record in records)
    length = max(tested, total // PIECES, 4 * data.start_up_samples)
    pieces: list[Trajectory] = []
    for record in records:
        count = max(round(len(record) / length), 1)
        edges = np.linspace(0, len(record), count + 1).round().astype(int)
        pieces += [record[a:b] for a, b in pairwise(edges)]
    return tuple(piece for piece in pieces if len(piece) > 2 * data.start_up_samples)


def mean_relative_error_power(
    model: Any, data: DataSet, records: Trajectories, states: Sequence[Any]
) -> float:
    """Mean power of the simulation error relative to the power of the output, limited to one for
    each record."""
    scale = data.scale.output_scale
    run = Simulation.simulate_records(model, records, data.start_up_samples, tuple(states))
    shares = []
    for record, simulated in zip(records, run.simulated, strict=True):
        y = (record.y / scale)[data.start_up_samples :]
        error = y - (simulated / scale)[data.start_up_samples :]
        power = float(((y - y.mean(axis=0)) ** 2).sum())
        missed = float((error**2).sum())
        shares.append(min(missed / power, CAPPED) if power > 0 and np.isfinite(missed) else CAPPED)
    return float(np.mean(shares))


def states_from_preceding_log(model: Any, data: DataSet, records: Trajectories) -> States:
    """State of a model at the beginning of each record, simulated over the part of the log before
    the record. It is None for a record behind less than two start-up windows of its log."""
    return tuple(state_from_preceding_log(model, data, piece) for piece in records)


def state_from_preceding_log(model: Any, data: DataSet, record: Trajectory) -> State | None:
    """State of a model at the beginning of one record, simulated over the log before the record."""
    past = preceding_log(data, record)
    if past is None or len(past) < SHORTEST_PAST * data.start_up_samples:
        return None
    start = estimate_initial_state(model, past, data.start_up_samples)
    _, states = model.simulate_recurrence(model.driving_signals(past.u, past.d), start)
    return np.asarray(states if isinstance(model, SSM) else states[-1], dtype=np.float64)


def preceding_log(data: DataSet, piece: Trajectory) -> Trajectory | None:
    """Part of the log that directly precedes a record; None if there is none."""
    records = [*data.training, *data.validation, *data.test]
    all_records = [record for record in records if record.log and record.log == piece.log]
    joined: list[Trajectory] = []
    first = piece.first
    while first > 0:
        holders = [
            candidate
            for candidate in all_records
            if candidate.first < first <= candidate.first + len(candidate)
        ]
        if not holders:
            break
        before = holders[0]
        joined.insert(0, before[: first - before.first])
        first = before.first
    return Trajectory.concatenate(joined) if joined else None


def join_records_without_gaps(data: DataSet) -> list[Trajectory]:
    """Join records that follow each other directly in a log, and return the resulting stretches
    without gaps."""
    records = [*data.training, *data.validation, *data.test]
    all_records = sorted((one for one in records if one.log), key=lambda one: (one.log, one.first))
    stretches: list[list[Trajectory]] = []
    for record in all_records:
        before = stretches[-1][-1] if stretches else None
        follows = (
            before is not None
            and before.log == record.log
            and before.first + len(before) == record.first
        )
        if follows:
            stretches[-1].append(record)
        else:
            stretches.append([record])
    return [Trajectory.concatenate(stretch) for stretch in stretches]


def simulate_validation_and_test(model: Any, data: DataSet) -> tuple[Simulation, Simulation]:
    """Simulate a model on the validation and test records from the chosen initial states."""
    starts = choose_initial_state_source(model, data)
    window = data.start_up_samples
    validation = Simulation.simulate_records(
        model, data.validation, window, starts.chosen_initial_states("validation")
    )
    test = Simulation.simulate_records(
        model, data.test, window, starts.chosen_initial_states("test")
    )
    return validation, test


def simulate_from_alternative_states(
    model: Any, data: DataSet, test: Simulation
) -> Simulation | None:
    """Simulate a model on the test records from the other kind of initial states than the chosen
    one; None if there is only one kind."""
    if len(test.starts) != len(data.test) or not isinstance(model, ScaffoldedModel):
        return None
    states: States = (None,) * len(data.test)
    if all(state is None for state in test.starts):
        states = (
            states_from_preceding_log(model, data, data.test) if data.start_up_samples else states
        )
        if all(state is None for state in states):
            return None
    return Simulation.simulate_records(model, data.test, data.start_up_samples, states)


def initial_state_columns(model: Any, data: DataSet, test: Simulation) -> dict[str, Any]:
    """Table columns on whether initial states were estimated or simulated over the preceding log,
    and the test fit with the alternative. They are null where no test record has a log before
    it."""
    other = simulate_from_alternative_states(model, data, test)
    if other is None:
        return {"piece_start": None, "fit_test_other_start_percent": None}
    from_past = any(state is not None for state in test.starts)
    return {
        "piece_start": PAST if from_past else SAMPLES,
        "fit_test_other_start_percent": other.fit_percent,
    }
