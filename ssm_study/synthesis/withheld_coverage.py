"""Reasons not to report a coverage (ratio of proved to recorded model error): the controller hardly
acts or is unstable by itself.

A controller that hardly acts covers any model error, for the plant comes to rest without it. A
controller that is unstable by itself needs the plant's answer at every amplitude, beyond those on
record, too: where an actuator saturates or friction holds the plant, it runs alone. Source:
docs/trust.md, "Covered".
"""

from typing import Any

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.robustness.coverage_columns import WITHHELD
from ssm_study.robustness.sensitivity import controller_spectral_radius
from ssm_study.synthesis.loop_poles import eigenvalue_groups, moves_poles
from ssm_study.synthesis.measured_discs_run import coverage_columns
from ssm_study.systems import Gains

IDLE = f"{WITHHELD}: the controller hardly acts"
UNSTABLE = (
    f"{WITHHELD}: the controller itself is unstable, so it fails where the plant holds still "
    "(input limit, friction), whatever the proof covers"
)


def reported_coverage(design: Design, model: Model, premise: ModelErrorSpectra) -> float | None:
    """Coverage of a design (ratio of proved to recorded model error) for the report; None if it is
    missing or withheld."""
    facts = coverage_columns(design, model, premise)
    if design.feasible:
        facts = withhold_coverage(facts, model, design.gain_pair)
    coverage: float | None = facts.get("coverage")
    return coverage


def withhold_coverage(columns: dict[str, Any], model: Model, gains: Gains) -> dict[str, Any]:
    """Replace a run's coverage (ratio of proved to recorded model error) by a reason not to report
    it, if the controller hardly acts or is unstable by itself."""
    coverage = columns.get("coverage")
    if coverage is None or coverage < 1:
        return columns
    reason = withholding_reason(model, gains)
    if reason is None:
        return columns
    withheld = {"coverage": None, "coverage_reference": None, "coverage_reason": reason}
    return columns | withheld


def withholding_reason(model: Model, gains: Gains) -> str | None:
    """Reason why the coverage of a controller is not reported; None if it may be reported."""
    poles = eigenvalue_groups(model, gains)
    if not moves_poles(poles["model"], poles["controlled"]):
        return IDLE
    radius = controller_spectral_radius(model.system, gains, certified_balls(model))
    return UNSTABLE if radius >= 1 else None
