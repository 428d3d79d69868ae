"""Certificates in `certificate.json` that earlier versions wrote and that are no longer checked."""

from typing import Any

from ssm_study.refusal import BadRequest
from ssm_study.withdrawn import WITHDRAWN_THEOREMS

TOLERANCE = "tolerance"  # the disc on the input alone
# Parts that 0.1 wrote, each with the names of its theorems: kept as they were read.
WITHDRAWN_TOLERANCES = {"tolerance", "structured_tolerance"}
WITHDRAWN_PARTS = {"noise": {"noise_gain"}, TOLERANCE: WITHDRAWN_TOLERANCES}
WITHDRAWN_PARTS["tolerance_by_frequency"] = WITHDRAWN_TOLERANCES


def is_withdrawn(label: str, content: Any) -> bool:
    """Whether a certificate in `certificate.json` is by a theorem of an earlier version that no
    longer exists."""
    named = content.get("theorem", label) if isinstance(content, dict) else None
    return named in WITHDRAWN_PARTS.get(label, ())


def refuse_withdrawn_theorem(field: str, theorem: str) -> None:
    """Raise `BadRequest` if a certificate is by a theorem of an earlier version that no longer
    exists."""
    if theorem in WITHDRAWN_THEOREMS:
        withdrawn = WITHDRAWN_THEOREMS[theorem]
        raise BadRequest(field, theorem, f"was {withdrawn.sentence}", withdrawn.remedy)
