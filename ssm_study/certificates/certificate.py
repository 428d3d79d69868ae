"""Certificates of a design, or the reasons why there are none, and the JSON file that stores them.

Each theorem declares the fields of its certificate (`certificates.theorem`). Source: [Z26],
docs/theory.md.
"""

import hashlib
import json
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import DUAL, Neurons, Problem, Solution, dual_system
from ssm_study.certificates.stored_fields import read_fields
from ssm_study.certificates.theorem import AGAIN, Blocks, Theorem, VerificationContext, find_theorem
from ssm_study.certificates.withdrawn_parts import TOLERANCE, is_withdrawn, refuse_withdrawn_theorem
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import Gains, JacobianBall

# The letter of each matrix in a state feedback's problem, and an observer's for the same matrix,
# transposed.
LETTERS = {
    "a": "a",
    "b": "c",
    "e": "f",
    "f": "e",
    "g": "h",
    "p": "q",
    "y": "u",
    "k": "l",
    "k_w": "l_z",
}


@dataclass(frozen=True, kw_only=True)
class GainTheorem(Theorem, abstract=True):
    """Base class of certificates of one gain matrix, either the controller's or the observer's.
    Distances shrink by `r = sqrt(1 - rate)` a sample, for every Jacobian in the ball.

    `rate_limit` is the exact frontier of all gains at this ball; `observes` tells an observer from
    a state feedback.
    """

    a: Float[np.ndarray, "n n"]
    rate: float
    rate_limit: float

    observes: ClassVar[bool]

    @property
    def contraction_factor(self) -> float:
        """Contraction factor r: the certificate proves that distances shrink by r per sample."""
        return float(np.sqrt(1 - self.rate))

    @property
    def gains(self) -> dict[str, Float[np.ndarray, "r c"]]:
        """Gain matrices of a certificate by symbol: `k`, or `l` (and `l_z` for neurons)."""
        stored = vars(self)
        return {letter: stored[letter] for letter in ("k", "l", "l_z") if letter in stored}

    @property
    def gain(self) -> Float[np.ndarray, "r c"]:
        """Gain matrix of a certificate, K of a controller or L of an observer."""
        return self.gains["l" if self.observes else "k"]

    @property
    def gain_norm(self) -> float:
        """Spectral norm of a certificate's gain matrix, in scaled units. `||K||_2` is scaled input
        per state unit; `||L||_2` state unit per scaled output."""
        return float(np.linalg.norm(self.gain, 2))

    @classmethod
    def required_ball(cls, context: VerificationContext) -> JacobianBall:
        """Ball of Jacobians of the static map for which a certificate must hold. For a controller
        it is that of `S_u`, for an observer that of `S_y`."""
        return context.balls.output if cls.observes else context.balls.input

    def certificate_at_largest_rate(self) -> "GainTheorem | None":
        """Certificate of the largest contraction rate for the gain of this certificate; None if no
        larger rate is proved."""
        return None

    @staticmethod
    @abstractmethod
    def certificate_numbers(problem: Any, solution: Any) -> dict[str, Any]:
        """Collect from a synthesis problem and its solution every number that the certificate
        stores."""


class ProblemCertificate(GainTheorem, abstract=True):
    """Mixin for certificates that prove the same matrix inequality that the synthesis solved. It
    stands beside `StateFeedback` or `Observer` and serves theorems whose fields have the symbols of
    `LETTERS`."""

    @staticmethod
    @abstractmethod
    def inequality(proof: Any) -> Blocks:
        """Matrix inequality of the theorem, as the upper triangle of its blocks."""

    @classmethod
    def conditions(cls, proof: Any) -> dict[str, Blocks]:
        """Conditions of a theorem: its matrix inequality, and a contraction rate between zero and
        one."""
        return {
            "inequality": cls.inequality(proof),
            "rate above 0": [[proof.rate]],
            "rate below 1": [[1 - proof.rate]],
        }

    @classmethod
    def _certified_system(cls, context: VerificationContext) -> Any:
        """System for which a certificate is proved: the model and, for a controller, any internal
        model of disturbances or references."""
        return context.system if cls.observes else context.controlled

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of a certificate that are matrices of the model."""
        system = self._certified_system(context)
        names = [part.name for part in fields(self) if part.name in DUAL]
        return {name: getattr(system, name) for name in names}

    @classmethod
    def largest_provable_rate(cls, context: VerificationContext) -> float:
        """Largest contraction rate that the theorem can prove for a model by the best gain. It is
        the exact frontier; with neurons, the smallest over frozen slopes."""
        system = cls._certified_system(context)
        controlled = dual_system(system) if cls.observes else system
        ball = cls.required_ball(context)
        frontier = controller_frontier(controlled, ball)
        return frontier.rate_limit

    @classmethod
    def certificate_numbers(cls, problem: Problem, solution: Solution) -> dict[str, Any]:
        """Collect a certificate's matrices from a synthesis problem and its solution, keyed by
        symbol. Those of an observer are transposed back from the dual problem."""
        numbers: dict[str, Any] = {**vars(problem), **vars(solution)}
        if problem.neurons:
            numbers |= vars(problem.neurons)
        transposed = {}
        for letter, other in LETTERS.items():
            matrix = numbers.get(letter)
            if matrix is not None:
                transposed[other] = matrix.T.copy()
        numbers["alpha"] = problem.ball.alpha
        numbers["beta"] = problem.ball.beta
        numbers["eta"] = solution.sigma
        numbers["lambda_"] = solution.multipliers
        if cls.observes:
            numbers |= transposed
        names = [part.name for part in fields(cls)]
        return {name: numbers[name] for name in names if name in numbers}

    def as_problem(self) -> tuple[Problem, Solution]:
        """Rebuild the synthesis problem, without weights, and its solution from the numbers in a
        certificate. Matrices of an observer are transposed."""
        stored: dict[str, Any] = dict(vars(self))
        numbers = dict(stored)
        if self.observes:
            for letter, other in LETTERS.items():
                if other in stored:
                    numbers[letter] = np.ascontiguousarray(stored[other].T)
        neurons = None
        if "e" in numbers:
            neurons = Neurons(
                e=numbers["e"], f=numbers["f"], g=numbers["g"], observes=self.observes
            )
        problem = Problem(
            a=numbers["a"],
            b=numbers["b"],
            ball=JacobianBall(alpha=self.alpha, beta=self.beta),
            rate=self.rate,
            neurons=neurons,
            state_weight=np.eye(len(self.a)),
            input_weight=1.0,
        )
        solution = Solution(
            p=numbers["p"],
            y=numbers["y"],
            k=numbers["k"],
            k_w=numbers.get("k_w"),
            status="",
            sigma=numbers["eta" if self.observes else "sigma"],
        )
        return problem, solution


@dataclass(frozen=True, kw_only=True)
class StateFeedback(GainTheorem, abstract=True):
    """Certificate that a state feedback `u = K x` makes the model contract in a metric. The metric
    is `M = P^{-1}`: the inequalities are linear in `p (n, n)`.

    The printed proof says P, the inequality is the dual form.
    """

    b: Float[np.ndarray, "n m"]
    p: Float[np.ndarray, "n n"]
    k: Float[np.ndarray, "m n"]

    part: ClassVar[str] = "state_feedback"
    metric_matrix: ClassVar[str] = "p"
    observes: ClassVar[bool] = False


@dataclass(frozen=True, kw_only=True)
class Observer(GainTheorem, abstract=True):
    """Certificate that an observer makes the estimation error contract in a metric Q."""

    c: Float[np.ndarray, "p n"]
    q: Float[np.ndarray, "n n"]
    l: Float[np.ndarray, "n p"]  # noqa: E741  the paper's letter, and the public file's

    part: ClassVar[str] = "observer"
    metric_matrix: ClassVar[str] = "q"
    observes: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class Infeasible:
    """Reason why a design has no certificate for its controller or for its observer. It is a
    result, not an error; `rate_limit` says which rate was possible.

    `proved` is true if the exact frontier (or a hypothesis) excludes the rate for every method;
    otherwise only the method that was used found nothing.
    """

    theorem: str
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


SIDES = ("state_feedback", "observer")
# Parts of the file that are another part's theorem once more: at the largest rate, under another
# weight, with limits.
BESIDE = {f"{side}_deployed": side for side in SIDES}
OF_LIMITS = {
    "state_feedback_limited": "limited_input",
    "state_feedback_unlimited": "unlimited_start",
}
BESIDE |= dict.fromkeys(OF_LIMITS, "state_feedback")
BESIDE[TOLERANCE] = "coverage"
WITHDRAWN = "withdrawn in 0.2"


@dataclass(frozen=True, kw_only=True)
class Design:
    """Controller and observer with their certificates; either may be missing, with the reason.

    `extra_certificates` are those about the deployed pair of gains, by their names in the file.
    `withdrawn`: entries of an older file that are not claimed any more, as they were read.
    """

    state_feedback: StateFeedback | Infeasible
    observer: Observer | Infeasible
    extra_certificates: Mapping[str, Theorem] = field(default_factory=dict)
    withdrawn: Mapping[str, Any] = field(default_factory=dict)

    @property
    def certified(self) -> bool:
        """Whether controller and observer have certificates confirmed in exact arithmetic."""
        return self.state_feedback.certified and self.observer.certified

    @property
    def feasible(self) -> bool:
        """Whether controller and observer have certificates, checked exactly or not."""
        sides = (self.state_feedback, self.observer)
        return not any(isinstance(part, Infeasible) for part in sides)

    def controller_and_observer(self) -> tuple[StateFeedback, Observer]:
        """Pair of a design's certificates, first the controller's and then the observer's. Raises
        `BadRequest` with the reason where one is infeasible."""
        for name in SIDES:
            part = self.certificates_by_name[name]
            if isinstance(part, Infeasible):
                reason = part.reason.rstrip(".")
                raise BadRequest(f"design.{name}", "infeasible", reason, "change the request")
        return self.state_feedback, self.observer  # type: ignore[return-value]  # Infeasible has just been refused

    @property
    def gain_pair(self) -> Gains:
        """Gains of the controller and the observer of a design. Raises `BadRequest` with the reason
        where one of them is infeasible."""
        feedback, observer = self.controller_and_observer()
        n = len(observer.l)
        l_z = getattr(observer, "l_z", None)
        internal = feedback.a[n:, n:] if len(feedback.a) > n else None
        return Gains(k=feedback.k, l=observer.l, l_z=l_z, internal=internal)

    @property
    def certificates_by_name(self) -> dict[str, Theorem | Infeasible]:
        """All certificates of a design, keyed by their names in `certificate.json`."""
        return {
            "state_feedback": self.state_feedback,
            "observer": self.observer,
            **self.extra_certificates,
        }

    @property
    def gains(self) -> dict[str, Float[np.ndarray, "r c"]]:
        """Gain matrices present in a design, by symbol: `k`, `l` and `l_z`."""
        gains = dict[str, Float[np.ndarray, "r c"]]()
        for part in (self.state_feedback, self.observer):
            if isinstance(part, GainTheorem):
                gains |= part.gains
        return gains

    def certified_rate(self, side: str) -> float | None:
        """Largest proved contraction rate of the controller's or the observer's gain; None if no
        rate is proved."""
        part = self.certificates_by_name[side]
        deployed_part = self.extra_certificates.get(f"{side}_deployed")
        certificates = [one for one in (part, deployed_part) if isinstance(one, GainTheorem)]
        rates = [certificate.rate for certificate in certificates if certificate.certified]
        return max(rates, default=None)

    def to_json(self) -> dict[str, Any]:
        """Content of `certificate.json`; its numbers are read back without rounding."""
        content = {}
        for label, part in self.certificates_by_name.items():
            is_theorem = isinstance(part, Theorem)
            plain = dict[str, Any]()
            if label in SIDES:
                plain["certified_rate"] = self.certified_rate(label)
            if isinstance(part, Theorem):
                plain["theorem"] = part.name()
            for name, value in vars(part).items():
                is_array = isinstance(value, np.ndarray)
                plain[name.rstrip("_")] = value.tolist() if is_array else value
            plain["certified"] = part.certified
            plain["feasible"] = is_theorem
            digest = certificate_digest(plain)
            content[label] = plain | {"digest": digest}
        return content | dict(self.withdrawn)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "Design":
        """Read a design from the content of `certificate.json`. Raises `BadRequest` for a missing
        part, an unknown or missing field, or a malformed matrix."""
        for part in SIDES:
            require(part in content, f"certificate.{part}", None, "is missing", AGAIN)
        withdrawn = {name: part for name, part in content.items() if is_withdrawn(name, part)}
        claimed = [name for name in content if name not in withdrawn]
        parts = {name: read_certificate(name, content[name]) for name in claimed}
        sides = {name: parts.pop(name) for name in SIDES}
        return cls(**sides, extra_certificates=parts, withdrawn=withdrawn)

    def save(self, path: Path) -> None:
        """Write a design with its certificates to a JSON file."""
        text = json.dumps(self.to_json(), indent=1, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> "Design":
        """Read a design from a JSON file; raises `BadRequest` for a file that holds no design."""
        return cls.from_json(json.loads(path.read_text(encoding="utf-8")))


def certificate_digest(content: dict[str, Any]) -> str:
    """SHA-256 hash of a certificate's fields as canonical JSON, which reveals whether the file was
    altered."""
    other_fields = {name: value for name, value in content.items() if name != "digest"}
    canonical = json.dumps(other_fields, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()


def read_certificate(label: str, content: Any) -> Any:
    """Construct a certificate from its stored fields, which name its theorem. A part that names
    none belongs to the theorem of the part's own name. Raises `BadRequest` for an unknown or a
    withdrawn theorem, and for content that is no object of JSON."""
    where = f"certificate.{label}"
    require(isinstance(content, dict), where, content, "is no object", AGAIN)
    derived = ("digest", "certified_rate")
    stored = {name: value for name, value in content.items() if name not in derived}
    part = BESIDE.get(label, label)
    named = str(stored.setdefault("theorem", part))
    refuse_withdrawn_theorem(f"{where}.theorem", named)
    theorem = find_theorem(named)
    name = theorem.name()
    fits = theorem.part == part and OF_LIMITS.get(label, name) == name
    require(
        fits, f"{where}.theorem", name, "is the theorem of another part of the certificate", AGAIN
    )
    feasible = stored.pop("feasible", True)
    kind: Any = theorem if feasible else Infeasible
    stored.pop("theorem" if feasible else "certified", None)
    return kind(**read_fields(where, kind, stored))
