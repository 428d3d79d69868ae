"""Findings on the contents of the records: ranges, levels, spectra, length, drift and
repetition."""

from collections.abc import Iterator

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.data.log_dynamics import (
    FOLLOWS,
    explained_output_variance,
    largest_explained_variance,
)
from ssm_study.evidence.feedback import ROUNDING, integrator_share
from ssm_study.evidence.finding import EvidenceCase, Finding, ScaledRecord, make_doubt, make_note
from ssm_study.evidence.response import INTEGRATES, slowest_mode_remainder
from ssm_study.evidence.rests import judge_return_to_rest
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.warm_start import join_records_without_gaps
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.return_to_rest import RESPONSES
from ssm_study.signals import DataSet, Trajectory

BEYOND = 0.05
# share of samples that may lie beyond the range of training, by more than this share of it
ROOM = 0.05
PART = 0.05  # share of the test record that may be part of the training records
REACHED = 1.2  # a loop may start this far beyond what the training records reached
AT_LIMIT = 0.02  # share of samples that may read exactly the largest or the smallest output
FEW_VALUES = 50  # distinct outputs up to which a sensor is too coarse to tell a limit
APPROACH = 6  # samples over which a limit is approached
ENTERED = 0.4  # of the rms move over so many samples: the speed with which a limit is run into
FEWEST_STRETCHES = 3  # at a limit: a position is at its farthest once
ONE_SIDED = 0.02  # least share of the samples on either side of the equilibrium
FEWEST_CHANGES = 10
FEWEST_SAMPLES = 200
DRIFT = 0.2  # shift of the residual from the first quarter to the last, in output scales
WINDOW = 12  # samples that agree exactly in two records only by being the same
LONGEST_WINDOW = 96  # samples, for records that repeat themselves in shorter ones
BY_CHANCE = 0.01  # share of windows that may stand in the training records twice
UNTRAINED = 0.2  # share of the test input's power in bands that training did not excite


def judge_records(case: EvidenceCase, mismatch: Mismatch) -> list[Finding]:
    """Findings on the contents of the records: ranges, levels, length, drift, spectra and return to
    rest. Findings on rest and on what is unknown of the model error come last."""
    looks = (
        _range_sentences,
        _input_level_sentences,
        _length_sentences,
        _drift_sentences,
        _repetition_sentences,
        _spectrum_sentences,
    )
    doubts = [make_doubt(sentence) for look in looks for sentence in look(case)]
    return [*doubts, *_saturation_findings(case), *judge_return_to_rest(case, mismatch)]


def _join_scaled_records(case: EvidenceCase, records: tuple[Trajectory, ...]) -> ScaledRecord:
    """Scaled inputs and outputs of several records, concatenated."""
    parts = [case.scale_record(record) for record in records]
    inputs = np.concatenate([u for u, _ in parts])
    return inputs, np.concatenate([y for _, y in parts])


def _range_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentences on test records whose input or output leaves the range of the training records.

    If a model integrates its input, it does not matter at which level of the output it was trained:
    its next change is the same at every level.
    """
    trained = _join_scaled_records(case, case.data.training)
    sides = [("input", 0)] if model_integrates(case) else [("input", 0), ("output", 1)]
    for name, index in sides:
        low = trained[index].min(axis=0)
        high = trained[index].max(axis=0)
        tested = _join_scaled_records(case, case.data.test)[index]
        room = ROOM * (high - low)
        is_beyond = (tested < low - room) | (tested > high + room)
        share = float(is_beyond.any(axis=1).mean())
        if share > BEYOND:
            yield (
                f"{100 * share:.0f} % of the test record's {name} is beyond the training "
                "records: train there too."
            )
    loops = [case.scale_record(record) for record in case.data.mismatch_records]
    starts = [abs(y[0]) for u, y in loops if not np.any(u)]
    reached = np.abs(trained[1]).max()
    farthest = max((float(start.max()) for start in starts), default=0.0)
    if farthest > REACHED * reached:
        yield (
            f"The loop starts {farthest / reached:.1f} times as far out as the training records "
            "go: excite more."
        )


def _input_level_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentences on a training input that changes too rarely, takes only two levels or stays on one
    side."""
    u = _join_scaled_records(case, case.data.training)[0]
    changes = count_input_changes(case.data)
    if changes < FEWEST_CHANGES:
        yield f"The input changes {changes} times in all training records: move it more often."
    if any(len(np.unique(column)) <= 2 for column in u.T):
        yield (
            "The input has two levels, which leave the slopes of S_u between them open: use many "
            "levels."
        )
    above = (u > 0).mean(axis=0).min()
    below = (u < 0).mean(axis=0).min()
    sides = float(min(above, below))
    if sides < ONE_SIDED:
        yield (
            "The input stays on one side of its equilibrium, and a loop will not: record both "
            "sides."
        )


def count_input_changes(data: DataSet) -> int:
    """Number of samples in the training records at which the input changes. A change where a record
    continues an earlier piece of the same log counts, too.

    A log that is cut at its steps has none within its pieces.
    """
    parts = (data.training, data.validation, data.test)
    pieces = [piece for part in parts for piece in part if piece.log]
    ending = {}
    for piece in pieces:
        end = piece.first + len(piece)
        ending[piece.log, end] = piece.u[-1]
    changes = 0
    for record in data.training:
        moves = np.diff(record.u, axis=0) != 0
        changes += int(np.any(moves, axis=1).sum())
        before = ending.get((record.log, record.first)) if record.log else None
        changes += before is not None and bool(np.any(before != record.u[0]))
    return changes


def _saturation_findings(case: EvidenceCase) -> Iterator[Finding]:
    """Findings on an output that stays at its largest or smallest value while the input moves.

    A machine that comes to a stop reads zero, too: the log alone cannot distinguish a dead zone
    from the end of a sensor's range.
    """
    outputs = np.concatenate([record.y for record in case.data.training]).T
    for i, (channel, column) in enumerate(zip(case.data.outputs, outputs, strict=True)):
        if len(np.unique(column)) <= FEW_VALUES:
            continue
        for name, limit in (("largest", column.max()), ("smallest", column.min())):
            share = saturated_share(case, i, float(limit))
            if share <= AT_LIMIT:
                continue
            if limit == 0:
                yield make_note(
                    f"{channel.name} stands at 0 in {100 * share:.0f} % of samples while the input "
                    "moves: a dead zone, or the end of the sensor."
                )
            else:
                yield make_doubt(
                    f"{channel.name} reads its {name} value in {100 * share:.0f} % of samples: "
                    "it saturates."
                )


def saturated_share(case: EvidenceCase, output_index: int, limit: float) -> float:
    """Fraction of the training samples at which a moving output is at a limit of its sensor.

    Only stretches count in which the input still moves and which the output enters at speed: a
    machine at rest, or inside a dead zone, comes to its extreme slowly and once.
    """
    samples = 0
    counted = 0
    stretches = 0
    for record in case.data.training:
        u = record.u
        y = record.y[:, output_index]
        samples += len(y)
        if len(y) <= APPROACH:
            continue
        moves = np.abs(y[APPROACH:] - y[:-APPROACH])
        usual = float(np.sqrt((moves**2).mean()))
        at_limit = np.concatenate([[False], y == limit, [False]])
        edges = np.flatnonzero(np.diff(at_limit.astype(int)))
        for first, end in edges.reshape(-1, 2):
            entered = first >= APPROACH and moves[first - APPROACH] >= ENTERED * usual
            if entered and end - first > 1 and np.ptp(u[first:end], axis=0).any():
                counted += int(end - first)
                stretches += 1
    return counted / samples if stretches >= FEWEST_STRETCHES else 0.0


def _length_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentences on training records that are too short for the model, or shorter than its
    response."""
    samples = [len(record) for record in case.data.training]
    response = case.model.linear.impulse_response_length()
    if sum(samples) < FEWEST_SAMPLES:
        yield f"{sum(samples)} training samples are too few for a nonlinear model: record more."
    elif slowest_mode_remainder(case) > INTEGRATES:
        yield _slow_mode_sentence(case)
    elif max(samples) < RESPONSES * response:
        remedy = "record longer without a break"
        # It contracts, so an integrator looks like a slow mode.
        if isinstance(case.model, StructuredSSM) and not output_follows_input_level(case.data):
            remedy += "; if the output integrates its input, use model.integrating_output=true"
        yield (
            f"The model's response lasts {response} samples or more, the longest piece that "
            f"trains {max(samples)}: {remedy}."
        )


def _slow_mode_sentence(case: EvidenceCase) -> str:
    """Sentence on a model whose slowest mode decays little within the length of a record.

    It speaks of the output where the log shows that it integrates, else of the model alone.
    """
    remainder = 100 * slowest_mode_remainder(case)
    if integrator_share(case.data) is not None or not model_integrates(case):
        return (
            f"The output integrates its input: the slowest mode keeps {remainder:.1f} % over the "
            "longest record, so no log shows where it rests: try the loop, and refine with that "
            "log."
        )
    return (
        "The chosen model integrates its input, and the log does not show that the output does: "
        "over records this short a slow return looks alike. Record longer, or compare with "
        "model.integrating_output=false."
    )


def model_integrates(case: EvidenceCase) -> bool:
    """Whether an identified model integrates its input, so that the effect of an input never
    decays."""
    return case.model.linear.spectral_radius >= 1 - ROUNDING


def output_follows_input_level(data: DataSet) -> bool:
    """Whether the output in a log follows the level of the input, which rules out an integrating
    plant."""
    stretches = join_records_without_gaps(data)
    if not stretches or data.scale.inputs != 1 or data.scale.outputs != 1:
        return False
    longest = max(stretches, key=len)
    u = longest.u[:, 0]
    y = longest.y[:, 0]
    level = largest_explained_variance(u, y)
    return level > FOLLOWS and level >= explained_output_variance(u, y).change


def _drift_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentence on a simulation error that drifts within a record; none without such a drift."""
    errors = [e for _, _, e in case.scored_records()]
    shifts = []
    least = max(map(len, errors)) // 4  # a short piece of a slow process is off as a whole
    for e in (e for e in errors if len(e) >= least):
        quarter = max(len(e) // 4, 1)
        shift = e[-quarter:].mean(axis=0) - e[:quarter].mean(axis=0)
        shifts.append(float(np.abs(shift).max()))
    if max(shifts) > DRIFT:
        yield (
            f"The model's error drifts by {max(shifts):.2f} output scales within a record: "
            "record longer."
        )


def _repetition_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentence on test records that repeat parts of the training records; none without such
    repetition."""
    share = repeated_test_share(case.data)
    if share > PART:
        yield (
            f"{100 * share:.0f} % of the test record is part of the training records: its fit "
            "says nothing new."
        )


def repeated_test_share(data: DataSet) -> float:
    """Fraction of the test records' windows (short stretches) that occur identically in training
    records.

    A coarse sensor repeats itself by chance: input and output must agree, over windows so long
    that the training records hardly ever repeat themselves.
    """
    length = WINDOW
    while length < LONGEST_WINDOW and _repeated_share(data.training, length) > BY_CHANCE:
        length *= 2
    trained = set().union(*(_window_bytes(record, length) for record in data.training))
    tested = [_window_bytes(record, length) for record in data.test]
    shared = sum(len(windows & trained) for windows in tested)
    return shared / max(sum(len(windows) for windows in tested), 1)


def _window_bytes(record: Trajectory, length: int) -> set[bytes]:
    """Bytes of each window of a record, of given length, in which the output moves."""
    both = np.ascontiguousarray(np.concatenate([record.u, record.y], axis=1))
    pieces = (slice(k, k + length) for k in range(len(both) - length + 1))
    return {both[piece].tobytes() for piece in pieces if np.ptp(record.y[piece]) > 0}


def _repeated_share(records: tuple[Trajectory, ...], length: int) -> float:
    """Fraction of the windows (short stretches) with a moving output that occur more than once in
    the records."""
    moving = 0
    distinct: set[bytes] = set()
    for record in records:
        distinct |= _window_bytes(record, length)
        starts = range(len(record) - length + 1)
        moving += sum(np.ptp(record.y[k : k + length]) > 0 for k in starts)
    return 1 - len(distinct) / moving if moving else 0.0


def _spectrum_sentences(case: EvidenceCase) -> Iterator[str]:
    """Sentence on test inputs with frequencies that the training inputs do not excite; none without
    such inputs."""

    def input_power_spectrum(records: tuple[Trajectory, ...]) -> Float[np.ndarray, "F"]:
        """Power spectrum of the input over several records, summed over the channels."""
        u, _ = _join_scaled_records(case, records)
        _, spectrum = scipy.signal.welch(u, nperseg=min(64, len(u)), axis=0)
        return np.asarray(spectrum.sum(axis=1))

    trained = input_power_spectrum(case.data.training)
    tested = input_power_spectrum(case.data.test)
    if len(trained) != len(tested):
        return
    untrained = trained < 0.01 * trained.mean()
    whole = max(tested.sum(), np.finfo(float).tiny)
    share = float(tested[untrained].sum() / whole)
    if share > UNTRAINED:
        yield (
            f"{100 * share:.0f} % of the test input's power lies where training has none: train "
            "with that spectrum."
        )
