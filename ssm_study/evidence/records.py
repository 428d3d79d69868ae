"""What the records have visited: ranges, levels, spectra, length, drift, and records that are one
another."""

from collections.abc import Iterator

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.evidence.finding import Case, Finding, doubt, note
from ssm_study.evidence.response import INTEGRATES, kept_over
from ssm_study.models.structured import StructuredSSM
from ssm_study.robustness.mismatch import ANGLES, Mismatch
from ssm_study.robustness.return_to_rest import (
    AT_REST,
    FAINT,
    RESPONSES,
    after_motion,
    ends_apart,
    is_return,
    left,
)
from ssm_study.signals import Trajectory

BEYOND, ROOM = (
    0.05,
    0.05,
)  # share of samples that may lie beyond the range of training, by more than this share of it
PART = 0.05  # share of the test record that may be part of the training records
REACHED = 1.2  # a loop may start this far beyond what the training records reached
AT_LIMIT = 0.02  # share of samples that may read exactly the largest or the smallest output
ONE_SIDED = 0.02  # least share of the samples on either side of the equilibrium
FEWEST_CHANGES, FEWEST_SAMPLES = 10, 200
DRIFT = 0.2  # shift of the residual from the first quarter to the last, in output scales
WINDOW = 12  # samples that agree exactly in two records only by being the same
UNTRAINED = 0.2  # share of the test input's power in bands that training did not excite


def findings(case: Case, shown: Mismatch) -> list[Finding]:
    """All of them, each with its own sentence; those on rest and on what is unknown of the mismatch
    come last."""
    looks = (_range, _levels, _limits, _length, _drift, _same, _spectrum)
    return [*(doubt(sentence) for look in looks for sentence in look(case)), *_rest(case, shown)]


def _joined(
    case: Case, records: tuple[Trajectory, ...]
) -> tuple[Float[np.ndarray, "T m"], Float[np.ndarray, "T p"]]:
    parts = [case.scaled(record) for record in records]
    return np.concatenate([u for u, _ in parts]), np.concatenate([y for _, y in parts])


def _range(case: Case) -> Iterator[str]:
    trained = _joined(case, case.data.training)
    for name, index in (("input", 0), ("output", 1)):
        low, high = trained[index].min(axis=0), trained[index].max(axis=0)
        tested, room = _joined(case, case.data.test)[index], ROOM * (high - low)
        share = float(((tested < low - room) | (tested > high + room)).any(axis=1).mean())
        if share > BEYOND:
            yield f"{100 * share:.0f} % of the test record's {name} is beyond the training records: train there too."
    starts = [
        abs(case.scaled(record)[1][0])
        for record in case.data.mismatch_records
        if not np.any(case.scaled(record)[0])
    ]
    reached, farthest = (
        np.abs(trained[1]).max(),
        max((float(start.max()) for start in starts), default=0.0),
    )
    if farthest > REACHED * reached:
        yield f"The loop starts {farthest / reached:.1f} times as far out as the training records go: excite more."


def _levels(case: Case) -> Iterator[str]:
    u = _joined(case, case.data.training)[0]
    changes = sum(
        int(np.any(np.diff(record.u, axis=0) != 0, axis=1).sum()) for record in case.data.training
    )
    if changes < FEWEST_CHANGES:
        yield f"The input changes {changes} times in all training records: move it more often."
    if any(len(np.unique(column)) <= 2 for column in u.T):
        yield "The input has two levels, which leave the slopes of S_u between them open: use many levels."
    sides = float(min((u > 0).mean(axis=0).min(), (u < 0).mean(axis=0).min()))
    if sides < ONE_SIDED:
        yield "The input stays on one side of its equilibrium, and a loop will not: record both sides."


def _limits(case: Case) -> Iterator[str]:
    for channel, column in zip(
        case.data.outputs, _joined(case, case.data.training)[1].T, strict=True
    ):
        for name, limit in (("largest", column.max()), ("smallest", column.min())):
            share = float((column == limit).mean())
            if share > AT_LIMIT and len(np.unique(column)) > 50:
                yield f"{channel.name} reads its {name} value in {100 * share:.0f} % of samples: it saturates."


def _length(case: Case) -> Iterator[str]:
    samples, response = (
        [len(record) for record in case.data.training],
        case.model.linear.response_samples(),
    )
    if sum(samples) < FEWEST_SAMPLES:
        yield f"{sum(samples)} training samples are too few for a nonlinear model: record more."
    elif (kept := kept_over(case)) > INTEGRATES:
        told = f"The output integrates its input: the slowest mode keeps {100 * kept:.1f} % over the longest record"
        yield f"{told}, so no log shows where it rests: try the loop, and refine with that log."
    elif max(samples) < RESPONSES * response:
        remedy = "lengthen it"
        if isinstance(
            case.model, StructuredSSM
        ):  # it contracts, so an integrator looks like a slow mode
            remedy += "; if the output integrates its input, use model.integrated=true"
        yield f"The model's response lasts {response} samples or more, the longest record {max(samples)}: {remedy}."


def _drift(case: Case) -> Iterator[str]:
    errors, shifts = [e for _, _, e in case.scored()], []
    least = max(map(len, errors)) // 4  # a short piece of a slow process is off as a whole
    for e in (e for e in errors if len(e) >= least):
        quarter = max(len(e) // 4, 1)
        shifts.append(float(np.abs(e[-quarter:].mean(axis=0) - e[:quarter].mean(axis=0)).max()))
    if max(shifts) > DRIFT:
        yield f"The model's error drifts by {max(shifts):.2f} output scales within a record: record longer."


def _same(case: Case) -> Iterator[str]:
    def windows(record: Trajectory) -> set[bytes]:
        y = np.ascontiguousarray(record.y)
        moving = (y[k : k + WINDOW] for k in range(len(y) - WINDOW + 1))
        return {piece.tobytes() for piece in moving if np.ptp(piece) > 0}

    trained = set().union(*(windows(record) for record in case.data.training))
    tested = [windows(record) for record in case.data.test]
    share = sum(len(one & trained) for one in tested) / max(sum(len(one) for one in tested), 1)
    if share > PART:
        yield f"{100 * share:.0f} % of the test record is part of the training records: its fit says nothing new."


def _spectrum(case: Case) -> Iterator[str]:
    def power(records: tuple[Trajectory, ...]) -> Float[np.ndarray, "F"]:
        u = _joined(case, records)[0]
        return np.asarray(scipy.signal.welch(u, nperseg=min(64, len(u)), axis=0)[1].sum(axis=1))

    trained, tested = power(case.data.training), power(case.data.test)
    if len(trained) != len(tested):
        return
    share = float(
        tested[trained < 0.01 * trained.mean()].sum() / max(tested.sum(), np.finfo(float).tiny)
    )
    if share > UNTRAINED:
        yield f"{100 * share:.0f} % of the test input's power lies where training has none: train with that spectrum."


def _rest(case: Case, shown: Mismatch) -> Iterator[Finding]:
    """A plant that does not rest is judged, and refused; a record that cannot say so is a note."""
    response = case.model.linear.response_samples()
    still = (after_motion(*case.scaled(record), response) for record in case.data.test)
    off = max((*shown.stuck, *(left(y) for y in still if len(y))), default=0.0)
    if not shown.rests:
        told = (
            f"{shown.left_at_rest:.2g} output scales are left at rest input, more than {AT_REST:g}"
        )
        yield doubt(
            f"The output does not come to rest by itself ({told}): no loop is predicted to settle it."
        )
    elif off > AT_REST:
        told = f"After the input has moved it, the output stays {off:.2g} scales off at rest input"
        yield doubt(
            f"{told}: friction, play or several rests; a loop without integrators may stop as far off. "
            "Record more returns to rest."
        )
    elif shown.left_at_rest is None:
        apart = ends_apart(
            case.model.scale, [one for one in case.data.mismatch_records if is_return(one)]
        )
        problem = "No two returns to rest input outlast the model's response"
        if (
            apart > AT_REST
        ):  # what the short ones show is no proof of friction, and no reason for silence
            told = f"{problem}, and they end {apart:.2g} scales apart, where none seems to move"
            yield doubt(f"{told}: friction, play or a slow mode. Record longer ones.")
        else:
            yield note(
                f"{problem}: whether the output rests by itself is unknown; add such returns."
            )
    elif shown.left_at_rest > FAINT:
        told = f"{shown.left_at_rest:.2g} output scales are left at rest input: a small limit cycle, or a slow decay"
        yield doubt(
            f"{told}. A loop may swing farther, and settles in no narrower band. Record longer rests."
        )
    if len(shown.views) == 1:
        amplitude = f"{shown.views[0].amplitude:.2g} input scales, rms"
        yield note(
            f"All records have one amplitude ({amplitude}): below it the mismatch is unknown."
        )
    if shown.unexcited:
        hertz = min(shown.unexcited) / (2 * np.pi * case.data.step_s)
        bands = f"{len(shown.unexcited)} of {len(ANGLES)} bands, from {hertz:.3g} Hz"
        yield note(f"The input has no power in {bands}: the mismatch is poorly known there.")
