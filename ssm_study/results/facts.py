"""The numbers of a record that describe data, model and design; those of the loop are `loop.metrics`."""

from typing import Any

from ssm_study.bounds.hankel import hankel_singular_values
from ssm_study.bounds.local import local_controllability, local_observability
from ssm_study.bounds.scaffolds import certified_balls, jacobian_ball
from ssm_study.data.coverage import input_coverage, persistency_order, warn_if_two_level
from ssm_study.data.scores import benchmark_rmse
from ssm_study.models.free_run import free_run
from ssm_study.models.identified import SSM, Simulator
from ssm_study.signals import DataSet, Trajectory, rmse
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback
from ssm_study.synthesis.mismatch import mismatch, predict
from ssm_study.synthesis.paper_lmis import paper_lmis
from ssm_study.systems import JacobianBall
from ssm_study.training.identification import mean_fit

Facts = dict[str, Any]


def data_facts(data: DataSet) -> Facts:
    """Where the records come from and how much of the input's range they visit."""
    return {
        "data_source": data.metadata.get("source"),
        "input_coverage": input_coverage(data),
        "excitation_order": min(persistency_order(record.u) for record in data.training),
        "excitation_warning": warn_if_two_level(data),
    }


def model_facts(model: SSM, identified: SSM, data: DataSet) -> Facts:
    """Fits of the model that is certified, its linear part and the slopes of its scaffoldings."""
    return {
        **fit_facts(model, data),
        "fit_test_before_reduction_percent": mean_fit(identified, data.test, data),
        **linear_facts(model),
        **slope_facts(model),
        **local_facts(model),
    }


def fit_facts(model: Simulator, data: DataSet) -> Facts:
    """Free-run fits and test errors of any model; on a benchmark also its score, in the unit it is published in."""
    free_runs = tuple(free_run(model, record, data.start_up_samples) for record in data.test)
    scores = benchmark_rmse(data, free_runs) if "benchmark" in data.metadata else ()
    return {
        "fit_train_percent": mean_fit(model, data.training, data),
        "fit_validation_percent": mean_fit(model, data.validation, data),
        "fit_test_percent": mean_fit(model, data.test, data),
        "rmse_test": rmse_over(model, data.test, data.start_up_samples),
        "benchmark": data.metadata.get("benchmark"),
    } | {f"score_test_{i + 1}": score for i, score in enumerate(scores)}


def linear_facts(model: SSM) -> Facts:
    """States, extreme Hankel singular values and spectral radius of the linear part."""
    hankel = hankel_singular_values(model.linear)
    return {
        "states": model.order,
        "hankel_largest": float(hankel[0]),
        "hankel_smallest": float(hankel[-1]),
        "spectral_radius": model.linear.spectral_radius,
    }


def rmse_over(model: Simulator, records: tuple[Trajectory, ...], start_up_samples: int) -> float:
    """Root mean square over all scored samples of all records, in the unit of the output."""
    squares = [
        (len(r) - start_up_samples, rmse(r.y, free_run(model, r, start_up_samples), start_up_samples) ** 2)
        for r in records
    ]
    return float((sum(n * s for n, s in squares) / sum(n for n, _ in squares)) ** 0.5)


def local_facts(model: SSM) -> Facts:
    """Local controllability and observability along any trajectory, with the paper's bounds on the Gramians."""
    balls = certified_balls(model)
    facts: Facts = {}
    for name, local in (
        ("controllability", local_controllability(model.linear, balls[0])),
        ("observability", local_observability(model.linear, balls[1])),
    ):
        facts |= {f"local_{name}": local.holds, f"{name}_gramian_lower": local.lower}
        facts |= {f"{name}_gramian_upper": local.upper}
    return facts


def slope_facts(model: SSM) -> Facts:
    """The certified slope intervals, and for `S_u` the paper's figure from spectral norms (unsound below)."""
    input_bound, output_bound = jacobian_ball(model.scaffold_in), jacobian_ball(model.scaffold_out)
    norms = jacobian_ball(model.scaffold_in, method="spectral")
    return {
        "input_slope_lower": input_bound.lower,
        "input_slope_upper": input_bound.upper,
        "output_slope_lower": output_bound.lower,
        "output_slope_upper": output_bound.upper,
        "bound_method": input_bound.method,
        "input_slope_lower_spectral": norms.lower,
        "input_slope_upper_spectral": norms.upper,
    }


def design_facts(
    design: Design,
    model: SSM,
    balls: tuple[JacobianBall, JacobianBall],
    validation: tuple[Trajectory, ...],
    start_up_samples: int,
) -> Facts:
    """Feasible, certified, how far from the frontier, how large, and what is predicted of the pair on the plant."""
    feedback, observer = design.state_feedback, design.observer
    facts = part_facts("controller", feedback) | part_facts("observer", observer)
    if isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
        reasons = (part.reason for part in (feedback, observer) if isinstance(part, Infeasible))
        return facts | {"infeasible_reason": "; ".join(reasons)}
    missed = [(side, p) for side, p in (("controller", feedback), ("observer", observer)) if not p.certified]
    if missed:
        facts["uncertified_reason"] = "; ".join(f"{side}: {part.solver_status}" for side, part in missed)
    shown = mismatch(model, validation, start_up_samples)
    predicted = predict(model, feedback.k, observer.l, *balls, shown)
    verdict = {"predicted_stable": predicted.keeps_the_plant()}
    return facts | {"mismatch_gain": shown.gain} | predicted.columns() | verdict


def opinion_facts(design: Design, model: SSM, balls: tuple[JacobianBall, JacobianBall]) -> Facts:
    """What the paper's two LMIs, solved by Clarabel at the same rates, have to say: information, not the verdict."""
    feedback, observer = design.state_feedback, design.observer
    if isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
        return {}
    rates = feedback.rate, observer.rate
    facts: Facts = {}
    for side, opinion in zip(("controller", "observer"), paper_lmis(model.linear, *balls, *rates), strict=True):
        facts |= {f"lmi_{side}_status": opinion.status, f"lmi_{side}_certified": opinion.certified}
    return facts


def part_facts(side: str, part: StateFeedback | Observer | Infeasible) -> Facts:
    """The columns of one side of the design; null where there is no certificate."""
    facts = {
        f"rate_{side}": part.rate,
        f"{side}_feasible": not isinstance(part, Infeasible),
        f"{side}_certified": part.certified,
        f"{side}_rate_limit": part.rate_limit,
    }
    if isinstance(part, Infeasible):
        return facts | {f"{side}_reason": part.reason}
    return facts | {f"{side}_margin": part.margin, f"{side}_gain_norm": part.gain_norm}
