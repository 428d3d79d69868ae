"""Controllers that close the loop: a law from measured outputs to held inputs, batched over cases.

A controller is a discrete-time system of its own. Its memory is one array `(N, s)`, so a thousand
cases step together and nothing is hidden in an object.
"""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ssm_study.bounds.network import Inverse, inverse_of
from ssm_study.certificates.certificate import Design
from ssm_study.loop.trajectory import (
    Plan,
    Reference,
    feasible_trajectory,
    guided_trajectory,
    set_points,
)
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.systems import Gains, error_input_matrix, frozen_modes

Memory = Float[np.ndarray, "N s"]
Inputs = Float[np.ndarray, "N m"]
Outputs = Float[np.ndarray, "N p"]
Target = Float[np.ndarray, "t"]
Estimate = Float[np.ndarray, "N n"]


class Controller(ABC):
    """`u[k] = input(memory[k], y[k], target[k]),  memory[k+1] = advance(memory[k], u[k], y[k],
    target[k])`.

    `u` and `y` are in physical units. `targets` turns a reference into whatever the law follows at
    each sample, once, before the loop runs. Law: the same memory and measurement give the same
    input, row by row, whatever the batch.
    """

    step_s: float  # the sampling time the law was designed for
    dimensions: tuple[int, int]  # (m, p): inputs it commands, outputs it reads

    def start(self, cases: int) -> Memory:
        """The memory before the first sample; by default there is none."""
        return np.zeros((cases, 0))

    def targets(self, reference: Reference) -> Plan:
        """Signal to follow at each sample; by default the reference itself."""
        return reference

    def demanded(self, reference: Reference) -> Float[np.ndarray, "K m"]:
        """The inputs that hold the reference's extremes, by the law's own reckoning; none if it
        reckons nothing."""
        return np.zeros((0, self.dimensions[0]))

    @abstractmethod
    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """The input to hold over the coming sample."""

    def advance(self, memory: Memory, u: Inputs, y: Outputs, target: Target) -> Memory:
        """The memory at the next sample, given the input that was really applied."""
        return memory

    def estimate(self, memory: Memory) -> Estimate:
        """The part of the memory that estimates the model's state, if any."""
        return memory[:, :0]

    def among(self, stayed: Bool[np.ndarray, "N"]) -> "Controller":
        """The law of the cases that go on; it differs where each case has gains of its own."""
        return self


@dataclass(frozen=True, kw_only=True)
class Uncontrolled(Controller):
    """`u = u_eq`: the plant left alone, which every other law is measured against."""

    u: Float[np.ndarray, "m"]
    step_s: float
    dimensions: tuple[int, int]

    @classmethod
    def of(cls, plant: Plant) -> "Uncontrolled":
        dimensions = len(plant.inputs), len(plant.outputs)
        return cls(u=plant.equilibrium().u, step_s=plant.step_s, dimensions=dimensions)

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        return np.tile(self.u, (len(y), 1))


@dataclass(frozen=True, kw_only=True)
class EstimateFeedback(Controller):
    """A law on an observer's estimate: `xh+ = f(xh, S_u(u)) + L (yh - y) / s_y`, f the model, yh
    its output.

    With neurons `L_z (yh - y) / s_y` is added inside them. `L (n, p)` and `L_z` act in the model's
    scaled units, as `K` does; the memory is as wide as K. The input of sample k does not wait for
    the measurement of sample k. By default the law follows rest points `(x*, u*)`.
    """

    model: Model
    gains: Gains
    inverse: Inverse | None = None  # of S_u, where the law undoes it

    @property
    def step_s(self) -> float:  # type: ignore[override]  # a plain field elsewhere; here the model knows it
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:  # type: ignore[override]  # as step_s
        return self.model.scale.inputs, self.model.scale.outputs

    def start(self, cases: int) -> Memory:
        return np.zeros((cases, self.gains.k.shape[-1]))

    def targets(self, reference: Reference) -> Plan:
        return set_points(self.model, reference)

    def advance(self, memory: Memory, u: Inputs, y: Outputs, target: Target) -> Estimate:
        x_hat = memory[:, : self.model.order]
        lifted = self.model.lift(u)
        innovation = (self.model.read(x_hat, lifted) - y) / self.model.scale.output_scale
        injected = () if self.gains.l_z is None else (times(self.gains.l_z, innovation),)
        return self.model.advance(x_hat, lifted, *injected) + times(self.gains.l, innovation)

    def estimate(self, memory: Memory) -> Estimate:
        return memory  # the estimated state of the model, then the internal model's


@dataclass(frozen=True, kw_only=True)
class ObserverFeedback(EstimateFeedback):
    """`u = u_eq + s_u (u* + K (xh - x*) + K_z z)`, xh the observer's estimate ([Z26] eq. 9 and
    Theorem 3).

    A target row is `(x*, u*, y*)`, a trajectory of the model near the reference. `K (m, n)`, or one
    pair of gains for each case, stacked: such a law brings to rest only. With a wider K there is an
    internal model, `z+ = A_z z + E (y - y*) / s_y`; no error enters it while a limit keeps the
    input from what was asked (`systems.frozen_modes`). With `inverse` the scaled input is
    `S_u^{-1}(S_u(u*) + K ...)` in either law.
    """

    def __post_init__(self) -> None:
        (n, m), p = self.model.linear.b.shape, self.model.scale.outputs
        k = self.gains.k.shape[-2:]
        l_ = self.gains.l.shape[-2:]
        remedy = "use the design made for this model"
        widths = (n, n + p) if self.gains.internal is None else (n + len(self.gains.internal),)
        needed = " or ".join(str((m, width)) for width in widths)
        require(
            k[0] == m and k[1] in widths,
            "k",
            k,
            f"the model needs a gain of shape {needed}",
            remedy,
        )
        require(l_ == (n, p), "l", l_, f"the model needs a gain of shape {(n, p)}", remedy)

    @classmethod
    def of(cls, model: Model, design: Design) -> "ObserverFeedback":
        """The loop of a design; raises `BadRequest` if one of its parts is infeasible."""
        undone = inverse_of(model.scaffold_in.portable()) if design.inverts else None
        return cls(model=model, gains=design.pair, inverse=undone)

    def asked(
        self, u: Float[np.ndarray, "*batch m"], moved: Float[np.ndarray, "*batch m"]
    ) -> np.ndarray:
        """`u* + K (...)`, scaled; or, where `S_u` is undone, `S_u^{-1}(S_u(u*) + K (...))`."""
        return (
            u + moved if self.inverse is None else self.inverse(self.model.scaffold_in(u) + moved)
        )

    def targets(self, reference: Reference) -> Plan:
        n = self.model.order
        if isinstance(self.model, StructuredSSM):
            k = (
                self.gains.k if self.gains.k.ndim == 2 else self.gains.k[0]
            )  # at rest all have the same targets
            plan = guided_trajectory(self.model, k[:, :n], reference, self.asked)
        else:
            plan = feasible_trajectory(self.model, reference)
        return np.concatenate(
            [plan, self.model.read(plan[:, :n], self.model.scaffold_in(plan[:, n:]))], axis=1
        )

    def among(self, stayed: Bool[np.ndarray, "N"]) -> "ObserverFeedback":
        return (
            self
            if self.gains.k.ndim == 2
            else replace(self, gains=self.gains.at(np.flatnonzero(stayed)))
        )

    def demanded(self, reference: Reference) -> Float[np.ndarray, "K m"]:
        ends = np.stack([reference.min(axis=0), reference.max(axis=0)])
        return self.model.scale.physical_input(set_points(self.model, ends)[:, self.model.order :])

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        n = self.model.order
        m = self.model.scale.inputs
        error = np.concatenate(
            [memory[:, :n] - target[:n], memory[:, n:]], axis=1
        )  # the internal model aims at zero
        u = np.broadcast_to(target[n : n + m], (len(error), m))
        return self.model.scale.physical_input(self.asked(u, times(self.gains.k, error)))

    def advance(self, memory: Memory, u: Inputs, y: Outputs, target: Target) -> Memory:
        x_hat = super().advance(memory, u, y, target)
        z = memory[:, self.model.order :]
        modes = self.gains.modes
        if not len(modes):
            return x_hat
        free = np.isclose(u, self.input(memory, y, target), rtol=1e-9, atol=1e-12).all(
            axis=1, keepdims=True
        )
        error = (y - target[-y.shape[1] :]) / self.model.scale.output_scale
        p = y.shape[1]
        z = np.where(
            free, z @ modes.T + error @ error_input_matrix(modes, p).T, z @ frozen_modes(modes).T
        )
        return np.concatenate([x_hat, z], axis=1)


def times(
    gain: Float[np.ndarray, "*cases r c"], rows: Float[np.ndarray, "N c"]
) -> Float[np.ndarray, "N r"]:
    """One gain for all rows, or one for each."""
    return rows @ gain.T if gain.ndim == 2 else np.einsum("nij,nj->ni", gain, rows)
