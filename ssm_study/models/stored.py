"""Reading of identified models from their JSON form."""

from collections.abc import Mapping
from typing import Any

from ssm_study.models import baselines
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.structured import StructuredSSM
from ssm_study.refusal import require_one_of


def model_from_json(data: Mapping[str, Any]) -> Simulator:
    """Read an identified model of any kind from its JSON form. Raises `BadRequest` for an unknown
    kind. An SSM has no kind there, a structured model has neurons instead."""
    if data.get("kind") is None:
        return StructuredSSM.from_json(data) if "neurons" in data else SSM.from_json(data)
    if data["kind"] == "bilinear":
        return Bilinear.from_json(data)  # without the import of torch
    kinds = Simulator.members(baselines)
    require_one_of(kinds, "kind", data["kind"])
    kind = kinds[data["kind"]]
    return kind.from_json(data)
