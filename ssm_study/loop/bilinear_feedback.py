"""Controller for a plant with a bilinear model, and the bilinear model as a simulated plant."""

# ruff: noqa: ARG002 - every law gets all arguments; this one needs less
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ssm_study.loop.controller import (
    Controller,
    Estimate,
    Inputs,
    Measured,
    Memory,
    Outputs,
    Target,
)
from ssm_study.models.bilinear import Bilinear
from ssm_study.plants.plant import Disturbances, Equilibrium, Plant, States
from ssm_study.refusal import require
from ssm_study.signals import Channel

Correction = Float[np.ndarray, "N q n"] | float
Channels = tuple[Channel, ...]
SETTLED = 0.05  # of an output scale from the equilibrium


@dataclass(frozen=True, kw_only=True)
class BilinearFeedback(Controller):
    """State feedback with observer for a bilinear model, with limits on the input. `v = K xh`, `xh+
    = sum_i theta_i(v) (A_i xh + b_i + L_i (C xh - w))`, v and w scaled.

    Shapes: `k (1, n)`, `l_nodes (q, n, p)`. The observer takes the input that was applied.
    """

    model: Bilinear
    k: Float[np.ndarray, "m n"]
    l_nodes: Float[np.ndarray, "q n p"]

    def __post_init__(self) -> None:
        n = self.model.order
        q = len(self.model.nodes)
        p = len(self.model.c)
        gain_shape = self.k.shape
        observer_shape = self.l_nodes.shape
        shape = (gain_shape, observer_shape)
        needed = ((1, n), (q, n, p))
        problem = f"the model needs gains of shape {needed}"
        require(shape == needed, "k, l_nodes", shape, problem, "use the design of this model")

    @property
    def step_s(self) -> float:  # type: ignore[override]  # here the model knows it
        """Sampling time of the controller's model, in seconds."""
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:  # type: ignore[override]  # as step_s
        """Numbers of inputs and outputs of the controller's model."""
        return 1, len(self.model.c)

    def initial_memory(self, cases: int) -> Memory:
        """Zero state estimates of the observer before the first sample."""
        order = self.model.order
        return np.zeros((cases, order))

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """Input computed from the state estimate, saturated at the outermost input levels of the
        bilinear model."""
        nodes = self.model.nodes
        unlimited = memory @ self.k.T
        largest_node = nodes[-1]
        scaled = np.clip(unlimited, nodes[0], largest_node)
        return self.model.scale.physical_input(scaled)

    def next_memory(
        self, memory: Memory, u: Inputs, y: Outputs, target: Target, d: Measured = None
    ) -> Memory:
        """Next state estimate of the observer, computed from the applied input and the measured
        output."""
        model = self.model
        predicted = memory @ model.c.T
        innovation = predicted - model.scale.scaled_output(y)
        correction = np.einsum("qnp,Np->Nqn", self.l_nodes, innovation)
        return advance_bilinear_states(model, memory, u, correction)

    def estimate(self, memory: Memory) -> Estimate:
        """State estimate of the observer, which is all that a bilinear controller stores between
        samples."""
        return memory


def advance_bilinear_states(
    model: Bilinear, states: Estimate, inputs: Inputs, corrections: Correction = 0.0
) -> Estimate:
    """Next states of a bilinear model for several simulations at once, with a correction added at
    each node (input level)."""
    at_nodes = np.einsum("qij,Nj->Nqi", model.a, states)
    at_nodes = at_nodes + model.b
    at_nodes = at_nodes + corrections
    hats = model.hat_values(inputs)
    return np.einsum("Nq,Nqi->Ni", hats, at_nodes)


@dataclass(frozen=True, kw_only=True)
class BilinearPlant(Plant):
    """Bilinear model that is simulated in place of a plant. Its states are scaled; `d` is added to
    them."""

    model: Bilinear
    step_s: float
    settling_band: float
    inputs: Channels = ()
    outputs: Channels = ()
    states: Channels = ()
    disturbances: Channels = ()
    initial_range: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_model(cls, model: Bilinear, inputs: Channels, outputs: Channels) -> "BilinearPlant":
        """Simulated plant that behaves exactly as an identified bilinear model."""
        output_scales = model.scale.output_scale
        unit = float(output_scales.min())
        names = [f"x_{i + 1}" for i in range(model.order)]
        states = tuple(Channel(name=name, unit="") for name in names)
        band = SETTLED * unit
        plant = cls(model=model, step_s=model.step_s, settling_band=band)
        plant = replace(plant, inputs=inputs, outputs=outputs)
        initial_range = (-unit, unit)
        return replace(plant, states=states, disturbances=states, initial_range=initial_range)

    def equilibrium(self) -> Equilibrium:
        """Equilibrium of the bilinear model in physical units."""
        scale = self.model.scale
        x = np.zeros(self.model.order)
        return Equilibrium(u=scale.input_equilibrium, x=x, y=scale.output_equilibrium)

    def equilibrium_states(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N n"]:
        """States of least norm at which a bilinear model has given outputs."""
        scaled = self.model.scale.scaled_output(y0)
        inverse_output_map = np.linalg.pinv(self.model.c)
        return scaled @ inverse_output_map.T

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        """Next states of the bilinear model, with disturbances added."""
        advanced = advance_bilinear_states(self.model, x, u)
        return advanced + d

    def output(self, x: States) -> Outputs:
        """Outputs of the bilinear model in physical units."""
        scaled_output = x @ self.model.c.T
        return self.model.scale.physical_output(scaled_output)
