"""Sentences on the plant's dynamics in a log: delay of the response, integrator, closed loop,
noise.

Lags come from least squares on increments: `dy[k]` on `du[k] ... du[k - LAGS]` and two earlier
`dy`; the output responds at a lag whose coefficient is `SURE` standard errors from zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ssm_study.data.log_checks import no_dynamics_reason
from ssm_study.data.splits import rest_segments
from ssm_study.signals import Trajectory

LAGS = 40
SURE = 6.0  # standard errors
OF_THE_LARGEST = 0.05  # share of the largest answer from which on a lag counts
STRIDES = (1, 5, 20)  # samples: a slow answer stands out of the noise of coarser steps only
FOLLOWS = 0.5  # share of the output that the input explains where no single step of it does
FEWEST_LAGS = 5  # of outputs that a controller is taken to read
INPUT_LAGS = 20  # of the input's own past
FORESEEN = 1e-3  # share of the input's power, up to which it is foretold by its own past
FED_BACK = 0.1  # share of the input's changes that earlier outputs explain in a closed loop
MAYBE_FED_BACK = 0.015  # the same from which on a controller may answer within the sample
WINDOWS = (5, 10, 20, 50, 100)  # samples over which an integrator may sum what moves it
MOVED = 0.6  # share of the output's changes that the input of an integrator explains, at least
LONGER = 4  # times the window of an integrator's change, up to which losses are looked for
FORGETS = 1.0  # times over that an output without an integrator loses its level in a log, at least
DRIFTS = 0.3  # share of its level by which one with an integrator may seem to grow
INTEGRATES = 0.15  # by so much more the input explains the output's change than its level
COARSE = 0.1  # distinct outputs, of all samples, below which a sensor is called coarse
SETTLED = 0.1  # share of an output's movement that may be left where it has settled
NOISE_RANGE = 6.0  # standard deviations of noise, from its lowest to its highest value
MEDIAN_OF_BENDS = 1.652  # median magnitude of second differences of white noise of deviation one
STANDS_STILL = 0.01  # of the output's range
NEAR_ZERO = 0.02  # of the output's range
ENOUGH_RESTS = 2  # returns of the input that show whether the output comes back
FEEDTHROUGH = "model.feedthrough=true"
INTEGRATOR = "model.integrating_output=true"

Signal = Float[np.ndarray, "T"]


@dataclass(frozen=True, kw_only=True)
class ExplainedVariance:
    """Fractions of the variances of the output, and of its change over a time window, that the
    input explains. Also the share of its level by which the output decays over that window, and at
    that pace over the log."""

    level: float
    change: float
    lost: float
    lost_in_log: float
    window: int

    @property
    def is_integrator(self) -> bool:
        """Whether the input explains changes of the output better than values of the output, as for
        an integrating plant."""
        changes = self.change > self.level + INTEGRATES
        return changes and self.lost > -DRIFTS and self.lost_in_log < FORGETS


def describe_log_dynamics(
    records: Sequence[Trajectory], *, is_interpolated: bool = False
) -> list[str]:
    """Describe in sentences the plant dynamics in a log: delay, integrator, feedback, noise.

    An output between interpolated samples moves before its input, so such samples cannot show
    feedthrough.
    """
    record = max(records, key=len)
    u = record.u[:, 0]
    y = record.y[:, 0]
    reason = no_dynamics_reason(u, y, 4 * LAGS)
    if reason:
        return [f"{reason}: no dynamics measured"]
    shares = explained_output_variance(u, y)
    sentences = [
        *longest_standstill_sentences(records),
        input_return_sentence(count_returns_to_rest(records)),
    ]
    fed_back = feedback_error_reduction(u, y)
    answer = response_delay_sentence(u, y, shares)
    if FEEDTHROUGH in answer and is_interpolated:
        answer = interpolated_response_sentence()
    is_ambiguous = FEEDTHROUGH in answer and fed_back > MAYBE_FED_BACK
    sentences.append(same_sample_response_sentence() if is_ambiguous else answer)
    if fed_back > FED_BACK:
        sentences.append(
            f"earlier outputs explain {fed_back:.0%} of the input's changes: a closed loop? "
            "name its set point, data.reference"
        )
    if shares.is_integrator:
        sentences.append(
            f"integrator: the input explains {shares.change:.0%} of the output's changes and "
            f"{max(shares.level, 0):.0%} of its level ({INTEGRATOR})"
        )
    sentences.append(sensor_noise_sentence(y))
    return sentences


def same_sample_response_sentence() -> str:
    """Sentence on an output that changes in the same sample as the input, so that cause and effect
    are unclear."""
    return "input and output move within the same sample: which of them answers is not to be seen"


def interpolated_response_sentence() -> str:
    """Sentence on an output that seems to respond within the same sample only because samples were
    interpolated."""
    return "the output answers within a sample or two: samples were interpolated, which blurs it"


def count_returns_to_rest(records: Sequence[Trajectory]) -> int:
    """Number of times that the input returns to its most frequent value and stays there until the
    output has settled."""
    counts: dict[float, int] = {}
    for piece in records:
        for rest in rest_segments(piece):
            level = float(rest.u[0, 0])
            counts[level] = counts.get(level, 0) + has_settled(rest.y[:, 0])
    return max(counts.values(), default=0)


def has_settled(y: Signal) -> bool:
    """Whether the output of a segment has settled, apart from noise."""
    end = y[-(len(y) // 3 + 1) :]
    allowed = max(SETTLED * float(np.ptp(y)), NOISE_RANGE * noise_deviation(y))
    return float(np.ptp(end)) <= allowed


def noise_deviation(y: Signal) -> float:
    """Standard deviation of a signal's measurement noise, estimated from second differences."""
    bends = np.abs(np.diff(y, n=2))
    return float(np.median(bends)) / MEDIAN_OF_BENDS if len(bends) else 0.0


def longest_standstill_sentences(records: Sequence[Trajectory]) -> list[str]:
    """Sentence on the longest interval of a log in which no signal changes; an empty list if there
    is none of note."""
    longest: tuple[int, Trajectory, int] | None = None
    for piece in records:
        start, end = longest_constant_interval(piece)
        if end - start > (longest[0] if longest else LAGS):
            longest = (end - start, piece, start)
    if longest is None:
        return []
    length, piece, start = longest
    u = float(piece.u[start, 0])
    y = float(np.median(piece.y[start : start + length, 0]))
    seconds = length * piece.step_s
    words = f"standstill: input {u:.4g}, output {y:.3g}, for {seconds:.3g} s"
    at_zero = u == 0.0 and abs(y) <= NEAR_ZERO * float(np.ptp(piece.y[:, 0]))
    return [f"{words} (data.equilibrium=zero makes it the goal)" if at_zero else words]


def longest_constant_interval(record: Trajectory) -> tuple[int, int]:
    """Sample range of the longest interval in which input and output are constant apart from
    noise."""
    u = record.u[:, 0]
    y = record.y[:, 0]
    changes = np.flatnonzero(np.diff(u)) + 1
    bounds = [0, *changes.tolist(), len(u)]
    best = (0, 0)
    for start, end in pairwise(bounds):
        is_longer = end - start > best[1] - best[0]
        if is_longer and np.ptp(y[start:end]) <= STANDS_STILL * np.ptp(y):
            best = (start, end)
    return best


def input_return_sentence(returns: int) -> str:
    """Sentence on how often the input returns to its most frequent value and stays until the output
    has settled."""
    if returns >= ENOUGH_RESTS:
        return f"the input rests {returns} times at one value until the output has settled"
    often = "rests once" if returns == 1 else "never rests"
    return (
        f"the input {often} at its last value until the output has settled: two long rests show "
        "where it settles"
    )


def response_delay_sentence(u: Signal, y: Signal, shares: ExplainedVariance) -> str:
    """Sentence on the delay, in samples, between a change of the input and the response of the
    output. For an integrator, the response is a change of the output."""
    rate = np.diff(y)
    answering = rate if shares.is_integrator else y[1:]
    word = "the output's change" if shares.is_integrator else "the output"
    for stride in STRIDES:
        coarse_u = block_means(u[1:], stride)
        coarse_y = answering[stride - 1 :: stride][: len(coarse_u)]
        enough = len(coarse_u) >= 4 * LAGS
        lag = first_response_lag(coarse_u, coarse_y) if enough else None
        if lag is not None:
            if stride == 1:
                return dead_time_sentence(lag, word)
            return slow_response_sentence(lag, stride, word)
    level = largest_explained_variance(u, y)
    if max(level, shares.change) > FOLLOWS:
        by_level = level >= shares.change
        explained = "output" if by_level else f"output's changes over {shares.window} samples"
        return (
            "no single step of the input stands out of the noise, but its level explains "
            f"{max(level, shares.change):.0%} of the {explained}"
        )
    return (
        f"no answer to the input within {LAGS} samples stands out of the noise: are these the "
        "right columns?"
    )


def block_means(values: Signal, length: int) -> Float[np.ndarray, "B"]:
    """Means of a signal over consecutive blocks of equal length."""
    blocks = len(values) // length
    table = values[: blocks * length].reshape(blocks, length)
    return table.mean(axis=1)


def dead_time_sentence(lag: int, word: str) -> str:
    """Sentence that states the dead time between input and output in samples."""
    if lag == 0:
        return f"{word} answers within the same sample ({FEEDTHROUGH})"
    if lag == 1:
        return f"{word} answers in the next sample: no dead time"
    if lag == 2:
        return f"{word} answers after 2 samples: two lags in a row, or a dead time of one"
    return f"dead time: {word} answers after {lag} samples"


def slow_response_sentence(lag: int, stride: int, word: str) -> str:
    """Sentence on a response so slow that the delay can only be determined to within several
    samples."""
    if lag <= 1:
        return f"{word} answers slowly, within {(lag + 1) * stride} samples"
    return (
        f"{word} answers after {lag * stride} to {(lag + 1) * stride} samples: dead time, or slow"
    )


def first_response_lag(u: Signal, y: Signal) -> int | None:
    """Smallest lag, in samples, at which a change of the input has a significant effect on the
    output; None if there is none."""
    spreads = (np.std(np.diff(u)), np.std(np.diff(y)))
    if min(spreads) == 0:
        return None
    x, target = increment_regression_data(u, y)
    gains, _, rank, _ = np.linalg.lstsq(x, target, rcond=1e-10)
    residual = target - x @ gains
    freedom = max(len(target) - int(rank), 1)
    variance = float(residual @ residual) / freedom
    shares = np.diag(np.linalg.pinv(x.T @ x))
    errors = np.sqrt(np.maximum(variance * shares, 1e-300))
    answers = np.abs(gains[: LAGS + 1])
    is_sure = answers > SURE * errors[: LAGS + 1]
    counts = is_sure & (answers > OF_THE_LARGEST * answers.max())
    return int(np.argmax(counts)) if counts.any() else None


def increment_regression_data(
    u: Signal, y: Signal
) -> tuple[Float[np.ndarray, "K R"], Float[np.ndarray, "K"]]:
    """Regressors and target of a linear regression of output increments on past increments of input
    and output.

    Regressors `du[k - 0 ... LAGS], dy[k - 1], dy[k - 2]`, target `dy[k]`; both scaled.
    """
    du = np.diff(u) / np.std(u)
    dy = np.diff(y) / np.std(y)
    columns = [delayed_signal(du, lag, LAGS) for lag in range(LAGS + 1)]
    columns += [delayed_signal(dy, lag, LAGS) for lag in (1, 2)]
    return np.stack(columns, axis=1), dy[LAGS:]


def delayed_signal(values: Signal, lag: int, longest_lag: int) -> Float[np.ndarray, "K"]:
    """Values of a signal delayed by a number of samples, cut so that signals with any delay up to
    the longest have equal length."""
    return values[longest_lag - lag : len(values) - lag]


def feedback_error_reduction(u: Signal, y: Signal) -> float:
    """Fraction by which past outputs reduce the error of predicting the input; a large fraction is
    a sign of feedback from output to input.

    An input that can be predicted from its own past, such as a sweep of sines, needs more past
    samples than the few outputs that a controller reads: otherwise the outputs stand in for earlier
    inputs.
    """
    affordable = len(u) // (4 * FEWEST_LAGS)
    past = max(FEWEST_LAGS, min(INPUT_LAGS, affordable))
    earlier_u = [delayed_signal(u, lag, past) for lag in range(1, past + 1)]
    earlier_y = [delayed_signal(y, lag, past) for lag in range(1, FEWEST_LAGS + 1)]
    constant = np.ones(len(u) - past)
    by_input = np.stack([*earlier_u, constant], axis=1)
    outputs = np.stack(earlier_y, axis=1)
    by_both = np.hstack([by_input, outputs])
    target = u[past:]
    half = len(target) // 2
    powers = []
    for x in (by_input, by_both):
        gains = np.linalg.lstsq(x[:half], target[:half], rcond=1e-9)[0]
        error = target[half:] - x[half:] @ gains
        powers.append(float((error**2).mean()))
    if powers[0] <= FORESEEN * float(target.var()):
        return 0.0  # its own past says all of it
    return 1.0 - powers[1] / powers[0]


def explained_output_variance(u: Signal, y: Signal) -> ExplainedVariance:
    """Fractions of the output's variance that the input explains, over the time window for which
    they are largest.

    The window is the shortest over which the input explains most of the output's changes, or else
    the one whose changes are explained best. Over a longer window an integrating plant has reversed
    its motion (a position must come back), and any other plant has settled. The decay over the log
    is the fastest of this window and somewhat longer ones, because within a dead time nothing has
    decayed yet.
    """
    best = ExplainedVariance(level=0.0, change=0.0, lost=1.0, lost_in_log=np.inf, window=0)
    for window in WINDOWS:
        if len(u) < 8 * window:
            continue
        shares = explained_variance_over_window(u, y, window)
        if shares.change > best.change:
            best = shares
        if shares.change > MOVED:
            return with_fastest_decay(u, y, shares)
    return best


def with_fastest_decay(u: Signal, y: Signal, explained: ExplainedVariance) -> ExplainedVariance:
    """Explained variances with the fastest decay of the output over several longer time windows."""
    longer = [w for w in WINDOWS if explained.window < w <= LONGER * explained.window]
    able = [window for window in longer if len(u) >= 8 * window]
    losses = [explained_variance_over_window(u, y, window).lost_in_log for window in able]
    return replace(explained, lost_in_log=max([explained.lost_in_log, *losses]))


def largest_explained_variance(u: Signal, y: Signal) -> float:
    """Largest fraction of the output's variance that averages of the input over a time window
    explain, for the best of several window lengths."""
    windows = [window for window in WINDOWS if len(u) >= 8 * window]
    levels = [explained_variance_over_window(u, y, window).level for window in windows]
    return max(levels, default=0.0)


def explained_variance_over_window(u: Signal, y: Signal, window: int) -> ExplainedVariance:
    """Fractions of the variances of the output and of its increments that averages of the input
    over a time window explain."""
    weights = np.full(window, 1 / window)
    mean = np.convolve(u, weights, mode="valid")[:-1:window]
    ends = y[window::window][: len(mean)]
    begins = y[:-window:window][: len(ends)]
    mean = mean[: len(ends)]
    deviation = max(float(mean.std()), 1e-300)
    scaled = (mean - mean.mean()) / deviation
    powers = [scaled**power for power in range(4)]
    x = np.stack(powers, axis=1)
    with_level = np.hstack([x, begins[:, None]])
    gains = np.linalg.lstsq(with_level, ends - begins, rcond=1e-9)[0]
    lost = float(-gains[-1])
    return ExplainedVariance(
        level=coefficient_of_determination(x, ends),
        change=coefficient_of_determination(x, ends - begins),
        lost=lost,
        lost_in_log=lost * len(y) / window,
        window=window,
    )


def coefficient_of_determination(
    regressors: Float[np.ndarray, "K d"], target: Float[np.ndarray, "K"]
) -> float:
    """Coefficient of determination (R squared) of a least-squares fit; 0 for a constant target."""
    if np.ptp(target) == 0:
        return 0.0
    gains = np.linalg.lstsq(regressors, target, rcond=1e-9)[0]
    residual = target - regressors @ gains
    variance = max(float(target.var()), 1e-300)
    return 1.0 - float(residual.var() / variance)


def sensor_noise_sentence(y: Signal) -> str:
    """Sentence on the resolution and the noise of the output sensor. The noise is estimated from
    second differences."""
    steps = np.abs(np.diff(y))
    moving = steps[steps > 0]
    resolution = float(moving.min()) if len(moving) else 0.0
    is_coarse = len(np.unique(y)) < COARSE * len(y)
    noise = noise_deviation(y)
    if noise < 0.5 * resolution:
        coarse = "a coarse sensor: " if is_coarse else ""
        return f"{coarse}no noise beyond the sensor's steps of {resolution:.3g}"
    coarse = f"; a coarse sensor: steps of {resolution:.3g}" if is_coarse else ""
    return f"noise at most {noise:.2g}, {noise / np.ptp(y):.2%} of the range{coarse}"
