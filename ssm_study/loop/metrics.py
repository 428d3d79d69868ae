"""Table columns that describe the behaviour of a closed loop in simulation."""

from collections import Counter
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design
from ssm_study.columns import Column
from ssm_study.loop.certified_bound import (
    count_bound_violations,
    estimation_decay_rate,
    relative_bound_excess,
)
from ssm_study.loop.motion import (
    classify_motions,
    measured_contraction_rate,
    overshoots,
    residual_oscillations,
    settling_times_s,
)
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import STAYED, Rollouts

Columns = dict[str, float | int | str | None]
# The bound is that of the model without noise; the plant and its sensor may leave it.
BEYOND = "Plant's estimate with its noise beyond the model's bound without noise"

SETTLING_COLUMNS = (
    Column("loop_on", "string", word="Closed loop on"),
    Column("initial_conditions", "Int64", word="Initial states tried"),
    Column("stable_count", "Int64", "high", "stable", "Initial states settled"),
    Column("stable_fraction", "Float64", "high", "stable", "Initial states settled", "share"),
    Column("unsettled_as", "string", word="What the other starts do"),
    Column("judged_noise_free", "boolean", word="Judged without the noise"),
    Column(
        "settling_time_mean_s", "Float64", "low", "settle s", "Mean settling time", "s", shown=True
    ),
    Column("settling_time_worst_s", "Float64", "low", "worst s", "Worst settling time", "s"),
    Column(
        "settling_time_open_loop_s",
        "Float64",
        "",
        "open s",
        "Mean settling time, uncontrolled",
        "s",
    ),
    Column(
        "faster_than_open_loop",
        "boolean",
        "high",
        "faster",
        "All settle, sooner on average than without control",
    ),
)

REST_AND_RIVAL_COLUMNS = (
    Column(
        "swings_at_rest",
        "Float64",
        "low",
        word="Swing that settled loops keep up without noise",
        unit="settling bands",
    ),
    Column("stable_count_pi", "Int64", word="Initial states settled by a PI from the same model"),
    Column(
        "settling_time_pi_s", "Float64", word="Mean settling time, PI from the same model", unit="s"
    ),
)

EFFORT_AND_ERROR_COLUMNS = (
    Column("overshoot_worst", "Float64", "low", word="Worst overshoot", unit="share of the start"),
    Column(
        "input_peak_v",
        "Float64",
        "low",
        "peak u",
        "Input peak, from equilibrium",
        "unit of the input",
    ),
    Column("control_energy", "Float64", "low", "energy", "Control energy", "squared input, s"),
    Column(
        "integral_squared_error",
        "Float64",
        "low",
        word="Integral of the squared error",
        unit="squared output, s",
    ),
    Column("final_error_worst", "Float64", "low", word="Worst remaining error", unit="output unit"),
    Column("left_bound_count", "Int64", "low", word="Initial states stopped at the bound"),
    Column("left_bound_first_s", "Float64", word="First stop at the bound", unit="s"),
)

BOUND_COLUMNS = (
    Column(
        "noise_gain_measured",
        "Float64",
        "low",
        word="Sensor noise on the output, measured",
        unit="share",
    ),
    Column(
        "empirical_rate", "Float64", "high", word="Measured contraction rate, ρ", unit="1/sample"
    ),
    Column(
        "certified_bound_violations",
        "Int64",
        "low",
        word="Violations of the certified bound on the model",
    ),
    Column(
        "estimate_decay_rate",
        "Float64",
        "high",
        word="Measured decay of the estimate's error",
        unit="1/sample",
    ),
    Column(
        "certified_bound_excess_plant", "Float64", "low", word=BEYOND, unit="share of its start"
    ),
)

COLUMNS = (*SETTLING_COLUMNS, *REST_AND_RIVAL_COLUMNS, *EFFORT_AND_ERROR_COLUMNS, *BOUND_COLUMNS)


def behaviour_columns(loop: LoopRuns) -> Columns:
    """Table columns that describe a closed-loop experiment: settling, overshoot, input and
    remaining error.

    Definitions: docs/closed_loop.md; times in s, inputs in their unit. None where nothing is
    defined, never NaN: `measured_contraction_rate` when several plants are pooled.
    """
    columns = pooled_run_columns([loop])
    columns["empirical_rate"] = measured_contraction_rate(loop.controlled, loop.settling_band)
    columns["noise_gain_measured"] = measured_noise_gain(loop.controlled)
    return columns


def measured_noise_gain(run: Rollouts) -> float | None:
    """Ratio of the output's standard deviation at rest to that of the measurement noise; None
    without noise. `std(y) / std(n)` over the second half of the horizon.

    The share of the sensor's noise n that reaches the true output at rest; `noise_gain_model` of
    the design is the model's gain at the worst frequency.
    """
    half = run.y.shape[1] // 2
    stayed = run.stayed_within_bound
    is_noise_free = np.array_equal(run.y, run.measured)
    if not stayed.any() or is_noise_free:
        return None
    y = run.y[stayed, half:]
    measured = run.measured[stayed, half:]
    noise_signal = measured - y
    cases_and_samples = (0, 1)
    deviation = noise_signal.std(axis=cases_and_samples)
    smallest_float = np.finfo(float).tiny
    noise = np.maximum(deviation, smallest_float)
    variances = y.var(axis=1)
    mean_variance = variances.mean(axis=0)
    gains = np.sqrt(mean_variance) / noise
    return float(gains.max())


def pooled_run_columns(loops: list[LoopRuns]) -> Columns:
    """Table columns computed from all simulations of several closed-loop experiments of the same
    length together."""
    efforts = [loop.controlled.u - loop.input_equilibrium for loop in loops]
    errors = [loop.controlled.y - loop.controlled.reference for loop in loops]
    case_counts = (len(error) for error in errors)
    cases = sum(case_counts)
    step_s = loops[0].controlled.step_s
    per_case = step_s / cases
    columns = settling_columns(loops, cases)
    largest_overshoots = (largest_overshoot(loop) for loop in loops)
    overshoot_worst = max(largest_overshoots)
    input_peaks = [np.abs(effort).max() for effort in efforts]
    peaks = (float(peak) for peak in input_peaks)
    input_peak_v = max(peaks)
    control_energy = sum_of_squares(efforts) * per_case
    integral_squared_error = sum_of_squares(errors) * per_case
    final_errors = (largest_final_error(error) for error in errors)
    final_error_worst = max(final_errors)
    divergence = divergence_columns(loops, step_s)
    return {
        **columns,
        "overshoot_worst": overshoot_worst,
        "input_peak_v": input_peak_v,
        "control_energy": control_energy,
        "integral_squared_error": integral_squared_error,
        "final_error_worst": final_error_worst,
        **divergence,
    }


def settling_columns(loops: list[LoopRuns], case_count: int) -> Columns:
    """Table columns on how many simulations settle and how fast, with control and without."""
    times_s: list[float | None] = []
    alone_s: list[float | None] = []
    motion: Counter[str] = Counter()
    for loop in loops:
        band = loop.settling_band
        run = loop.rollouts_for_settling
        times_s += settling_times_s(run, band)
        alone_s += settling_times_s(loop.uncontrolled, band)
        motion.update(classify_motions(run, band))
    settled_times_s = [time_s for time_s in times_s if time_s is not None]
    kind_counts = sorted(motion.items())
    unsettled = [f"{count} {kind}" for kind, count in kind_counts if kind != "settled"]
    stable_count = len(settled_times_s)
    judged_noise_free = any(loop.noise_free is not None for loop in loops)
    all_settle = stable_count == case_count
    settling_time_worst_s = max(settled_times_s) if all_settle else None
    settling_time_mean_s = mean_without_none(settled_times_s)
    settling_time_open_loop_s = mean_without_none(alone_s)
    faster_than_open_loop = settles_faster_than_open_loop(times_s, alone_s)
    swings_at_rest = largest_residual_oscillation(loops)
    return {
        "initial_conditions": case_count,
        "stable_count": stable_count,
        "stable_fraction": stable_count / case_count,
        "unsettled_as": ", ".join(unsettled) or None,
        "judged_noise_free": judged_noise_free,
        "settling_time_mean_s": settling_time_mean_s,
        "settling_time_worst_s": settling_time_worst_s,
        "settling_time_open_loop_s": settling_time_open_loop_s,
        "faster_than_open_loop": faster_than_open_loop,
        "swings_at_rest": swings_at_rest,
    }


def settles_faster_than_open_loop(
    controlled_times_s: list[float | None], uncontrolled_times_s: list[float | None]
) -> bool:
    """Whether every simulation (case) settles with control, and on average sooner than without.

    A case that never settles without control counts as slower there. A word of success stands only
    where this holds: a controller may be certified, and settle, and help nobody.
    """
    if None in controlled_times_s:
        return False
    if None in uncontrolled_times_s:
        return True
    controlled = mean_without_none(controlled_times_s)
    uncontrolled = mean_without_none(uncontrolled_times_s)
    assert controlled is not None
    assert uncontrolled is not None
    return controlled < uncontrolled


def largest_residual_oscillation(loops: list[LoopRuns]) -> float | None:
    """Largest oscillation of the output that remains after settling, relative to the settling band;
    None if no simulation settles."""
    swings = []
    for loop in loops:
        run = loop.quiet or loop.rollouts_for_settling
        amplitudes = residual_oscillations(run, loop.settling_band)
        swings += [float(swing) / loop.settling_band for swing in amplitudes]
    return max(swings, default=None)


def largest_overshoot(loop: LoopRuns) -> float:
    """Largest overshoot of the controlled plant among several simulations, relative to the initial
    error."""
    per_case = overshoots(loop.controlled, loop.settling_band)
    return float(per_case.max())


def sum_of_squares(signals: list[Float[np.ndarray, "N T c"]]) -> float:
    """Sum of the squared values of several signals."""
    energies = [(signal**2).sum() for signal in signals]
    return sum(float(energy) for energy in energies)


def largest_final_error(errors: Float[np.ndarray, "N T p"]) -> float:
    """Largest mean control error over the last tenth of the horizon, among all simulations and
    outputs."""
    samples = errors.shape[1]
    last = max(samples // 10, 1)
    last_errors = errors[:, -last:]
    mean_errors = last_errors.mean(axis=1)
    error_sizes = np.abs(mean_errors)
    return float(error_sizes.max())


def divergence_columns(loops: list[LoopRuns], step_s: float) -> Columns:
    """Table columns with the number of simulations that were stopped because they diverged, and the
    time of the earliest stop."""
    left: list[int] = []
    for loop in loops:
        at_sample = loop.controlled.left_at_sample
        stopped_at = at_sample[at_sample != STAYED]
        left += stopped_at.tolist()
    left_bound_first_s = min(left) * step_s if left else None
    stopped_count = len(left)
    return {"left_bound_count": stopped_count, "left_bound_first_s": left_bound_first_s}


CERTIFIED = ("certified_bound_violations", "estimate_decay_rate", "certified_bound_excess_plant")


def certified_bound_columns(loop: LoopRuns, design: Design) -> Columns:
    """Table columns that compare the distance from the equilibrium in simulation with its certified
    bound.

    All None without a run on the model; `certified_bound_excess_plant` is None too where plant and
    model follow different references.
    """
    model = loop.on_model
    if model is None:
        return dict.fromkeys(CERTIFIED)
    plant = loop.controlled
    parts = design.controller_and_observer()
    beyond = None
    if np.allclose(plant.reference, model.reference):
        x0 = model.states[:, 0]
        beyond = relative_bound_excess(plant.estimate, x0, *parts)
    certified_bound_violations = count_bound_violations(model.states, model.estimate, *parts)
    estimate_decay_rate = estimation_decay_rate(model.states, model.estimate, *parts)
    return {
        "certified_bound_violations": certified_bound_violations,
        "estimate_decay_rate": estimate_decay_rate,
        "certified_bound_excess_plant": beyond,
    }


def mean_without_none(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are not None; None if there are none."""
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None
