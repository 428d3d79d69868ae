"""The identified model as explicit numbers: what is stored, replayed, certified and deployed. No torch here."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.scaffold import Scaffold, array_from_json
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.scaffold_monotone import MonotoneScaffold
from ssm_study.models.scaffold_residual import ResidualScaffold
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import StateSpace


def scaffold_from_json(data: Mapping[str, Any]) -> Scaffold:
    """The scaffolding that `to_json` wrote; raises `BadRequest` for an unknown kind."""
    match data.get("kind"):
        case "linear":
            return LinearScaffold.from_json(data)
        case "mlp":
            return MlpScaffold.from_json(data)
        case "monotone":
            return MonotoneScaffold.from_json(data)
        case "residual":
            return ResidualScaffold.from_json(data)
        case kind:
            raise BadRequest("kind", kind, "unknown scaffolding", "use linear, mlp, monotone or residual")


class Simulator(ABC):
    """An identified model, explicit numbers only: what training returns and what is stored."""

    @abstractmethod
    def simulate(self, u: Float[np.ndarray, "*batch T m"]) -> Float[np.ndarray, "*batch T p"]:
        """Free run from rest at the equilibrium; physical units in and out."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Everything needed to simulate again; floats read back to the same float64."""


@dataclass(frozen=True, kw_only=True)
class SSM(Simulator):
    """`x+ = A x + B S_u(ut),  y = y_eq + output_scale S_y(C x + D S_u(ut)),  ut = (u - u_eq) / input_scale`.

    Physical units outside, scaled units inside; the scales are pure gains around the recorded equilibrium, so
    `S_u(0) = S_y(0) = 0` keeps the equilibrium an equilibrium. Shapes: `linear` has `scaffold_in.outputs` inputs and
    `scaffold_out.inputs` outputs; `input_scale, input_equilibrium (m,)`, `output_scale, output_equilibrium (p,)`.
    Source: [Z26] eq. (2); THEORY section 2.
    """

    linear: StateSpace
    scaffold_in: Scaffold
    scaffold_out: Scaffold
    input_scale: Float[np.ndarray, "m"]
    output_scale: Float[np.ndarray, "p"]
    input_equilibrium: Float[np.ndarray, "m"]
    output_equilibrium: Float[np.ndarray, "p"]
    step_s: float

    def __post_init__(self) -> None:
        wired = (self.scaffold_in.inputs, self.scaffold_in.outputs, self.scaffold_out.inputs, self.scaffold_out.outputs)
        needed = (len(self.input_scale), self.linear.b.shape[1], self.linear.c.shape[0], len(self.output_scale))
        require(wired == needed, "scaffold_in, scaffold_out", wired, f"the channels must be {needed}", "rewire them")
        gains = bool((self.input_scale > 0).all() and (self.output_scale > 0).all())
        require(gains, "input_scale, output_scale", "not positive", "a scale is a positive gain", "scale again")
        require(self.step_s > 0, "step_s", self.step_s, "the sampling time must be positive", "give it in seconds")

    @property
    def order(self) -> int:
        return self.linear.order

    def lift(self, u: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch mbar"]:
        """`ubar = S_u((u - u_eq) / input_scale)`: physical input to what drives the linear part."""
        return self.scaffold_in((u - self.input_equilibrium) / self.input_scale)

    def advance(
        self, x: Float[np.ndarray, "*batch n"], ubar: Float[np.ndarray, "*batch mbar"]
    ) -> Float[np.ndarray, "*batch n"]:
        """`x+ = A x + B ubar`."""
        return x @ self.linear.a.T + ubar @ self.linear.b.T

    def read(
        self, x: Float[np.ndarray, "*batch n"], ubar: Float[np.ndarray, "*batch mbar"]
    ) -> Float[np.ndarray, "*batch p"]:
        """`y = y_eq + output_scale S_y(C x + D ubar)`, physical."""
        return self.output_equilibrium + self.output_scale * self.read_scaled(x, ubar)

    def read_scaled(
        self, x: Float[np.ndarray, "*batch n"], ubar: Float[np.ndarray, "*batch mbar"]
    ) -> Float[np.ndarray, "*batch p"]:
        """`S_y(C x + D ubar)`, the output in scaled units, as the observer's innovation needs it."""
        return self.scaffold_out(x @ self.linear.c.T + ubar @ self.linear.d.T)

    def simulate(
        self, u: Float[np.ndarray, "*batch T m"], x0: Float[np.ndarray, "*batch n"] | None = None
    ) -> Float[np.ndarray, "*batch T p"]:
        """Free run, step by step, from `x0` (default: rest at the equilibrium); physical units in and out."""
        ybar, _ = self.linear.simulate(self.lift(u), x0)
        return self.output_equilibrium + self.output_scale * self.scaffold_out(ybar)

    def with_linear(self, linear: StateSpace) -> "SSM":
        """The same scaffoldings around another linear part (balanced, truncated)."""
        return replace(self, linear=linear)

    def to_json(self) -> dict[str, Any]:
        """The content of `model.json`; floats read back to the same float64."""
        matrices = {name: getattr(self.linear, name).tolist() for name in ("a", "b", "c", "d")}
        scaffolds = {"scaffold_in": self.scaffold_in.to_json(), "scaffold_out": self.scaffold_out.to_json()}
        return {**matrices, **scaffolds, **{s: getattr(self, s).tolist() for s in _SCALES}, "step_s": self.step_s}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "SSM":
        """Raises `BadRequest` naming the entry that is missing or malformed."""
        for key in ("scaffold_in", "scaffold_out"):
            require(isinstance(data.get(key), Mapping), key, data.get(key), "missing", "write model.json again")
        a, b, c, d = (array_from_json(data, key, 2) for key in ("a", "b", "c", "d"))
        scales = {key: array_from_json(data, key, 1) for key in _SCALES}
        return cls(
            linear=StateSpace(a=a, b=b, c=c, d=d),
            scaffold_in=scaffold_from_json(data["scaffold_in"]),
            scaffold_out=scaffold_from_json(data["scaffold_out"]),
            **scales,
            step_s=float(array_from_json(data, "step_s", 0)),
        )


_SCALES = ("input_scale", "output_scale", "input_equilibrium", "output_equilibrium")
