"""Peers of the comparison that need no tuning or use a certified design. They are no control, the
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
    """Peer that leaves the plant uncontrolled."""

    def build(self, plant: Plant, known: Identified, rate: float) -> Uncontrolled:
        return Uncontrolled.of(plant)


class PaperLmiPeer(Peer, names=("paper_lmi",)):
    """Peer with any solution of the inequalities of the paper's theorems."""

    def build(self, plant: Plant, known: Identified, rate: float) -> Design:
        synthesis = LmiSynthesis(
            rate_controller=rate, rate_observer=rate, objective="feasibility", full=True
        )
        return synthesis.design(known.model, known.balls)


class GuaranteedCostPeer(Peer, names=("guaranteed_cost",)):
    """Peer with the Riccati design of least guaranteed cost, with the weights of
    `synthesis=riccati`."""

    def build(self, plant: Plant, known: Identified, rate: float) -> Design:
        synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=rate)
        return synthesis.design(known.model, known.balls)


class ChosenPeer(Peer, names=("auto",)):
    """Peer with our own automatic choice, `synthesis=auto`."""

    def build(self, plant: Plant, known: Identified, rate: float) -> Design:
        return known.chosen(Auto())


class ChosenIntegralPeer(Peer, names=("auto_integral",)):
    """Peer with our own automatic choice and integral action."""

    def build(self, plant: Plant, known: Identified, rate: float) -> Design:
        integral_weights = (1e-4, 1e-3, 1e-2)
        synthesis = Auto(integral_weights=integral_weights)
        return known.chosen(synthesis)
