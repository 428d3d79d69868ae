"""The numbers one experiment is judged by: the columns of the study's table, each with its unit and definition."""

import numpy as np

from ssm_study.loop.certified_bound import violations
from ssm_study.loop.controller import parts
from ssm_study.loop.regulation import ClosedLoop
from ssm_study.loop.settling import empirical_rate, overshoots, settling_times_s
from ssm_study.synthesis.certificate import Design

Columns = dict[str, float | int | None]


def behaviour(loop: ClosedLoop) -> Columns:
    """What the controlled plant did. Times in s, inputs in their unit; None where nothing is defined, never NaN.

    `stable_count`: cases whose true output enters and stays in the band to the end of the horizon.
    `settling_time_mean_s`: over the cases that settle. `settling_time_worst_s`: None unless all settle.
    `settling_time_open_loop_s`: mean of the plant left alone, over its cases that settle.
    `overshoot_worst`: as a share of the initial distance. `input_peak_v`: largest `|u - u_eq|`.
    `control_energy`: mean over cases of `sum |u - u_eq|^2 step_s`. `integral_squared_error`: likewise of `y - r`.
    `left_bound_count`, `left_bound_first_s`: cases stopped at the bound, and when the first was.
    """
    run, band = loop.controlled, loop.settling_band
    settled = [t for t in settling_times_s(run, band) if t is not None]
    alone = [t for t in settling_times_s(loop.uncontrolled, band) if t is not None]
    everyone = len(settled) == len(run.y)
    effort, error = run.u - loop.input_equilibrium, run.y - run.reference
    left = [t for t in run.left_at_s if t is not None]
    return {
        "initial_conditions": len(run.y),
        "stable_count": len(settled),
        "stable_fraction": len(settled) / len(run.y),
        "settling_time_mean_s": _mean(settled),
        "settling_time_worst_s": max(settled) if everyone else None,
        "settling_time_open_loop_s": _mean(alone),
        "overshoot_worst": float(overshoots(run, band).max()),
        "input_peak_v": float(np.abs(effort).max()),
        "control_energy": float((effort**2).sum(axis=(1, 2)).mean() * run.step_s),
        "integral_squared_error": float((error**2).sum(axis=(1, 2)).mean() * run.step_s),
        "empirical_rate": empirical_rate(run, band),
        "left_bound_count": len(left),
        "left_bound_first_s": min(left) if left else None,
    }


def certified(loop: ClosedLoop, design: Design) -> Columns:
    """`certified_bound_violations`: samples on the noise-free model whose distance exceeds the certified bound."""
    run = loop.on_model
    if run is None:
        return {"certified_bound_violations": None}
    count = violations(run.states, run.estimate, *parts(design))
    return {"certified_bound_violations": count}


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
