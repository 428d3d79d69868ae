"""The numbers one experiment is judged by: the columns of the study's table, each with its unit and definition."""

import numpy as np
from jaxtyping import Float

from ssm_study.loop.certified_bound import decay_rate, excess, violations
from ssm_study.loop.controller import parts
from ssm_study.loop.regulation import ClosedLoop
from ssm_study.loop.rollout import Rollouts
from ssm_study.loop.settling import empirical_rate, overshoots, settling_times_s
from ssm_study.synthesis.certificate import Design, Observer, StateFeedback

Columns = dict[str, float | int | None]


def behaviour(loop: ClosedLoop) -> Columns:
    """What the controlled plant did. Times in s, inputs in their unit; None where nothing is defined, never NaN.

    `stable_count`: cases whose true output enters and stays in the band to the end of the horizon.
    `settling_time_mean_s`: over the cases that settle. `settling_time_worst_s`: None unless all settle.
    `settling_time_open_loop_s`: mean of the plant left alone, over its cases that settle.
    `overshoot_worst`: as a share of the initial distance. `input_peak_v`: largest `|u - u_eq|`.
    `control_energy`: mean over cases of `sum |u - u_eq|^2 step_s`. `integral_squared_error`: likewise of `y - r`.
    `final_error_worst`: largest `|mean of y - r|` over the last tenth of the horizon (noise averages out).
    `empirical_rate`: see `settling.empirical_rate`; None when several plants are pooled.
    `left_bound_count`, `left_bound_first_s`: cases stopped at the bound, and when the first was.
    """
    return pooled([loop]) | {"empirical_rate": empirical_rate(loop.controlled, loop.settling_band)}


def pooled(loops: list[ClosedLoop]) -> Columns:
    """`behaviour` over the cases of several experiments of the same length, as if they were one."""
    settled = [t for loop in loops for t in settling_times_s(loop.controlled, loop.settling_band) if t is not None]
    alone = [t for loop in loops for t in settling_times_s(loop.uncontrolled, loop.settling_band) if t is not None]
    left = [t for loop in loops for t in loop.controlled.left_at_s if t is not None]
    cases = sum(len(loop.controlled.y) for loop in loops)
    efforts = [loop.controlled.u - loop.input_equilibrium for loop in loops]
    errors = [loop.controlled.y - loop.controlled.reference for loop in loops]
    step_s = loops[0].controlled.step_s
    return {
        "initial_conditions": cases,
        "stable_count": len(settled),
        "stable_fraction": len(settled) / cases,
        "settling_time_mean_s": _mean(settled),
        "settling_time_worst_s": max(settled) if len(settled) == cases else None,
        "settling_time_open_loop_s": _mean(alone),
        "overshoot_worst": max(float(overshoots(loop.controlled, loop.settling_band).max()) for loop in loops),
        "input_peak_v": max(float(np.abs(effort).max()) for effort in efforts),
        "control_energy": sum(float((effort**2).sum()) for effort in efforts) / cases * step_s,
        "integral_squared_error": sum(float((error**2).sum()) for error in errors) / cases * step_s,
        "final_error_worst": max(_final_error(error) for error in errors),
        "left_bound_count": len(left),
        "left_bound_first_s": min(left) if left else None,
    }


def _final_error(error: Float[np.ndarray, "N T p"]) -> float:
    return float(np.abs(error[:, -max(error.shape[1] // 10, 1) :].mean(axis=1)).max())


def certified(loop: ClosedLoop, design: Design) -> Columns:
    """`bound_columns` of the experiment; all None without a run on the model."""
    return bound_columns(loop.controlled, loop.on_model, *parts(design))


def bound_columns(
    controlled: Rollouts, on_model: Rollouts | None, feedback: StateFeedback, observer: Observer
) -> Columns:
    """What was certified beside what was measured.

    `certified_bound_violations`: samples on the noise-free model whose distance exceeds the certified bound.
    `estimate_decay_rate`: how fast the estimate finds the noise-free model's state, see `decay_rate`.
    `certified_bound_excess_plant`: how far the estimate on the plant leaves what is certified on the model from the
    same initial outputs, see `excess`; None where plant and model follow different references.
    """
    if on_model is None:
        names = ("certified_bound_violations", "estimate_decay_rate", "certified_bound_excess_plant")
        return dict.fromkeys(names)
    states, estimate = on_model.states, on_model.estimate
    alike = np.allclose(controlled.reference, on_model.reference)
    return {
        "certified_bound_violations": violations(states, estimate, feedback, observer),
        "estimate_decay_rate": decay_rate(states, estimate, feedback, observer),
        "certified_bound_excess_plant": excess(controlled.estimate, states[:, 0], feedback, observer)
        if alike
        else None,
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
