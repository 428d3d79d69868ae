"""Coverage of a controller that hardly acts, which is not reported.

Such a controller covers any model error, for the plant comes to rest without it. Source:
docs/trust.md, "Covered".
"""

from typing import Any

from ssm_study.models.structured import Model
from ssm_study.robustness.coverage_columns import WITHHELD
from ssm_study.synthesis.loop_poles import eigenvalue_groups, moves_poles
from ssm_study.systems import Gains

IDLE = f"{WITHHELD}: the controller hardly acts"


def withhold_idle_coverage(facts: dict[str, Any], model: Model, gains: Gains) -> dict[str, Any]:
    """Replace the coverage of a controller that hardly acts by the reason why it is not
    reported."""
    coverage = facts.get("coverage")
    if coverage is None or coverage < 1:
        return facts
    poles = eigenvalue_groups(model, gains)
    if moves_poles(poles["model"], poles["controlled"]):
        return facts
    withheld = {"coverage": None, "coverage_reference": None, "coverage_reason": IDLE}
    return facts | withheld
