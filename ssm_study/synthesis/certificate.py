"""What synthesis hands on: a gain with the matrices of the theorem that certifies it, or why there is none."""

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class StateFeedback:
    """`u = K x` contracts `x+ = A x + B S_u(u)` by `r = sqrt(1 - rate)` a step in the metric `P^{-1}`.

    The matrices of [Z26] Theorem 1 (THEORY section 4), all as stored: `p, y (n, n)`, `k (m, n)`, `sigma > 0`, and
    `x (m, n)`, the rational product `k y` rounded to the nearest floats. `certified` is the verdict of exact arithmetic
    on `p, y, k y, sigma`; the rest is information: `margin` (smallest eigenvalue of the LMI scaled to a unit diagonal),
    `condition` (of p, scaled likewise), `rate_limit` (the exact frontier at this ball), `solver_status`, `seconds`.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    alpha: float
    beta: float
    rate: float
    p: Float[np.ndarray, "n n"]
    y: Float[np.ndarray, "n n"]
    x: Float[np.ndarray, "m n"]
    sigma: float
    k: Float[np.ndarray, "m n"]
    certified: bool
    margin: float
    condition: float
    rate_limit: float
    method: str
    solver_status: str
    seconds: float

    @property
    def contraction(self) -> float:
        """`r`: the factor by which distances shrink each step."""
        return float(np.sqrt(1 - self.rate))

    @property
    def metric(self) -> Float[np.ndarray, "n n"]:
        """`M = P^{-1}`, in which `delta^T M delta` shrinks by `1 - rate`: the printed LMI is in dual form."""
        inverse = np.linalg.inv(self.p)
        return (inverse + inverse.T) / 2

    @property
    def gain_norm(self) -> float:
        """`||K||_2`, in scaled input per state unit."""
        return float(np.linalg.norm(self.k, 2))


@dataclass(frozen=True, kw_only=True)
class Observer:
    """`xh+ = A xh + B S_u(u) + L (yh - y)` contracts by `r = sqrt(1 - rate)` a step in the metric `Q`.

    The matrices of [Z26] Theorem 2 as stored: `q, u (n, n)`, `l (n, p)`, `eta > 0`, and `v (n, p)`, the rational
    product `u l` rounded to the nearest floats. `certified` and the information beside it as in `StateFeedback`.
    """

    a: Float[np.ndarray, "n n"]
    c: Float[np.ndarray, "p n"]
    alpha: float
    beta: float
    rate: float
    q: Float[np.ndarray, "n n"]
    u: Float[np.ndarray, "n n"]
    v: Float[np.ndarray, "n p"]
    eta: float
    l: Float[np.ndarray, "n p"]  # noqa: E741  the paper's letter, and the public file's
    certified: bool
    margin: float
    condition: float
    rate_limit: float
    method: str
    solver_status: str
    seconds: float

    @property
    def contraction(self) -> float:
        """`r`: the factor by which the estimation error shrinks each step."""
        return float(np.sqrt(1 - self.rate))

    @property
    def metric(self) -> Float[np.ndarray, "n n"]:
        """`M = Q`."""
        return self.q

    @property
    def gain_norm(self) -> float:
        """`||L||_2`, in state unit per scaled output."""
        return float(np.linalg.norm(self.l, 2))


@dataclass(frozen=True, kw_only=True)
class Infeasible:
    """No certificate at these settings: a result, not an error.

    `proved` is True when the exact frontier (or a hypothesis of the theorem) excludes the request, so that no method
    can succeed; False when this method merely found nothing. `rate_limit` says how much was possible.
    """

    side: str
    alpha: float
    beta: float
    rate: float
    rate_limit: float
    proved: bool
    reason: str
    method: str
    solver_status: str
    seconds: float
    certified: ClassVar[bool] = False


@dataclass(frozen=True, kw_only=True)
class Design:
    """Controller and observer of one model; either may be missing, with its reason."""

    state_feedback: StateFeedback | Infeasible
    observer: Observer | Infeasible

    @property
    def certified(self) -> bool:
        return self.state_feedback.certified and self.observer.certified

    def to_json(self) -> dict[str, Any]:
        """The public file `certificate.json`: nested lists whose numbers read back to the same floats."""
        return {"state_feedback": _plain(self.state_feedback), "observer": _plain(self.observer)}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "Design":
        """Raises `BadRequest` for a missing part, an unknown or missing field, or a matrix that is no matrix."""
        for part in ("state_feedback", "observer"):
            require(part in content, f"certificate.{part}", None, "is missing", "synthesise again")
        return cls(
            state_feedback=_read(StateFeedback, "state_feedback", content["state_feedback"]),
            observer=_read(Observer, "observer", content["observer"]),
        )

    def save(self, path: Path) -> None:
        path.write_text(json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> "Design":
        return cls.from_json(json.loads(path.read_text(encoding="utf-8")))


def _plain(part: StateFeedback | Observer | Infeasible) -> dict[str, Any]:
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(part).items()}
    plain |= {"certified": part.certified, "feasible": not isinstance(part, Infeasible)}
    return plain | {"digest": digest(plain)}


def digest(content: dict[str, Any]) -> str:
    """SHA-256 of a part's other fields as canonical JSON: whether the file still says what was written."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _read(kind: Any, label: str, content: dict[str, Any]) -> Any:
    values = {name: value for name, value in content.items() if name != "digest"}
    if not values.pop("feasible", True):
        values.pop("certified", None)
        kind = Infeasible
    known = {part.name for part in fields(kind)}
    for name in known ^ set(values):
        problem = "is missing" if name in known else "is not part of a certificate"
        require(False, f"certificate.{label}.{name}", values.get(name), problem, "synthesise again")
    types = {part.name: part.type for part in fields(kind)}
    return kind(**{name: _value(label, name, types[name], value) for name, value in values.items()})


def _value(label: str, name: str, kind: Any, value: Any) -> Any:
    where = f"certificate.{label}.{name}"
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
        require(number, where, value, "is not a finite number", "synthesise again")
        return float(value)
    if kind in (bool, str):
        require(isinstance(value, kind), where, value, f"is not a {kind.__name__}", "synthesise again")
        return value
    return _matrix(where, value)


def _matrix(where: str, value: Any) -> Float[np.ndarray, "r c"]:
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    finite = matrix.ndim == 2 and bool(np.isfinite(matrix).all())
    require(finite, where, value, "is not a finite matrix", "synthesise again")
    return matrix
