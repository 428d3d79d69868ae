"""The controllers compared on one plant, one file each: left alone, textbook, the paper's, ours;
what each may know."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from ssm_study.certificates.certificate import Design
from ssm_study.family import Family
from ssm_study.loop.controller import Controller, ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model, at_rest
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.robustness.prediction import predict
from ssm_study.signals import DataSet, Trajectory
from ssm_study.systems import Balls

if TYPE_CHECKING:
    from ssm_study.synthesis.auto import Auto

Row = dict[str, Any]
# Nothing where a controller has no model.
PREDICTED = ("mismatch_margin", "resolved_margin", "controller_radius", "noise_peak")
UNSAID: Row = {"controller": "", "certified": False, **dict.fromkeys(PREDICTED), "reason": ""}


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Data that every controller may use: the model, the balls of its Jacobians, the validation
    record."""

    model: Model
    balls: Balls
    validation: tuple[Trajectory, ...]
    mismatch_records: tuple[Trajectory, ...] = ()
    start_up_samples: int = 0

    @classmethod
    def of(cls, model: Model, balls: Balls, data: DataSet) -> "Identified":
        """The model beside the records that may be known."""
        records = {
            name: getattr(data, name)
            for name in ("validation", "mismatch_records", "start_up_samples")
        }
        return cls(model=model, balls=balls, **records)

    @cached_property
    def without_neurons(self) -> SSM:
        """Linear model as a textbook's design sees it: neurons by their slopes at rest, within A,
        B, C and D."""
        if isinstance(self.model, SSM):
            return self.model
        parts: dict[str, Any] = {
            n: getattr(self.model, n) for n in ("scaffold_in", "scaffold_out", "scale", "step_s")
        }
        return SSM(linear=at_rest(self.model), **parts)

    @cached_property
    def shown(self) -> Mismatch:
        """How far the plant is from the model, as the records show it."""
        return measure_mismatch(
            self.model, self.validation, self.start_up_samples, self.mismatch_records
        )

    def chosen(self, synthesis: "Auto") -> Design:
        """Design that `auto` chooses from the model, the balls, the validation records and the
        mismatch."""
        return synthesis.design(self.model, self.balls, self.validation, self.shown)


class Peer(Family):
    """A way to a controller; `names` is what the comparison calls it."""

    @abstractmethod
    def build(self, plant: Plant, known: Identified, rate: float) -> Controller | Design:
        """`rate` is asked of controller and observer where the method takes rates. Raises
        `BadRequest` for a model or plant that it has no controller for."""


def compared(
    name: str, plant: Plant, known: Identified, rate: float = 0.05
) -> tuple[Controller | None, Row]:
    """One of the peers, None where it has no controller, and what is proved and predicted of it, or
    the reason."""
    said = UNSAID | {"controller": name}
    try:
        built = Peer.known[name]().build(plant, known, rate)
        controller = ObserverFeedback.of(known.model, built) if isinstance(built, Design) else built
    except BadRequest as refusal:
        return None, said | {"reason": str(refusal)}
    if isinstance(controller, ObserverFeedback):
        said |= vars(predict(known.model, controller.gains, known.balls, known.shown))
    return controller, said | {"certified": isinstance(built, Design) and built.certified}
