"""Checks of a log before its dynamics are measured: stretches that are too short or at rest, and
angles that wrap around."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.data.command_words import find_column_index
from ssm_study.signals import Channel

TURNS = (360.0, 2.0 * np.pi)  # degrees, radians
PART_OF_TURN = 0.3  # share of a turn that an angle itself moves in a sample, at most
WHOLE_TURN = 0.8  # share of a turn from which on a jump is one
FEWEST_TURNS = 2  # jumps
ANGLE = "like an angle that starts again"
ANGLE_REMEDY = "add the turns up, or take its rate for the output"

Signal = Float[np.ndarray, "T"]


def no_dynamics_reason(u: Signal, y: Signal, fewest: int) -> str:
    """Reason why no dynamics can be measured from a log: the longest gap-free part is too short or
    constant; empty if they can."""
    if len(u) < fewest:
        return f"the longest piece has {len(u)} samples, fewer than {fewest}"
    if np.ptp(u) == 0:
        return "the input stands still throughout the longest piece"
    return "the output stands still throughout the longest piece" if np.ptp(y) == 0 else ""


def angle_wrap_sentences(columns: Mapping[str, Signal], output: str) -> list[str]:
    """Sentence on an output that jumps by a whole turn, as an angle does when it wraps around; none
    without such jumps."""
    place = find_column_index(list(columns), output)
    if place is None:
        return []
    y = list(columns.values())[place]
    finite = y[np.isfinite(y)]
    remarks = angle_remarks([finite], "output")
    return [f"{remark}: {ANGLE_REMEDY}" for remark in remarks]


def angle_remarks(pieces: Sequence[Float[np.ndarray, "..."]], name: str) -> list[str]:
    """Remark on an output, given as pieces without gaps, that jumps by a whole turn, like an angle
    that wraps around; none without such jumps."""
    moving = [piece for piece in pieces if len(piece) >= 2]
    if not moving:
        return []
    lowest = min(piece.min() for piece in moving)
    highest = max(piece.max() for piece in moving)
    jumps = np.abs(np.concatenate([np.diff(piece) for piece in moving]))
    for turn in TURNS:
        starts = (0.0, -turn / 2)
        is_within = any(start <= lowest and highest <= start + turn for start in starts)
        count = int((jumps > WHOLE_TURN * turn).sum())
        moves_less = int((jumps > PART_OF_TURN * turn).sum()) == count
        if is_within and moves_less and count >= FEWEST_TURNS:
            return [f"the {name} jumps by a turn of {turn:.4g} in {count} places, {ANGLE}"]
    return []


def output_angle_remarks(
    pieces: Sequence[Float[np.ndarray, "... p"]], channels: Sequence[Channel]
) -> list[str]:
    """Remark on each output of a log that jumps by a whole turn, like an angle that wraps
    around."""
    remarks = []
    for number, channel in enumerate(channels):
        remarks += angle_remarks([y[:, number] for y in pieces], f"output {channel.name}")
    return remarks
