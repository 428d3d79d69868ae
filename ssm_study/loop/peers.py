"""The controllers compared on one plant: left alone, textbook, the paper's, ours."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.loop.controller import Controller, ObserverFeedback, Uncontrolled
from ssm_study.loop.lqg import LQGWeights, lqg
from ssm_study.loop.mpc import mpc
from ssm_study.loop.pi import tyreus_luyben
from ssm_study.loop.table import Identified
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.certificate import Design, Infeasible
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.synthesis.mismatch import Prediction, mismatch, predict
from ssm_study.synthesis.riccati import RiccatiSynthesis

INTEGRAL_WEIGHTS = (1e-4, 1e-3, 1e-2)
NAMES = ("uncontrolled", "pi", "lqg", "mpc", "paper_lmi", "guaranteed_cost", "auto", "auto_integral")


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A controller with what is proved and predicted of it; `controller` None, with the reason, where there is none."""

    name: str
    controller: Controller | None
    certified: bool = False
    prediction: Prediction | None = None
    reason: str = ""


def peer(name: str, plant: Plant, known: Identified, rate: float = 0.05) -> Peer:
    """One of `NAMES`. `rate` is asked of controller and observer where the method takes rates.

    uncontrolled: `u = u_eq`. pi: Tyreus and Luyben's rule on the linearised model. lqg: on the linear part and the mean
    slope. mpc: linear, horizon 20, S_u inverted, limits of the validation record. paper_lmi: any solution of the
    theorems' inequalities. guaranteed_cost: Riccati, the weights of `synthesis=riccati`. auto, auto_integral: ours.
    Raises `BadRequest` for another name.
    """
    match name:
        case "uncontrolled":
            return Peer(name=name, controller=Uncontrolled(plant=plant))
        case "pi":
            return _told(name, lambda: tyreus_luyben(known.model))
        case "lqg":
            return _of_gains(name, lqg(known.model, sensed(plant, known.model)), known)
        case "mpc":
            return _told(name, lambda: mpc(known.model, sensed(plant, known.model), *_record_limits(known)))
        case "paper_lmi":
            asked = LmiSynthesis(rate_controller=rate, rate_observer=rate, objective="feasibility", full=True)
            return _of_design(name, asked.design(known.model, *known.balls), known)
        case "guaranteed_cost":
            weights = LQGWeights()
            return _of_design(
                name,
                RiccatiSynthesis(rate_controller=rate, rate_observer=rate, **vars(weights)).design(
                    known.model, *known.balls
                ),
                known,
            )
        case "auto":
            return _of_design(name, Auto().design(known.model, *known.balls, known.validation), known)
        case "auto_integral":
            auto = Auto(integral_weights=INTEGRAL_WEIGHTS)
            return _told(
                name, lambda: _of_design(name, auto.design(known.model, *known.balls, known.validation), known)
            )
    raise BadRequest("loop.comparison.controllers", name, "no such controller", f"use some of {', '.join(NAMES)}")


def sensed(plant: Plant, model: SSM) -> LQGWeights:
    """LQG's weights with the sensor's own noise, as the textbook tunes a Kalman filter; one input scale drives it."""
    variance = float(np.mean(np.array(plant.noise_variance) / model.output_scale**2))
    return LQGWeights(output_noise=max(variance, 1e-6))


def _told(name: str, build: Callable[[], Controller | Peer]) -> Peer:
    try:
        built = build()
    except BadRequest as refusal:
        return Peer(name=name, controller=None, reason=str(refusal))
    return built if isinstance(built, Peer) else Peer(name=name, controller=built)


def _record_limits(known: Identified) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    moved = np.concatenate([record.u for record in known.validation])
    return moved.min(axis=0), moved.max(axis=0)


def _of_gains(name: str, controller: ObserverFeedback, known: Identified) -> Peer:
    return Peer(name=name, controller=controller, prediction=_predicted(controller, known))


def _of_design(name: str, design: Design, known: Identified) -> Peer:
    for part in (design.state_feedback, design.observer):
        if isinstance(part, Infeasible):
            return Peer(name=name, controller=None, reason=part.reason)
    controller = ObserverFeedback.of(known.model, design)
    predicted = _predicted(controller, known)
    return Peer(name=name, controller=controller, certified=design.certified, prediction=predicted)


def _predicted(controller: ObserverFeedback, known: Identified) -> Prediction:
    shown = mismatch(known.model, known.validation)
    return predict(known.model, controller.k, controller.l, *known.balls, shown)
