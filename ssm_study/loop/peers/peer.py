"""Interface of the control methods that are compared on one plant, and the data that each method
may use."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from ssm_study.certificates.certificate import Design
from ssm_study.family import Family
from ssm_study.loop.controller import Controller, ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.signals import DataSet, Trajectory
from ssm_study.systems import JacobianBalls

if TYPE_CHECKING:
    from ssm_study.synthesis.auto import Auto

Row = dict[str, Any]
# Empty where a controller has no model.
PREDICTED = ("mismatch_margin", "resolved_margin", "controller_radius", "noise_peak")
UNSAID: Row = {"controller": "", "certified": False, **dict.fromkeys(PREDICTED), "reason": ""}


@dataclass(frozen=True, kw_only=True)
class IdentificationResult:
    """Results of an identification that the compared control methods may use: model, balls of
    Jacobians and validation records."""

    model: Model
    balls: JacobianBalls
    validation: tuple[Trajectory, ...]
    mismatch_records: tuple[Trajectory, ...] = ()
    start_up_samples: int = 0

    @classmethod
    def from_data_set(
        cls, model: Model, balls: JacobianBalls, data: DataSet
    ) -> "IdentificationResult":
        """Collect what the compared control methods may use, from an identified model and its data
        set."""
        return cls(
            model=model,
            balls=balls,
            validation=data.validation,
            mismatch_records=data.mismatch_records,
            start_up_samples=data.start_up_samples,
        )

    @cached_property
    def linear_model(self) -> SSM:
        """Linear model in which the neurons of the identified model are replaced by their slopes at
        the equilibrium."""
        return replace_neurons_by_slopes(self.model)

    @cached_property
    def mismatch(self) -> Mismatch:
        """Error of the identified model in the records, by frequency and input amplitude."""
        return measure_model_error(
            self.model, self.validation, self.start_up_samples, self.mismatch_records
        )

    def auto_design(self, synthesis: "Auto") -> Design:
        """Certified design that the automatic synthesis (`synthesis=auto`) chooses for the
        identified model."""
        return synthesis.design(self.model, self.balls, self.validation, self.mismatch)


def replace_neurons_by_slopes(model: Model) -> SSM:
    """Linear model in which the neurons of a model are replaced by their slopes at the
    equilibrium."""
    if isinstance(model, SSM):
        return model
    linear = linearise_at_equilibrium(model)
    return SSM(
        linear=linear,
        scaffold_in=model.scaffold_in,
        scaffold_out=model.scaffold_out,
        scale=model.scale,
        step_s=model.step_s,
        b_d=model.b_d,
    )


class ComparisonMethod(Family):
    """Interface of a control method that takes part in the comparison of controllers. `names` are
    the method's names there."""

    @abstractmethod
    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> Controller | Design:
        """Build the controller that a compared control method gives for a plant, or a design if the
        method certifies its gains.

        Raises `BadRequest` for a model or plant that the method has no controller for.
        """


def build_compared_controller(
    name: str, plant: Plant, identified: IdentificationResult, rate: float = 0.05
) -> tuple[Controller | None, Row]:
    """Build the controller of one compared control method, with table columns of what is proved and
    predicted for it.

    None, and a row with the reason, where the peer has no controller.
    """
    columns = UNSAID | {"controller": name}
    is_certified = False
    try:
        peer = ComparisonMethod.known[name]()
        built = peer.build_controller(plant, identified, rate)
        if isinstance(built, Design):
            controller: Controller = ObserverFeedback.from_design(identified.model, built)
            is_certified = built.certified
        else:
            controller = built
    except BadRequest as refusal:
        reason = {"reason": str(refusal)}
        return None, columns | reason
    if isinstance(controller, ObserverFeedback):
        prediction = predict_margins(
            identified.model, controller.gains, identified.balls, identified.mismatch
        )
        columns |= vars(prediction)
    columns["certified"] = is_certified
    return controller, columns
