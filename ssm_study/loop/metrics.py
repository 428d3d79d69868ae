"""The numbers one experiment is judged by: the columns of the study's table, each with its unit and
definition."""

from collections import Counter
from collections.abc import Iterable

import numpy as np

from ssm_study.certificates.certificate import Design
from ssm_study.columns import Column
from ssm_study.loop.certified_bound import decay_rate, excess, violations
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import (
    STAYED,
    Rollouts,
    empirical_rate,
    motions,
    overshoots,
    settling_times_s,
)

Columns = dict[str, float | int | str | None]
BEYOND = "Beyond the certified bound on the plant"

COLUMNS = (
    Column("loop_on", "string", word="Closed loop on"),
    Column("initial_conditions", "Int64", word="InitialStates tried"),
    Column("stable_count", "Int64", "high", "stable", "InitialStates settled"),
    Column("stable_fraction", "Float64", "high", "stable", "InitialStates settled", "share"),
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
    Column("overshoot_worst", "Float64", "low", word="Worst overshoot", unit="share of the start"),
    Column("input_peak_v", "Float64", "low", "peak u", "Input peak", "unit of the input"),
    Column("control_energy", "Float64", "low", "energy", "Control energy", "squared input, s"),
    Column(
        "integral_squared_error",
        "Float64",
        "low",
        word="Integral of the squared error",
        unit="squared output, s",
    ),
    Column("final_error_worst", "Float64", "low", word="Worst remaining error", unit="output unit"),
    Column("left_bound_count", "Int64", "low", word="InitialStates stopped at the bound"),
    Column("left_bound_first_s", "Float64", word="First stop at the bound", unit="s"),
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
    Column("certified_bound_violations", "Int64", "low", word="Violations of the certified bound"),
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


def behaviour(loop: LoopRuns) -> Columns:
    """What the controlled plant did, as docs/closed_loop.md defines each column; times in s, inputs
    in their unit.

    None where nothing is defined, never NaN: `empirical_rate` when several plants are pooled.
    """
    rate = empirical_rate(loop.controlled, loop.settling_band)
    return pooled([loop]) | {
        "empirical_rate": rate,
        "noise_gain_measured": noise_gain(loop.controlled),
    }


def noise_gain(run: Rollouts) -> float | None:
    """`std(y) / std(n)` over the second half of the horizon, cases that stayed, the worst output;
    None without noise.

    What the sensor's noise n leaves of the true output at rest; `noise_gain_model` of the design is
    it for the model.
    """
    half = run.y.shape[1] // 2
    if not run.stayed.any() or np.array_equal(run.y, run.measured):
        return None
    y, seen = (signal[run.stayed, half:] for signal in (run.y, run.measured))
    noise = np.maximum((seen - y).std(axis=(0, 1)), np.finfo(float).tiny)
    return float((np.sqrt(y.var(axis=1).mean(axis=0)) / noise).max())


def pooled(loops: list[LoopRuns]) -> Columns:
    """`behaviour` over the cases of several experiments of the same length, as if they were one."""
    judged = [(loop.judged, loop.settling_band) for loop in loops]
    settled = [time_s for run in judged for time_s in settling_times_s(*run) if time_s is not None]
    motion = Counter(kind for run in judged for kind in motions(*run) if kind != "settled")
    alone = [
        time_s
        for loop in loops
        for time_s in settling_times_s(loop.uncontrolled, loop.settling_band)
    ]
    left = [int(k) for loop in loops for k in loop.controlled.left_at_sample if k != STAYED]
    efforts = [loop.controlled.u - loop.input_equilibrium for loop in loops]
    errors = [loop.controlled.y - loop.controlled.reference for loop in loops]
    final = [
        error[:, -max(error.shape[1] // 10, 1) :].mean(axis=1) for error in errors
    ]  # noise averages out
    cases, step_s = sum(map(len, errors)), loops[0].controlled.step_s
    return {
        "initial_conditions": cases,
        "stable_count": len(settled),
        "stable_fraction": len(settled) / cases,
        "unsettled_as": ", ".join(f"{count} {kind}" for kind, count in sorted(motion.items()))
        or None,
        "judged_noise_free": any(loop.noise_free is not None for loop in loops),
        "settling_time_mean_s": mean(settled),
        "settling_time_worst_s": max(settled) if len(settled) == cases else None,
        "settling_time_open_loop_s": mean(alone),
        "overshoot_worst": max(
            float(overshoots(loop.controlled, loop.settling_band).max()) for loop in loops
        ),
        "input_peak_v": max(float(np.abs(effort).max()) for effort in efforts),
        "control_energy": sum(float((effort**2).sum()) for effort in efforts) / cases * step_s,
        "integral_squared_error": sum(float((error**2).sum()) for error in errors) / cases * step_s,
        "final_error_worst": max(float(np.abs(error).max()) for error in final),
        "left_bound_count": len(left),
        "left_bound_first_s": min(left) * step_s if left else None,
    }


def certified(loop: LoopRuns, design: Design) -> Columns:
    """What was certified beside what was measured (docs/closed_loop.md); all None without a run on
    the model.

    `certified_bound_excess_plant` is None too where plant and model follow different references.
    """
    if (model := loop.on_model) is None:
        return dict.fromkeys(
            ("certified_bound_violations", "estimate_decay_rate", "certified_bound_excess_plant")
        )
    plant, parts = loop.controlled, design.parts()
    alike = np.allclose(plant.reference, model.reference)
    return {
        "certified_bound_violations": violations(model.states, model.estimate, *parts),
        "estimate_decay_rate": decay_rate(model.states, model.estimate, *parts),
        "certified_bound_excess_plant": excess(plant.estimate, model.states[:, 0], *parts)
        if alike
        else None,
    }


def mean(values: Iterable[float | None]) -> float | None:
    """Of those that there are; None of none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
