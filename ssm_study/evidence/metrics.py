"""The columns of the evidence, and what it does to a prediction."""

from typing import Any

from ssm_study.columns import Column
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.judgement import Judgement

NOT_KEPT = "where the training records cannot be made or read again"

COLUMNS = (
    Column("evidence", "string", word="Evidence", unchecked=NOT_KEPT),
    Column("evidence_reasons", "string", word="What the evidence lacks", unchecked=NOT_KEPT),
)


def evidence_facts(judgement: Judgement) -> dict[str, Any]:
    """`evidence` is sound, doubt or cannot judge; notes leave it sound."""
    return {"evidence": judgement.level, "evidence_reasons": judgement.reasons}


def withheld(facts: dict[str, Any], level: str | None) -> dict[str, Any]:
    """The facts of a design with no prediction where the evidence allows none."""
    return facts | {"predicted_stable": None} if level == CANNOT_JUDGE and "predicted_stable" in facts else facts
