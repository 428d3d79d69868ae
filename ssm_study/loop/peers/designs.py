"""Comparison methods that need no tuning or that use a certified design. They are no control, the
paper's inequalities, guaranteed cost, and ours."""

# ruff: noqa: ARG002 - every peer gets all arguments; these need less
from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import Uncontrolled
from ssm_study.loop.peers.peer import Identified, Peer
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis


class UncontrolledPeer(Peer, names=("uncontrolled",)):
    """Comparison method that leaves the plant without control."""

    def build_controller(self, plant: Plant, identified: Identified, rate: float) -> Uncontrolled:
        """Control law that always applies the equilibrium input."""
        return Uncontrolled.for_plant(plant)


class PaperLmiPeer(Peer, names=("paper_lmi",)):
    """Comparison method that takes any feasible point of the linear matrix inequalities in the
    paper."""

    def build_controller(self, plant: Plant, identified: Identified, rate: float) -> Design:
        """Design from the linear matrix inequalities of the paper's theorems."""
        synthesis = LmiSynthesis(
            rate_controller=rate, rate_observer=rate, objective="feasibility", full=True
        )
        return synthesis.design(identified.model, identified.balls)


class GuaranteedCostPeer(Peer, names=("guaranteed_cost",)):
    """Comparison method that takes the Riccati design with the smallest guaranteed cost."""

    def build_controller(self, plant: Plant, identified: Identified, rate: float) -> Design:
        """Design with the smallest guaranteed cost at a given contraction rate."""
        synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=rate)
        return synthesis.design(identified.model, identified.balls)


class ChosenPeer(Peer, names=("auto",)):
    """Comparison method that uses this project's automatic design, `synthesis=auto`."""

    def build_controller(self, plant: Plant, identified: Identified, rate: float) -> Design:
        """Design that `synthesis=auto` chooses for the identified model."""
        return identified.auto_design(Auto())


class ChosenIntegralPeer(Peer, names=("auto_integral",)):
    """Comparison method that uses this project's automatic design with integral action."""

    def build_controller(self, plant: Plant, identified: Identified, rate: float) -> Design:
        """Certified design with integral action that the automatic synthesis (`synthesis=auto`)
        chooses for the identified model."""
        integral_weights = (1e-4, 1e-3, 1e-2)
        synthesis = Auto(integral_weights=integral_weights)
        return identified.auto_design(synthesis)
