"""Certificates of the closed loop of a bilinear model, and the JSON file that stores them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import certificate_digest, read_certificate
from ssm_study.certificates.stored_fields import convert_field
from ssm_study.certificates.theorem import AGAIN, Theorem, VerificationContext
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import JacobianBall, JacobianBalls

PARTS = ("bilinear_loop", "bilinear_everywhere", "bilinear_contraction")
DIMENSIONS = {"k": Float[np.ndarray, "m n"], "l_nodes": Float[np.ndarray, "q n p"]}


@dataclass(frozen=True, kw_only=True)
class BilinearDesign:
    """Gains of a bilinear model's controller and observer with their certificates, or the reasons
    why there are none.

    `v = K xh`; `l_nodes (q, n, p)` are the observer's gains at the nodes. The parts are named after
    their theorems.
    """

    k: Float[np.ndarray, "m n"]
    l_nodes: Float[np.ndarray, "q n p"]
    parts: Mapping[str, Theorem]
    reasons: Mapping[str, str]

    @property
    def certified(self) -> bool:
        """Whether the closed loop of a bilinear model is proved to come to rest, from a set of
        initial states or from all."""
        names = ("bilinear_loop", "bilinear_everywhere")
        return any(name in self.parts and self.parts[name].certified for name in names)

    def to_json(self) -> dict[str, Any]:
        """Content of `certificate.json` as plain data; numbers are read back without rounding."""
        content: dict[str, Any] = {"k": self.k.tolist(), "l_nodes": self.l_nodes.tolist()}
        content["reasons"] = dict(self.reasons)
        for label, part in self.parts.items():
            plain: dict[str, Any] = {"theorem": part.name()}
            for name, value in vars(part).items():
                plain[name] = value.tolist() if isinstance(value, np.ndarray) else value
            content[label] = plain | {"digest": certificate_digest(plain)}
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "BilinearDesign":
        """Read the gains and certificates of a bilinear closed loop from the content of
        `certificate.json`. Raises `BadRequest` for a missing or malformed entry."""
        gains = {}
        for name, kind in DIMENSIONS.items():
            require(name in content, f"certificate.{name}", None, "is missing", AGAIN)
            gains[name] = convert_field(f"certificate.{name}", kind, content[name])
        reasons = content.get("reasons")
        texts = reasons.values() if isinstance(reasons, dict) else [reasons]
        is_text = all(isinstance(text, str) for text in texts)
        is_object = isinstance(reasons, dict)
        require(
            is_object and is_text,
            "certificate.reasons",
            reasons,
            "is no object whose values are texts",
            AGAIN,
        )
        names = content.keys() - {*DIMENSIONS, "reasons"}
        for name in sorted(names):
            problem = f"is not one of {', '.join(PARTS)}"
            require(name in PARTS, "certificate", name, problem, AGAIN)
        parts = {name: read_certificate(name, content[name]) for name in PARTS if name in names}
        return cls(**gains, parts=parts, reasons=dict(content["reasons"]))

    def save(self, path: Path) -> None:
        """Write the gains and certificates of a bilinear closed loop to a JSON file."""
        text = json.dumps(self.to_json(), indent=1, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")


def failed_bilinear_checks(content: Mapping[str, Any], model: Any) -> list[str]:
    """One sentence for each claim in a bilinear model's stored `certificate.json` that does not
    hold.

    Claims are each part's digest, the model's fields, the deployed gains, and `certified`.
    """
    try:
        certificates = BilinearDesign.from_json(content)
    except BadRequest as malformed:
        return [str(malformed)]
    ball = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=ball, output=ball)
    context = VerificationContext(
        system=model, controlled=model, balls=balls, gains={"k": certificates.k}
    )
    stacked = certificates.l_nodes.reshape(-1, certificates.l_nodes.shape[2])
    broken = []
    for label, part in certificates.parts.items():
        stored = content[label]
        if stored.get("digest") != certificate_digest(stored):
            broken.append(f"{label}.digest: the stored numbers are not those that were written")
        broken += [f"{label}{sentence}" for sentence in part.failed_checks(context)]
        deployed = {"k": certificates.k, "l_nodes": stacked}
        for name, gain in deployed.items():
            if not np.array_equal(vars(part).get(name, gain), gain):
                broken.append(f"{label}.{name}: the gain is not the one that is deployed")
    return broken
