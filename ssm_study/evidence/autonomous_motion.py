"""Findings on an output that oscillates independently of the input, as in a limit cycle.

Where the input decides, a piece of a log is predicted as well from the input since the log's
beginning as from the piece's own estimated state: docs/trust.md, "Logs that cannot bear a
judgement, and logs that can".
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ssm_study.evidence.finding import EvidenceCase, Finding
from ssm_study.models.metrics import simulate_record
from ssm_study.models.warm_start import preceding_log
from ssm_study.signals import Trajectory

BY_INPUT = 0.5  # share of the output's power that must follow from the input
UNPREDICTED = (
    "Neither the input nor where each piece begins predicts the pieces that validate and test: "
    "it moves by itself, or something else moves it there. Excite it more, if it can rest."
)
FORGOTTEN = 0.1  # share that a piece's own state may add to it: noise leaves both equally little


def judge_autonomous_motion(case: EvidenceCase) -> list[Finding]:
    """Findings on a log in which the output moves mostly independently of the input, as in a limit
    cycle."""
    shares = predicted_power_shares(case)
    if shares is None or shares[1] >= BY_INPUT or shares[0] - shares[1] <= FORGOTTEN:
        return []
    if shares[0] <= FORGOTTEN:
        return [Finding(level="cannot judge", sentence=UNPREDICTED)]
    own, by_input = (f"{100 * max(share, 0.0):.0f} %" for share in shares)
    statement = (
        f"Of the output's power {own} follow from where each piece begins, {by_input} from the "
        "input"
    )
    return [
        Finding(
            level="cannot judge",
            sentence=f"{statement}: it moves by itself. Excite it more, if it can rest.",
        )
    ]


def predicted_power_shares(case: EvidenceCase) -> tuple[float, float] | None:
    """Fractions of the output's power that the model predicts: in free runs from an estimated
    initial state, and in a simulation from the beginning of the log. One is estimated in each
    piece, the other continues from the log before the piece: `1 - |y - y_hat|^2 / |y|^2`, about the
    means of each piece, over the validation and test pieces that have another piece of their log
    before them.

    The first is of free runs from the piece's own estimated state, the second of runs from the
    beginning of the log. Means are taken off, for an integrator keeps an offset. None if there is
    no such piece.
    """
    skip = case.data.start_up_samples
    scale = case.data.scale.output_scale

    def output_power(y: Float[np.ndarray, "T p"]) -> float:
        """Power of an output about its mean, in scaled units and without the start-up samples."""
        deviation = (y - y[skip:].mean(axis=0)) / scale
        return float((deviation[skip:] ** 2).sum())

    powers = []
    for piece, own in records_with_free_runs(case):
        past = preceding_log(case.data, piece)
        if past is None:
            continue
        log = Trajectory.concatenate([past, piece])
        from_equilibrium = simulate_record(case.model, log, start_up_samples=0)
        by_input = from_equilibrium[-len(piece) :]
        sides = (piece.y, piece.y - own, piece.y - by_input)
        powers.append([output_power(side) for side in sides])
    if not powers:
        return None
    moved, missed, missed_by_input = np.sum(powers, axis=0)
    return (1 - missed / moved, 1 - missed_by_input / moved) if moved else None


def records_with_free_runs(
    case: EvidenceCase,
) -> Iterator[tuple[Trajectory, Float[np.ndarray, "T p"]]]:
    """Validation and test records, each with the output that the model simulates."""
    yield from zip(case.data.validation, case.validation.simulated, strict=True)
    yield from zip(case.data.test, case.test.simulated, strict=True)
