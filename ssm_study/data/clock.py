"""Assignment of evenly spaced times to the rows of a log.

A clock that is even to within a jitter gives the mean period. One with holes gives the period
between them, and the log is cut there: nothing is invented. One whose times scatter around an even
clock without drift was written late or rounded: its rows are numbered. One that wanders is
interpolated onto its median period, inputs that hold levels held; how much was interpolated is
stated.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from ssm_study.data.rounded_times import estimate_period_s
from ssm_study.data.scattered_times import SCATTERS, ScatteredClock, find_scattered_clock
from ssm_study.refusal import BadRequest, require, require_at_least

ClockTimes = Float[np.ndarray, "T"]
RowValues = Float[np.ndarray, "T c"]
Instants = Float[np.ndarray, "K"]

# Relative difference allowed between the claimed sampling time and the one that the times show.
AGREEMENT = 1e-3
HOLE = 1.5  # periods from one row to the next from which on a row is missing
WANDERS = 0.5  # spread of the periods, of the median, beyond which rows are no samples of a clock
FEW_REPEATS = 0.01  # share of rows with the time of the one before, up to which each is named
INTERPOLATED = "of the samples interpolated"
HELD = 0.5  # share of samples at which a held input does not change


@dataclass(frozen=True, kw_only=True)
class EvenlySpacedRows:
    """Rows of a log at evenly spaced times, cut into pieces without gaps. Each piece starts at a
    whole number of samples.

    `remarks` state holes, missing values and interpolation, in words.
    """

    values: list[Float[np.ndarray, "_ c"]]
    starts: list[int]
    step_s: float
    remarks: list[str]


def count_log_samples(pieces: EvenlySpacedRows) -> int:
    """Number of sampling instants from the beginning of a log to its end, gaps included."""
    last_piece = pieces.values[-1]
    return pieces.starts[-1] + len(last_piece)


def period_and_jitter(time_s: ClockTimes) -> tuple[float, ClockTimes]:
    """Mean sampling period of recorded times, and the deviation of each time from an even clock, in
    periods."""
    span_s = time_s[-1] - time_s[0]
    samples = len(time_s)
    periods = samples - 1
    mean_s = float(span_s / periods)
    even = time_s[0] + mean_s * np.arange(samples)
    deviation_s = np.abs(time_s - even)
    return mean_s, deviation_s / mean_s


def largest_jitter(time_s: ClockTimes) -> float:
    """Largest deviation of recorded times from even spacing, in sampling periods."""
    _, late = period_and_jitter(time_s)
    return float(late.max())


def refuse_decreasing_times(time_s: ClockTimes, source: str) -> None:
    """Raise `BadRequest` for recorded times that decrease, or repeat because of rounding."""
    steps = np.diff(time_s)
    if (steps < 0).any():
        first_backward = np.argmax(steps < 0)
        k = int(first_backward) + 1
        problem = f"sample {k} is not later than the one before"
        raise BadRequest(f"{source} (time)", time_s[k], problem, "sort the record")
    if (steps == 0).any():
        first_repeated = np.argmax(steps == 0)
        k = int(first_repeated) + 1
        first_s = median_period_s(time_s)
        problem = f"sample {k} has the time of the one before: the times were rounded"
        remedy = f"use data.step_s (the first rows show about {first_s:.4g} s)"
        raise BadRequest(f"{source} (time)", time_s[k], problem, remedy)


def refuse_repeated_row(time_s: ClockTimes, values: RowValues, source: str) -> None:
    """Raise `BadRequest` for a row of a log that equals the row before it, if equal rows are rare
    in the log."""
    is_still = np.diff(time_s) == 0
    if not is_still.any() or is_still.mean() > FEW_REPEATS:
        return
    first_still = np.argmax(is_still)
    row = int(first_still) + 1
    before = values[row - 1]
    if np.array_equal(values[row], before, equal_nan=True):
        problem = f"row {row} of the file repeats the one before, time and all"
        remedy = "remove the repeated rows"
        raise BadRequest(f"{source} (time)", time_s[row], problem, remedy)


def median_period_s(time_s: ClockTimes) -> float:
    """Typical sampling period of recorded times: the median of the first hundred positive time
    differences."""
    steps = np.diff(time_s)
    positive_steps = steps[steps > 0]
    median_s = np.median(positive_steps[:100])
    return float(median_s)


def resample_to_even_clock(
    time_s: ClockTimes,
    values: RowValues,
    inputs: int,
    source: str,
    *,
    step_s: float | None,
    tolerance: float,
    resample: bool,
) -> EvenlySpacedRows:
    """Resample a log to evenly spaced times, and cut the log at gaps and missing values.

    `step_s`, where it is given, must agree with the times within 0.1 %. The first `inputs` columns
    are inputs. Raises `BadRequest` for times that run backwards, repeat, or are no samples of a
    clock, and for a log of which nothing is left.
    """
    has_time = np.isfinite(time_s)
    time_s = time_s[has_time]
    values = values[has_time]
    require_at_least(3, f"{source} (samples with a time)", len(time_s), "use a longer record")
    is_still = np.diff(time_s) == 0
    if step_s is not None and is_still.any():
        return apply_stated_period(time_s, values, step_s, source)
    if step_s is None and not resample:
        rounded = recover_rounded_clock(time_s, values, tolerance)
        if rounded is not None:
            return rounded
    refuse_repeated_row(time_s, values, source)
    refuse_decreasing_times(time_s, source)
    mean_s, late = period_and_jitter(time_s)
    if late.max() <= tolerance and not resample:
        require_equal_period(step_s, mean_s, source)
        period_s = mean_s if step_s is None else step_s
        rows = EvenlySpacedRows(values=[values], starts=[0], step_s=period_s, remarks=[])
        return cut_pieces_at_missing_values(rows)
    return cut_log_at_gaps(time_s, values, inputs, source, step_s, tolerance, resample)


def recover_rounded_clock(
    time_s: ClockTimes, values: RowValues, tolerance: float
) -> EvenlySpacedRows | None:
    """Recover evenly spaced times from recorded times that were rounded to few digits; None if no
    even spacing explains them. None if no such clock explains the times, or if the times are even
    already."""
    steps = np.diff(time_s)
    is_forwards = (steps >= 0).all()
    forwards = bool(is_forwards) and time_s[-1] > time_s[0]
    if not forwards:
        return None
    is_even = steps.all() and largest_jitter(time_s) <= tolerance
    if is_even:
        return None
    period = estimate_period_s(time_s)
    if period is None:
        return None
    period_s, error = period
    remark = (
        f"times rounded to {steps.max():.3g} s at their coarsest; an even clock of {period_s:g} s "
        f"explains every row (to {error:.2g} of it; data.step_s states it exactly)"
    )
    rows = EvenlySpacedRows(values=[values], starts=[0], step_s=period_s, remarks=[remark])
    return cut_pieces_at_missing_values(rows)


def apply_stated_period(
    time_s: ClockTimes, values: RowValues, step_s: float, source: str
) -> EvenlySpacedRows:
    """Replace rounded time stamps by evenly spaced ones with the stated sampling period. Raises
    `BadRequest` where the time stamps contradict the period."""
    steps_s = np.diff(time_s)
    moves = np.append(True, steps_s != 0)
    refuse_decreasing_times(time_s[moves], source)
    last_s = time_s[-1]
    span_s = float(last_s - time_s[0])
    coarsest_s = float(np.diff(time_s).max())
    expected_s = step_s * (len(time_s) - 1)
    allowed_s = AGREEMENT * span_s + 2.0 * coarsest_s
    agrees = abs(span_s - expected_s) <= allowed_s
    period_s = span_s / (len(time_s) - 1)
    problem = f"the times of {source}, which were rounded, show {period_s:.4g} s"
    remedy = "correct one of them (units?)"
    require(agrees, "data.step_s", step_s, problem, remedy)
    remark = f"times rounded to {coarsest_s:.3g} s at their end, data.step_s taken"
    rows = EvenlySpacedRows(values=[values], starts=[0], step_s=step_s, remarks=[remark])
    return cut_pieces_at_missing_values(rows)


def require_equal_period(step_s: float | None, period_s: float, source: str) -> None:
    """Raise `BadRequest` for a stated sampling period that differs from the period of the recorded
    times."""
    agrees = step_s is None or abs(step_s - period_s) <= AGREEMENT * period_s
    remedy = "correct one of them (units?), or leave step_s null"
    problem = f"the times of {source} show {period_s:.6g} s"
    require(agrees, "data.step_s", step_s, problem, remedy)


def cut_log_at_gaps(
    time_s: ClockTimes,
    values: RowValues,
    inputs: int,
    source: str,
    step_s: float | None,
    tolerance: float,
    resample: bool,
) -> EvenlySpacedRows:
    """Cut a log into pieces where its times have gaps, and interpolate where the times drift from
    an even spacing. Values are interpolated where the clock wanders."""
    steps = np.diff(time_s)
    median_s = float(np.median(steps))
    holes = np.flatnonzero(steps > HOLE * median_s)
    bounds = [0, *(holes + 1).tolist(), len(time_s)]
    stretches = [(a, b) for a, b in pairwise(bounds) if b - a > 2]
    remarks = gap_remarks(steps, holes, median_s)
    late = [largest_jitter(time_s[a:b]) for a, b in stretches]
    if stretches and not resample and max(late) <= tolerance:
        stretch_spans_s = (time_s[b - 1] - time_s[a] for a, b in stretches)
        elapsed_s = sum(stretch_spans_s)
        stretch_periods = (b - a - 1 for a, b in stretches)
        periods = sum(stretch_periods)
        period_s = float(elapsed_s / periods)
        require_equal_period(step_s, period_s, source)
        period_s = period_s if step_s is None else step_s
        since_s = time_s - time_s[0]
        starts = [round(since_s[a] / period_s) for a, _ in stretches]
        cut = [values[a:b] for a, b in stretches]
        rows = EvenlySpacedRows(values=cut, starts=starts, step_s=period_s, remarks=remarks)
        return cut_pieces_at_missing_values(rows)
    clock = None if resample else find_scattered_clock(time_s, stretches)
    if clock is not None:
        require_equal_period(step_s, clock.period_s, source)
        return number_scattered_rows(time_s, values, stretches, clock, step_s, remarks)
    problem = "no stretch without a hole is left"
    remedy = "record for longer, without interruptions"
    require(stretches, f"{source} (time)", "holes", problem, remedy)
    refuse_uneven_times(steps, median_s, source, resample)
    if not resample:
        require_equal_period(step_s, median_s, source)
    period_s = median_s if step_s is None else step_s
    return interpolate_pieces(time_s, values, inputs, stretches, period_s, remarks)


def number_scattered_rows(
    time_s: ClockTimes,
    values: RowValues,
    stretches: list[tuple[int, int]],
    clock: ScatteredClock,
    step_s: float | None,
    remarks: list[str],
) -> EvenlySpacedRows:
    """Assign consecutive sample numbers to the rows of a log whose times scatter around evenly
    spaced ones."""
    period_s = clock.period_s if step_s is None else step_s
    since_s = time_s - time_s[0]
    starts = [round(since_s[a] / period_s) for a, _ in stretches]
    remark = (
        f"times scatter by up to {clock.largest:.0%} of a step around an even clock, without "
        "drift: rows numbered, nothing interpolated (data.jitter_tolerance)"
    )
    cut = [values[a:b] for a, b in stretches]
    all_remarks = [*remarks, remark]
    rows = EvenlySpacedRows(values=cut, starts=starts, step_s=period_s, remarks=all_remarks)
    return cut_pieces_at_missing_values(rows)


def gap_remarks(steps: ClockTimes, gaps: Int[np.ndarray, "H"], period_s: float) -> list[str]:
    """Remark that states how many gaps the times of a log have, and their total duration."""
    if not len(gaps):
        return []
    hole_s = steps[gaps].sum()
    regular_s = len(gaps) * period_s
    missing_s = float(hole_s) - regular_s
    word = "hole" if len(gaps) == 1 else "holes"
    length = f"{missing_s:.0f}" if missing_s >= 100 else f"{missing_s:.3g}"
    return [f"cut at {len(gaps)} {word} of {length} s in all"]


def refuse_uneven_times(steps: ClockTimes, median_s: float, source: str, resample: bool) -> None:
    """Raise `BadRequest` for unevenly spaced times, unless resampling is requested."""
    percentiles = [5, 95]
    low, high = np.percentile(steps, percentiles)
    spread = float(high - low) / median_s
    problem = f"the periods are uneven, by {spread:.0%} of their median, {median_s:.4g} s"
    remedy = (
        "log at even times; or set data.resample=true to interpolate onto a uniform clock, "
        "data.step_s if the median is not its period"
    )
    is_even_enough = resample or spread <= WANDERS
    require(is_even_enough, f"{source} (time)", median_s, problem, remedy)


def interpolate_pieces(
    time_s: ClockTimes,
    values: RowValues,
    inputs: int,
    stretches: list[tuple[int, int]],
    period_s: float,
    remarks: list[str],
) -> EvenlySpacedRows:
    """Resample each gap-free piece of a log at evenly spaced times; held inputs stay piecewise
    constant."""
    cut: list[np.ndarray] = []
    starts: list[int] = []
    between = 0
    samples = 0
    for a, b in stretches:
        times = time_s[a:b]
        # Half a rounding error more than the last period: a whole number gives all its samples.
        span_s = times[-1] - times[0]
        count = int(span_s / period_s + 1e-9) + 1
        elapsed_s = period_s * np.arange(count)
        clock = times[0] + elapsed_s
        columns = []
        columns_of_piece = values[a:b]
        for j, column in enumerate(columns_of_piece.T):
            resampled = interpolate_column(clock, times, column, j < inputs)
            columns.append(resampled)
        nearest = times[nearest_row_indices(clock, times)]
        distance_s = np.abs(clock - nearest)
        is_between = distance_s > 1e-3 * period_s
        between += int(is_between.sum())
        samples += count
        resampled_piece = np.stack(columns, axis=1)
        cut.append(resampled_piece)
        since_s = times[0] - time_s[0]
        starts.append(round(since_s / period_s))
    remark = f"uneven clock: {between / samples:.0%} {INTERPOLATED}"
    jitters = (largest_jitter(time_s[a:b]) for a, b in stretches)
    late = max(jitters)
    if late < SCATTERS:
        remark += f"; data.jitter_tolerance={late + 0.01:.2f} numbers the rows instead"
    remarks = [*remarks, remark]
    rows = EvenlySpacedRows(values=cut, starts=starts, step_s=period_s, remarks=remarks)
    return cut_pieces_at_missing_values(rows)


def nearest_row_indices(clock: Instants, times: ClockTimes) -> Int[np.ndarray, "K"]:
    """Index of the recorded row nearest in time to each instant of an even clock."""
    places = np.searchsorted(times, clock)
    after = np.clip(places, 1, len(times) - 1)
    before = after - 1
    since_before_s = clock - times[before]
    until_after_s = times[after] - clock
    is_before = since_before_s < until_after_s
    return np.where(is_before, before, after)


def interpolate_column(
    clock: Instants, times: ClockTimes, column: ClockTimes, is_input: bool
) -> Instants:
    """Interpolate one column of a log at new times; a held input stays piecewise constant."""
    is_unchanged = np.diff(column) == 0
    if is_input and is_unchanged.mean() > HELD:
        later = clock * (1 + 1e-12) + 1e-12
        next_row = np.searchsorted(times, later, side="right")
        last = next_row - 1
        row_count = len(column)
        return column[np.clip(last, 0, row_count - 1)]
    return np.interp(clock, times, column)


def cut_pieces_at_missing_values(pieces: EvenlySpacedRows) -> EvenlySpacedRows:
    """Cut the pieces of a log where a value is missing, and leave out pieces of one or two rows."""
    cut: list[np.ndarray] = []
    starts: list[int] = []
    missing = 0
    gaps = 0
    for values, start in zip(pieces.values, pieces.starts, strict=True):
        is_finite = np.isfinite(values)
        whole = is_finite.all(axis=1)
        is_whole = whole.astype(int)
        changes = np.diff(is_whole, prepend=0, append=0)
        edges = np.flatnonzero(changes)
        bounds = edges.reshape(-1, 2).tolist()
        stretches = [(a, b) for a, b in bounds]
        if stretches:
            inner = stretches[-1][1] - stretches[0][0]
            stretch_lengths = (b - a for a, b in stretches)
            missing += inner - sum(stretch_lengths)
        gaps += max(len(stretches) - 1, 0)
        for a, b in stretches:
            if b - a > 2 or len(stretches) == 1:
                cut.append(values[a:b])
                starts.append(start + a)
    remarks = list(pieces.remarks)
    if missing:
        rows = "row" if missing == 1 else "rows"
        places = "place" if gaps == 1 else "places"
        remarks.append(f"cut at {missing} {rows} with missing values in {gaps} {places}")
    return EvenlySpacedRows(values=cut, starts=starts, step_s=pieces.step_s, remarks=remarks)
