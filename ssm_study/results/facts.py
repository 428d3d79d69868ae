"""The numbers of a record that describe the model and the design; those of the loop are `loop.metrics`."""

from typing import Any

import numpy as np

from ssm_study.bounds.hankel import hankel_singular_values
from ssm_study.bounds.scaffolds import jacobian_ball
from ssm_study.models.identified import SSM
from ssm_study.signals import DataSet, Trajectory, fit_percent, rmse
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback
from ssm_study.synthesis.mismatch import mismatch
from ssm_study.systems import JacobianBall

Facts = dict[str, Any]


def model_facts(model: SSM, identified: SSM, data: DataSet) -> Facts:
    """Fits of the model that is certified, its Hankel singular values, and the slopes of its scaffoldings."""
    hankel = hankel_singular_values(model.linear)
    input_bound, output_bound = jacobian_ball(model.scaffold_in), jacobian_ball(model.scaffold_out)
    norms = jacobian_ball(model.scaffold_in, method="spectral")
    test, start = data.test[0], data.start_up_samples
    return {
        "fit_train_percent": float(np.mean([fit_of(model, record, start) for record in data.training])),
        "fit_validation_percent": fit_of(model, data.validation[0], start),
        "fit_test_percent": fit_of(model, test, start),
        "fit_test_before_reduction_percent": fit_of(identified, test, start),
        "rmse_test": rmse(test.y, model.simulate(test.u), start),
        "state_order": model.order,
        "input_slope_lower": input_bound.lower,
        "input_slope_upper": input_bound.upper,
        "output_slope_lower": output_bound.lower,
        "output_slope_upper": output_bound.upper,
        "bound_method": input_bound.method,
        "input_slope_lower_spectral": norms.lower,
        "input_slope_upper_spectral": norms.upper,
        "hankel_largest": float(hankel[0]),
        "hankel_smallest": float(hankel[-1]),
        "spectral_radius": model.linear.spectral_radius,
    }


def fit_of(model: SSM, record: Trajectory, start_up_samples: int) -> float:
    return fit_percent(record.y, model.simulate(record.u), start_up_samples)


def design_facts(design: Design, model: SSM, balls: tuple[JacobianBall, JacobianBall], data: DataSet) -> Facts:
    """Feasible, certified, how far from the frontier, how large, and how much model error the pair tolerates."""
    feedback, observer = design.state_feedback, design.observer
    facts = part_facts("controller", feedback) | part_facts("observer", observer)
    if isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
        return facts
    predicted = mismatch(model, feedback.k, observer.l, *balls, data.validation)
    return facts | {"mismatch_gain": predicted.gain, "mismatch_margin": predicted.margin}


def part_facts(side: str, part: StateFeedback | Observer | Infeasible) -> Facts:
    feasible = not isinstance(part, Infeasible)
    return {
        f"rate_{side}": part.rate,
        f"{side}_feasible": feasible,
        f"{side}_certified": part.certified,
        f"{side}_rate_limit": part.rate_limit,
        f"{side}_margin": None if isinstance(part, Infeasible) else part.margin,
        f"{side}_gain_norm": None if isinstance(part, Infeasible) else part.gain_norm,
        f"{side}_reason": part.reason if isinstance(part, Infeasible) else None,
    }
