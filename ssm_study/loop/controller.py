"""Controllers that compute inputs from measured outputs, for many parallel simulations at once.

A controller is a discrete-time system of its own. Its memory is one array `(N, s)`, so a thousand
cases step together and nothing is hidden in an object.
"""

# ruff: noqa: ARG002 - every law gets all arguments; some need less
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float

from ssm_study.certificates.certificate import Design
from ssm_study.loop.trajectory import (
    Plan,
    Reference,
    feedback_trajectory,
    reference_tracking_trajectory,
    set_point_equilibria,
)
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.systems import Gains, error_input_matrix, stopped_integrator_matrix

Memory = Float[np.ndarray, "N s"]
Inputs = Float[np.ndarray, "N m"]
Outputs = Float[np.ndarray, "N p"]
Target = Float[np.ndarray, "t"]
Estimate = Float[np.ndarray, "N n"]
Measured = Float[np.ndarray, "k"] | None


class Controller(ABC):
    """Interface of control laws that compute inputs from measured outputs, with a memory that is
    updated at every sample.

    `u[k] = input(memory[k], y[k], target[k])`, `memory[k+1] = next_memory(memory[k], u[k], y[k],
    target[k])`. `u` and `y` are in physical units. `target_trajectory` turns a reference into
    whatever the law follows at each sample, once, before the loop runs. Law: the same memory and
    measurement give the same input, row by row, whatever the batch.
    """

    step_s: float  # the sampling time the law was designed for
    dimensions: tuple[int, int]  # (m, p): inputs it commands, outputs it reads

    def initial_memory(self, cases: int) -> Memory:
        """Memory of a controller before the first sample, one row for each parallel simulation."""
        return np.zeros((cases, 0))

    def target_trajectory(self, reference: Reference) -> Plan:
        """Target that a control law follows at each sample, computed before the loop runs from the
        whole reference. Unless overridden it is the reference itself."""
        return reference

    def required_inputs(self, reference: Reference) -> Float[np.ndarray, "K m"]:
        """Inputs with which a control law holds the smallest and the largest value of the
        reference; empty if they are unknown."""
        return np.zeros((0, self.dimensions[0]))

    @abstractmethod
    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """Input that a control law applies over the coming sample."""

    def next_memory(
        self, memory: Memory, u: Inputs, y: Outputs, target: Target, d: Measured = None
    ) -> Memory:
        """Memory of a controller at the next sample, such as its state estimate. `d` None stands
        for disturbances at their equilibrium."""
        return memory

    def estimate(self, memory: Memory) -> Estimate:
        """Estimate of the model's state in a controller's memory; empty for a controller without an
        observer."""
        return memory[:, :0]

    def select_cases(self, is_selected: Bool[np.ndarray, "N"]) -> "Controller":
        """Copy of a controller for only some of the parallel simulations."""
        return self


@dataclass(frozen=True, kw_only=True)
class NoControl(Controller):
    """Control law that always applies the equilibrium input, for comparison with other control
    laws."""

    u: Float[np.ndarray, "m"]
    step_s: float
    dimensions: tuple[int, int]

    @classmethod
    def for_plant(cls, plant: Plant) -> "NoControl":
        """Control law that always applies a plant's equilibrium input."""
        rest = plant.equilibrium()
        input_count = len(plant.inputs)
        output_count = len(plant.outputs)
        dimensions = (input_count, output_count)
        return cls(u=rest.u, step_s=plant.step_s, dimensions=dimensions)

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """Equilibrium input for every parallel simulation."""
        case_count = len(y)
        return np.tile(self.u, (case_count, 1))


@dataclass(frozen=True, kw_only=True)
class EstimateFeedback(Controller):
    """Base class of control laws that use an observer's estimate of the model's state.

    `xh+ = f(xh, S_u(u)) + L (yh - y) / s_y`, f the model, yh its output. Measured disturbances push
    the estimate as they push the model. With neurons `L_z (yh - y) / s_y` is added inside them. `L
    (n, p)` and `L_z` act in the model's scaled units, as `K` does; the memory is as wide as K. The
    input of sample k does not wait for the measurement of sample k. By default the law follows
    equilibria `(x*, u*)`.
    """

    model: Model
    gains: Gains

    @property
    def step_s(self) -> float:  # type: ignore[override]  # here the model knows it
        """Sampling time of the controller's model, in seconds."""
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:  # type: ignore[override]  # as step_s
        """Numbers of inputs and of outputs of the controller's model."""
        inputs = self.model.scale.inputs
        return inputs, self.model.scale.outputs

    def initial_memory(self, cases: int) -> Memory:
        """Zero states of observer and internal model before the first sample."""
        gains_k = self.gains.k
        gain_width = gains_k.shape[-1]
        return np.zeros((cases, gain_width))

    def target_trajectory(self, reference: Reference) -> Plan:
        """Equilibrium states and inputs of the model that hold the reference at each sample."""
        return set_point_equilibria(self.model, reference)

    def next_memory(
        self, memory: Memory, u: Inputs, y: Outputs, target: Target, d: Measured = None
    ) -> Estimate:
        """Next state estimate of the observer, computed from the applied input and the measured
        output."""
        model = self.model
        gains = self.gains
        x_hat = memory[:, : model.order]
        lifted = model.map_input(u)
        predicted_output = model.output_at(x_hat, lifted)
        output_scale = model.scale.output_scale
        innovation = (predicted_output - y) / output_scale
        correction = multiply_rows(gains.l, innovation)
        if d is not None:
            correction = correction + model.disturbance_contribution(d)
        if gains.l_z is None:
            return model.next_state(x_hat, lifted) + correction
        neurons = cast(StructuredSSM, model)  # only its observer has a gain into the neurons
        neuron_correction = multiply_rows(gains.l_z, innovation)
        return neurons.next_state(x_hat, lifted, neuron_correction) + correction

    def estimate(self, memory: Memory) -> Estimate:
        """Estimate of the model's state, taken from the controller's memory."""
        return memory  # the estimated state of the model, then the internal model's


@dataclass(frozen=True, kw_only=True)
class ObserverFeedback(EstimateFeedback):
    """Feedback of an observer's state estimate around a trajectory of the model.

    `u = u_eq + s_u (u* + K (xh - x*) + K_z z)`, xh the estimate ([Z26] eq. 9 and Theorem 3). A
    target row is `(x*, u*, y*)`, a trajectory of the model near the reference. `K (m, n)`, or one
    pair of gains for each case, stacked: such a law brings to rest only. With a wider K there is an
    internal model, `z+ = A_z z + E (y - y*) / s_y`; no error enters it while a limit keeps the
    input from what was asked (`systems.stopped_integrator_matrix`).
    """

    def __post_init__(self) -> None:
        linear_b = self.model.linear.b
        n, m = linear_b.shape
        p = self.model.scale.outputs
        gains_k = self.gains.k
        k_shape = gains_k.shape[-2:]
        gains_l = self.gains.l
        l_shape = gains_l.shape[-2:]
        remedy = "use the design made for this model"
        internal = self.gains.internal
        widths = (n, n + p) if internal is None else (n + len(internal),)
        width_texts = (str((m, width)) for width in widths)
        needed = " or ".join(width_texts)
        fits = k_shape[0] == m and k_shape[1] in widths
        require(fits, "k", k_shape, f"the model needs a gain of shape {needed}", remedy)
        problem = f"the model needs a gain of shape {(n, p)}"
        needed_shape = (n, p)
        require(l_shape == needed_shape, "l", l_shape, problem, remedy)

    @classmethod
    def from_design(cls, model: Model, design: Design) -> "ObserverFeedback":
        """Controller that applies the gains of a certified design. Raises `BadRequest` if one of
        its parts is infeasible."""
        return cls(model=model, gains=design.gain_pair)

    def target_trajectory(self, reference: Reference) -> Plan:
        """Trajectory of the model's states, inputs and outputs whose output follows the
        reference."""
        model = self.model
        n = model.order
        if isinstance(model, StructuredSSM):
            # At rest all cases have the same targets, whatever their gains.
            ndim = self.gains.k.ndim
            k = self.gains.k if ndim == 2 else self.gains.k[0]
            state_gains = k[:, :n]
            plan = feedback_trajectory(model, state_gains, reference)
        else:
            plan = reference_tracking_trajectory(model, reference)
        planned_inputs = plan[:, n:]
        lifted = model.scaffold_in(planned_inputs)
        planned_states = plan[:, :n]
        outputs = model.output_at(planned_states, lifted)
        plan_with_outputs = [plan, outputs]
        return np.concatenate(plan_with_outputs, axis=1)

    def select_cases(self, is_selected: Bool[np.ndarray, "N"]) -> "ObserverFeedback":
        """Copy of the controller with the gains of only some of the parallel simulations."""
        if self.gains.k.ndim == 2:
            return self
        indices = np.flatnonzero(is_selected)
        gains = self.gains.select_pairs(indices)
        return replace(self, gains=gains)

    def required_inputs(self, reference: Reference) -> Float[np.ndarray, "K m"]:
        """Inputs at which the model holds the smallest and the largest value of the reference."""
        lowest = reference.min(axis=0)
        highest = reference.max(axis=0)
        ends = np.stack([lowest, highest])
        plan = set_point_equilibria(self.model, ends)
        order = self.model.order
        inputs = plan[:, order:]
        return self.model.scale.physical_input(inputs)

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        """Input computed from the state estimate and the internal model, around the planned
        trajectory."""
        n = self.model.order
        m = self.model.scale.inputs
        estimated_states = memory[:, :n]
        target_states = target[:n]
        estimation_error = estimated_states - target_states
        internal_states = memory[:, n:]  # the internal model aims at zero
        error = np.concatenate([estimation_error, internal_states], axis=1)
        target_input = target[n : n + m]
        input_shape = (len(error), m)
        u = np.broadcast_to(target_input, input_shape)
        feedback = multiply_rows(self.gains.k, error)
        unlimited_u = u + feedback
        return self.model.scale.physical_input(unlimited_u)

    def next_memory(
        self, memory: Memory, u: Inputs, y: Outputs, target: Target, d: Measured = None
    ) -> Memory:
        """Next states of observer and internal model, computed from the applied input and the
        measured output."""
        x_hat = super().next_memory(memory, u, y, target, d)
        order = self.model.order
        z = memory[:, order:]
        modes = self.gains.modes
        if not len(modes):
            return x_hat
        unlimited_u = self.input(memory, y, target)
        as_asked = np.isclose(u, unlimited_u, rtol=1e-9, atol=1e-12)
        unlimited = as_asked.all(axis=1, keepdims=True)
        p = y.shape[1]
        output_scale = self.model.scale.output_scale
        output_error = y - target[-p:]
        error = output_error / output_scale
        error_matrix = error_input_matrix(modes, p).T
        driven = z @ modes.T + error @ error_matrix
        frozen = z @ stopped_integrator_matrix(modes).T
        z = np.where(unlimited, driven, frozen)
        whole_memory = [x_hat, z]
        return np.concatenate(whole_memory, axis=1)


def multiply_rows(
    gain: Float[np.ndarray, "*cases r c"], rows: Float[np.ndarray, "N c"]
) -> Float[np.ndarray, "N r"]:
    """Product of a gain matrix with each row of an array. There may be one gain for all rows, or
    one for each."""
    if gain.ndim == 2:
        return rows @ gain.T
    return np.einsum("nij,nj->ni", gain, rows)
