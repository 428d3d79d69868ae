"""Comparison methods that need no tuning or that use a certified design. They are no control, the
paper's inequalities, guaranteed cost, and ours."""

# ruff: noqa: ARG002 - every peer gets all arguments; these need less
from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import NoControl
from ssm_study.loop.peers.peer import ComparisonMethod, IdentificationResult
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis


class UncontrolledMethod(ComparisonMethod, names=("uncontrolled",)):
    """Comparison method that leaves the plant without control."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> NoControl:
        """Control law that always applies the equilibrium input."""
        return NoControl.for_plant(plant)


class PaperLmiMethod(ComparisonMethod, names=("paper_lmi",)):
    """Comparison method whose gains are any feasible point of the linear matrix inequalities in the
    paper (Zakwan et al., arXiv 2604.07069)."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> Design:
        """Design from the linear matrix inequalities of the paper's theorems."""
        synthesis = LmiSynthesis(
            rate_controller=rate, rate_observer=rate, objective="feasibility", full=True
        )
        return synthesis.design(identified.model, identified.balls)


class GuaranteedCostMethod(ComparisonMethod, names=("guaranteed_cost",)):
    """Comparison method that takes the Riccati design with the smallest guaranteed quadratic
    cost."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> Design:
        """Design with the smallest guaranteed cost at a given contraction rate."""
        synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=rate)
        return synthesis.design(identified.model, identified.balls)


class AutoDesignMethod(ComparisonMethod, names=("auto",)):
    """Comparison method that takes the design chosen by this project's automatic synthesis,
    `synthesis=auto`."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> Design:
        """Design that `synthesis=auto` chooses for the identified model."""
        return identified.auto_design(Auto())


class AutoIntegralMethod(ComparisonMethod, names=("auto_integral",)):
    """Comparison method that takes this project's automatic design with integral action."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> Design:
        """Certified design with integral action that the automatic synthesis (`synthesis=auto`)
        chooses for the identified model."""
        integral_weights = (1e-4, 1e-3, 1e-2)
        synthesis = Auto(integral_weights=integral_weights)
        return identified.auto_design(synthesis)
