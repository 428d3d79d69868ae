"""What closes the loop: a law from measured outputs to held inputs, batched over cases.

A controller is a discrete-time system of its own. Its memory is one array `(N, s)`, so a thousand cases step together
and nothing is hidden in an object.
"""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.loop.trajectory import feasible_trajectory
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback


class Controller(ABC):
    """`u[k] = input(memory[k], y[k], target[k]),  memory[k+1] = advance(memory[k], u[k], y[k], target[k])`.

    `u` and `y` are in physical units. `targets` turns a reference into whatever the law follows at each sample, once,
    before the loop runs. Law: the same memory and measurement give the same input, row by row, whatever the batch.
    """

    @property
    @abstractmethod
    def step_s(self) -> float:
        """The sampling time the law was designed for."""

    @property
    @abstractmethod
    def dimensions(self) -> tuple[int, int]:
        """`(m, p)`: inputs it commands, outputs it reads."""

    @abstractmethod
    def start(self, cases: int) -> Float[np.ndarray, "N s"]:
        """The memory before the first sample."""

    def targets(self, reference: Float[np.ndarray, "T p"]) -> Float[np.ndarray, "T t"]:
        """What is followed at each sample; by default the reference itself."""
        return reference

    def demanded(self, targets: Float[np.ndarray, "T t"]) -> Float[np.ndarray, "K m"]:
        """The inputs that following the targets takes, by the law's own reckoning; none if it reckons nothing."""
        return np.zeros((0, self.dimensions[0]))

    @abstractmethod
    def input(
        self, memory: Float[np.ndarray, "N s"], y: Float[np.ndarray, "N p"], target: Float[np.ndarray, "t"]
    ) -> Float[np.ndarray, "N m"]:
        """The input to hold over the coming sample."""

    @abstractmethod
    def advance(
        self,
        memory: Float[np.ndarray, "N s"],
        u: Float[np.ndarray, "N m"],
        y: Float[np.ndarray, "N p"],
        target: Float[np.ndarray, "t"],
    ) -> Float[np.ndarray, "N s"]:
        """The memory at the next sample, given the input that was really applied."""

    def estimate(self, memory: Float[np.ndarray, "N s"]) -> Float[np.ndarray, "N n"]:
        """The part of the memory that estimates the model's state, if any."""
        return memory[:, :0]


@dataclass(frozen=True, kw_only=True)
class Uncontrolled(Controller):
    """`u = u_eq`: the plant left alone, which every other law is measured against."""

    plant: Plant

    @property
    def step_s(self) -> float:
        return self.plant.step_s

    @property
    def dimensions(self) -> tuple[int, int]:
        return len(self.plant.inputs), len(self.plant.outputs)

    def start(self, cases: int) -> Float[np.ndarray, "N s"]:
        return np.zeros((cases, 0))

    def input(
        self, memory: Float[np.ndarray, "N s"], y: Float[np.ndarray, "N p"], target: Float[np.ndarray, "t"]
    ) -> Float[np.ndarray, "N m"]:
        return np.tile(self.plant.equilibrium().u, (len(y), 1))

    def advance(
        self,
        memory: Float[np.ndarray, "N s"],
        u: Float[np.ndarray, "N m"],
        y: Float[np.ndarray, "N p"],
        target: Float[np.ndarray, "t"],
    ) -> Float[np.ndarray, "N s"]:
        return memory


@dataclass(frozen=True, kw_only=True)
class ObserverFeedback(Controller):
    """`u = u_eq + s_u (u* + K (xh - x*)),  xh+ = A xh + B S_u(u) + L (yh - y) / s_y`  ([Z26] eq. 9 and Theorem 3).

    `K (m, n)` and `L (n, p)` act in the model's scaled units. `xh[k]` predicts from `y` up to sample k-1, so the input
    of sample k does not wait for the measurement of sample k. A target row is `(x*, u*, y*)`, a trajectory of the
    model itself near the reference: around any such trajectory the certified loop contracts.

    With `K (m, n + p)` the law has integral action: `u = u_eq + s_u (u* + K_x (xh - x*) + K_z z)`,
    `z+ = z + (y - y*) / s_y`. So that it does not wind up, z is held while a limit keeps the input from what was asked.
    """

    model: SSM
    k: Float[np.ndarray, "m s"]
    l: Float[np.ndarray, "n p"]  # noqa: E741 - the paper's letter

    def __post_init__(self) -> None:
        (n, m), p = self.model.linear.b.shape, len(self.model.output_scale)
        remedy = "use the design made for this model"
        fits = self.k.shape in ((m, n), (m, n + p))
        require(fits, "k", self.k.shape, f"the model needs a gain of shape {(m, n)} or {(m, n + p)}", remedy)
        require(self.l.shape == (n, p), "l", self.l.shape, f"the model needs a gain of shape {(n, p)}", remedy)

    @classmethod
    def of(cls, model: SSM, design: Design) -> "ObserverFeedback":
        """The loop of a design; raises `BadRequest` if one of its parts is infeasible."""
        feedback, observer = parts(design)
        return cls(model=model, k=feedback.k, l=observer.l)

    @property
    def step_s(self) -> float:
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:
        return len(self.model.input_scale), len(self.model.output_scale)

    def start(self, cases: int) -> Float[np.ndarray, "N s"]:
        return np.zeros((cases, self.k.shape[1]))

    def targets(self, reference: Float[np.ndarray, "T p"]) -> Float[np.ndarray, "T t"]:
        plan, n = feasible_trajectory(self.model, reference), self.model.order
        planned = self.model.read(plan[:, :n], self.model.scaffold_in(plan[:, n:]))
        return np.concatenate([plan, planned], axis=1)

    def demanded(self, targets: Float[np.ndarray, "T t"]) -> Float[np.ndarray, "K m"]:
        scaled = targets[:, self.model.order :][:, : len(self.k)]
        return self.model.input_equilibrium + self.model.input_scale * scaled

    def input(
        self, memory: Float[np.ndarray, "N s"], y: Float[np.ndarray, "N p"], target: Float[np.ndarray, "t"]
    ) -> Float[np.ndarray, "N m"]:
        n, m = self.model.order, len(self.k)
        error = np.concatenate([memory[:, :n] - target[:n], memory[:, n:]], axis=1)
        scaled = target[n : n + m] + error @ self.k.T
        return self.model.input_equilibrium + self.model.input_scale * scaled

    def advance(
        self,
        memory: Float[np.ndarray, "N s"],
        u: Float[np.ndarray, "N m"],
        y: Float[np.ndarray, "N p"],
        target: Float[np.ndarray, "t"],
    ) -> Float[np.ndarray, "N s"]:
        n, p = self.model.order, y.shape[1]
        x_hat = observe(self.model, self.l, memory[:, :n], u, y)
        if self.k.shape[1] == n:
            return x_hat
        free = np.isclose(u, self.input(memory, y, target), rtol=1e-9, atol=1e-12).all(axis=1, keepdims=True)
        error = (y - target[-p:]) / self.model.output_scale
        return np.concatenate([x_hat, memory[:, n:] + np.where(free, error, 0.0)], axis=1)

    def estimate(self, memory: Float[np.ndarray, "N s"]) -> Float[np.ndarray, "N n"]:
        """The estimated state of the model, then the integrators, if any."""
        return memory


def parts(design: Design) -> tuple[StateFeedback, Observer]:
    """Controller and observer of a feasible design; raises `BadRequest` with the reason for any other."""
    for name, part in (("state_feedback", design.state_feedback), ("observer", design.observer)):
        if isinstance(part, Infeasible):
            raise BadRequest(f"design.{name}", "infeasible", part.reason, "close no loop with it")
    return design.state_feedback, design.observer  # type: ignore[return-value]  # Infeasible has just been refused


def observe(
    model: SSM,
    l: Float[np.ndarray, "n p"],  # noqa: E741 - the paper's letter
    x_hat: Float[np.ndarray, "N n"],
    u: Float[np.ndarray, "N m"],
    y: Float[np.ndarray, "N p"],
) -> Float[np.ndarray, "N n"]:
    """`xh+ = A xh + B S_u(u) + L (yh - y) / s_y,  yh = S_y(C xh + D S_u(u))` with `u`, `y` in physical units."""
    lifted = model.lift(u)
    innovation = (model.read(x_hat, lifted) - y) / model.output_scale
    return x_hat @ model.linear.a.T + lifted @ model.linear.b.T + innovation @ l.T
