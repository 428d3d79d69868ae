"""Any stored model back from its JSON: the SSM, or a baseline by its kind."""

from collections.abc import Mapping
from typing import Any

from ssm_study.models.baseline_deep import DeepSSM
from ssm_study.models.baseline_dynonet import DynoNet
from ssm_study.models.baseline_recurrent import Recurrent
from ssm_study.models.baseline_solved import Polynomial
from ssm_study.models.identified import SSM, Simulator
from ssm_study.refusal import BadRequest


def model_from_json(data: Mapping[str, Any]) -> Simulator:
    """An SSM has no kind; raises `BadRequest` for an unknown one."""
    match data.get("kind"):
        case None:
            return SSM.from_json(data)
        case "deep_ssm":
            return DeepSSM.from_json(data)
        case "dynonet":
            return DynoNet.from_json(data)
        case "gru" | "lstm":
            return Recurrent.from_json(data)
        case "narx":
            return Polynomial.from_json(data)
        case kind:
            raise BadRequest("kind", kind, "unknown model", "use an SSM, deep_ssm, dynonet, gru, lstm or narx")
