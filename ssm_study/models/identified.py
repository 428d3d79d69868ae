"""Identified models given by explicit numbers, so that they can be stored, simulated, certified and
deployed. No torch here."""

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.slopes import jacobian_ball
from ssm_study.family import Family
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.scaffold import JsonDataclass, Scaffold
from ssm_study.refusal import require, require_positive
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace, System

LARGEST_CONDITION = 1e8  # of a matrix that is moved from a static map into the linear part
Inputs = Float[np.ndarray, "*batch T m"]
Outputs = Float[np.ndarray, "*batch T p"]
Measured = Float[np.ndarray, "*batch S p"]
State = Float[np.ndarray, "*batch n"]
MappedInput = Float[np.ndarray, "*batch mbar"]


class Simulator(Family, JsonDataclass):
    """Interface of identified models, which can be simulated and stored without torch. `names` are
    their kinds."""

    @abstractmethod
    def simulate(self, u: Inputs) -> Outputs:
        """Simulate an identified model in free run from its equilibrium. Inputs and outputs are in
        physical units."""

    def simulate_from_outputs(self, u: Inputs, y_start: Measured) -> Outputs:  # noqa: ARG002
        """Simulate an identified model in free run, continuing a given stretch of measured outputs.
        A model that cannot use them starts at the equilibrium."""
        return self.simulate(u)


class ScaffoldedModel(Simulator):
    """Base class of identified models in which a recurrence stands between a static input map and a
    static output map. `y = y_eq + output_scale S_y(ybar)`, ybar the output of a recurrence driven
    by `S_u((u - u_eq) / input_scale)`.

    Physical units outside, scaled units inside (`signals.Scale`).
    """

    scaffold_in: Scaffold
    scaffold_out: Scaffold
    scale: Scale
    step_s: float
    linear: StateSpace
    b_d: Float[np.ndarray, "_ _"]

    def check_dimensions(self) -> None:
        """Raise `BadRequest` unless the dimensions of a model's static maps, recurrence and signals
        agree."""
        shape = (self.linear.order, self.scale.disturbances) if self.scale.disturbances else (0, 0)
        problem = f"the model needs a matrix of shape {shape}"
        stored_shape = self.b_d.shape
        require(stored_shape == shape, "b_d", self.b_d.shape, problem, "write model.json again")
        input_shape = self.scaffold_in.shape
        output_shape = self.scaffold_out.shape
        wired = (*input_shape[::-1], *output_shape[::-1])
        mapped_inputs = self.linear.b.shape[1]
        unmapped_outputs = len(self.linear.c)
        input_count = self.scale.inputs
        output_count = self.scale.outputs
        needed = (input_count, mapped_inputs, unmapped_outputs, output_count)
        name = "scaffold_in, scaffold_out"
        problem = f"the inputs and outputs of the two maps must be {needed}"
        require(wired == needed, name, wired, problem, "write model.json again")
        require_positive("step_s", self.step_s, "give it in seconds")

    @property
    def order(self) -> int:
        """Number of states of a model."""
        return self.linear.order

    @property
    def system(self) -> System:
        """State-space system of a model without its static maps, to which certificates refer."""
        return self.linear

    def map_input(self, u: Float[np.ndarray, "*batch m"]) -> MappedInput:
        """Apply the static input map of a model to an input in physical units. `ubar = S_u((u -
        u_eq) / input_scale)` drives the recurrence."""
        scaled_input = self.scale.scaled_input(u)
        return self.scaffold_in(scaled_input)

    def driving_signals(
        self, u: Float[np.ndarray, "*batch T m"], d: Float[np.ndarray, "*batch T k"] | None
    ) -> Float[np.ndarray, "*batch T j"]:
        """Signals that drive a model's recurrence: the input after the static map, and scaled
        measured disturbances. Disturbances that are not given stay at their equilibrium; the
        signals are what `simulate_recurrence` takes."""
        lifted = self.map_input(u)
        if not self.scale.disturbances:
            return lifted
        at_equilibrium = np.zeros((*u.shape[:-1], self.scale.disturbances))
        scaled = at_equilibrium if d is None else self.scale.scaled_disturbance(d)
        all_signals = [lifted, scaled]
        return np.concatenate(all_signals, axis=-1)

    def disturbance_contribution(
        self, d: Float[np.ndarray, "*batch k"]
    ) -> Float[np.ndarray, "*batch n"]:
        """Contribution of measured disturbances to a model's next state.

        No state and no input enters it, so it cancels where two motions under the same d are
        subtracted (docs/theory.md, "Measured disturbances").
        """
        scaled_disturbance = self.scale.scaled_disturbance(d)
        return scaled_disturbance @ self.b_d.T

    @property
    def system_with_disturbances(self) -> StateSpace:
        """Linear system whose inputs are a model's inputs after the static input map and its
        measured disturbances."""
        linear = self.linear
        if not self.scale.disturbances:
            return linear
        no_feedthrough = (len(linear.c), self.scale.disturbances)
        through = np.zeros(no_feedthrough)
        input_columns = [linear.b, self.b_d]
        b = np.hstack(input_columns)
        feedthrough_columns = [linear.d, through]
        d = np.hstack(feedthrough_columns)
        return StateSpace(a=linear.a, b=b, c=linear.c, d=d)

    @abstractmethod
    def next_state(self, x: State, ubar: MappedInput) -> State:
        """State of a model one sample later, for an input after the static input map."""

    def output_at(self, x: State, ubar: MappedInput) -> Float[np.ndarray, "*batch p"]:
        """Output of a model in physical units for a state and an input after the static input map.
        `y = y_eq + output_scale S_y(ybar)`."""
        scaled_output = self.scaled_output_at(x, ubar)
        return self.scale.physical_output(scaled_output)

    @abstractmethod
    def scaled_output_at(self, x: State, ubar: MappedInput) -> Float[np.ndarray, "*batch p"]:
        """Output of a model in scaled units for a state and an input after the static input map.
        `S_y(ybar)`, which the observer's innovation needs."""

    @abstractmethod
    def simulate_recurrence(
        self, ubar: Float[np.ndarray, "*batch T mbar"], x0: State | None = None
    ) -> tuple[Outputs, np.ndarray]:
        """Simulate a model's recurrence without its static maps, for inputs after the static input
        map. `ybar` from `x0` (default 0), with the last state or all of them. `ubar` is what
        `map_input` or `driving_signals` returns."""

    def simulate(
        self, u: Inputs, x0: State | None = None, d: Float[np.ndarray, "*batch T k"] | None = None
    ) -> Outputs:
        """Simulate a model in free run, in physical units, from a given state or from the
        equilibrium. Inputs and outputs are in physical units.

        Measured disturbances that are not given stay at their equilibrium.
        """
        signals = self.driving_signals(u, d)
        ybar = self.simulate_recurrence(signals, x0)[0]
        scaled_output = self.scaffold_out(ybar)
        return self.scale.physical_output(scaled_output)


@dataclass(frozen=True, kw_only=True)
class DelayLine:
    """Delay line that adds a dead time to a model by states that store past inputs. They hold the
    inputs of the last samples, the newest first, behind the `states` of the model."""

    states: int
    channels: int
    samples: int

    @property
    def state_count(self) -> int:
        """Number of states that a delay line adds to a model."""
        return self.samples * self.channels

    def state_matrix(
        self, a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]
    ) -> Float[np.ndarray, "N N"]:
        """State matrix of a model that is extended by a delay line at its input. The oldest input
        drives the model by B."""
        n = self.states
        size = n + self.state_count
        whole = np.zeros((size, size))
        whole[:n, :n] = a
        whole[:n, size - self.channels :] = b
        shifted = self.state_count - self.channels
        whole[n + self.channels :, n : n + shifted] = np.eye(shifted)
        return whole

    def input_matrix(self) -> Float[np.ndarray, "N m"]:
        """Input matrix of a model that is extended by a delay line at its input. The input only
        enters the line."""
        all_states = self.states + self.state_count
        return np.eye(all_states, self.channels, -self.states)

    def append_delay_columns(
        self, of_state: Float[np.ndarray, "k n"], of_input: Float[np.ndarray, "k m"]
    ) -> Float[np.ndarray, "k N"]:
        """Extend a matrix that acts on state and input so that it acts on the state with the delay
        line."""
        delayed_shape = (len(of_state), self.state_count - self.channels)
        newer = np.zeros(delayed_shape)
        columns = [of_state, newer, of_input]
        return np.hstack(columns)

    def append_delay_rows(
        self, of_disturbance: Float[np.ndarray, "_ k"]
    ) -> Float[np.ndarray, "_ k"]:
        """Extend the disturbance matrix of a model by zero rows for the states of the delay
        line."""
        channels = of_disturbance.shape[1]
        waiting = self.state_count if channels else 0
        delay_rows = np.zeros((waiting, channels))
        return np.vstack([of_disturbance, delay_rows])


@dataclass(frozen=True, kw_only=True)
class SSM(ScaffoldedModel):
    """Identified model: a linear recurrence between a static input map and a static output map. `x+
    = A x + B S_u(ut), y = y_eq + output_scale S_y(C x + D S_u(ut)), ut = (u - u_eq) / input_scale`.

    Shapes: `linear` has `scaffold_in.outputs` inputs and `scaffold_out.inputs` outputs. With k
    measured disturbances `x+` has the further term `b_d (d - d_eq) / d_scale`, `b_d (n, k)`.
    Source: [Z26] eq. (2).
    """

    linear: StateSpace
    scaffold_in: Scaffold
    scaffold_out: Scaffold
    scale: Scale
    step_s: float
    b_d: Float[np.ndarray, "_ _"] = field(default_factory=partial(np.zeros, (0, 0)))

    def __post_init__(self) -> None:
        self.check_dimensions()

    @classmethod
    def from_linear(cls, linear: StateSpace, step_s: float, scale: Scale | None = None) -> "SSM":
        """Make a model of a linear state-space system, with identities as static maps. Signals are
        scaled by one around zero unless `scale` is given."""
        m = linear.b.shape[1]
        p = len(linear.c)
        inward = LinearScaffold.identity(m)
        outward = LinearScaffold.identity(p)
        scale = scale or Scale.identity(m, p)
        return cls(
            linear=linear, scaffold_in=inward, scaffold_out=outward, scale=scale, step_s=step_s
        )

    def next_state(self, x: State, ubar: MappedInput) -> State:
        """State of the linear recurrence one sample later, `x+ = A x + B ubar`."""
        free_motion = x @ self.linear.a.T
        driven_motion = ubar @ self.linear.b.T
        return free_motion + driven_motion

    def scaled_output_at(self, x: State, ubar: MappedInput) -> Float[np.ndarray, "*batch p"]:
        """Scaled output `S_y(C x + D ubar)`: the output map `S_y`, applied to the linear
        recurrence's output."""
        from_state = x @ self.linear.c.T
        from_input = ubar @ self.linear.d.T
        return self.scaffold_out(from_state + from_input)

    def simulate_recurrence(
        self, ubar: Float[np.ndarray, "*batch T mbar"], x0: State | None = None
    ) -> tuple[Outputs, State]:
        """Simulate the linear recurrence without the static maps, and return its output and its
        last state. The last state is returned, too."""
        input_count = self.linear.b.shape[1]
        lifted = ubar.shape[-1] == input_count
        system = self.linear if lifted else self.system_with_disturbances
        return system.simulate(ubar, x0)

    def with_linear_part(self, linear: StateSpace) -> "SSM":
        """Copy of the model with another linear recurrence `(A, B, C, D)` of the same order."""
        return replace(self, linear=linear)

    def with_system_and_disturbances(self, system: StateSpace) -> "SSM":
        """Copy of the model with another linear recurrence, of any order, including the disturbance
        inputs. The inverse of `system_with_disturbances`."""
        m = self.linear.b.shape[1]
        mapped_columns = system.b[:, :m]
        feedthrough_columns = system.d[:, :m]
        linear = StateSpace(a=system.a, b=mapped_columns, c=system.c, d=feedthrough_columns)
        b_d = system.b[:, m:] if self.scale.disturbances else self.b_d
        return replace(self, linear=linear, b_d=b_d)

    def with_dead_time(self, samples: int) -> "SSM":
        """Copy of the model with a dead time at its input, whose delayed inputs become states. `x+
        = A x + B ub[k - samples]`; the delayed inputs are states of the recurrence. Measured
        disturbances act without the dead time."""
        linear = self.linear
        input_count = linear.b.shape[1]
        line = DelayLine(states=linear.order, channels=input_count, samples=samples)
        a = line.state_matrix(linear.a, linear.b)
        c = line.append_delay_columns(linear.c, linear.d)
        delayed_input = line.input_matrix()
        no_feedthrough = np.zeros_like(linear.d)
        late = StateSpace(a=a, b=delayed_input, c=c, d=no_feedthrough)
        delayed_disturbance = line.append_delay_rows(self.b_d)
        return replace(self, linear=late, b_d=delayed_disturbance)

    def absorb_map_centres(self) -> "SSM":
        """Move linear factors of the static maps into the linear recurrence where this tightens the
        bounds on the maps' slopes. The input-output map stays the same.

        `B S_u(v) = (B M) (M^{-1} S_u(v))` and `S_y(C x) = (S_y M^{-1})(M C x)`, whose scaffoldings
        then have Jacobians around the identity. The theorems speak of a ball around `alpha I`; a
        rotation or a sign per channel lies outside it and would be refused, although the model is
        as controllable as any. What cannot be absorbed stays refused. Derivation: docs/theory.md,
        "The ball of Jacobians".
        """
        linear = self.linear
        scaffold_in = self.scaffold_in
        scaffold_out = self.scaffold_out
        inward = _factor_out_centre(scaffold_in, "compose_with_output_matrix")
        if inward is not None:
            scaffold_in, m = inward
            b = linear.b @ m
            d = linear.d @ m
            linear = replace(linear, b=b, d=d)
        outward = _factor_out_centre(scaffold_out, "compose_with_input_matrix")
        if outward is not None:
            scaffold_out, m = outward
            c = m @ linear.c
            output_feedthrough = m @ linear.d
            linear = replace(linear, c=c, d=output_feedthrough)
        return replace(self, linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out)


def _factor_out_centre(
    scaffold: Scaffold, method: str
) -> tuple[Scaffold, Float[np.ndarray, "m m"]] | None:
    """Split a static map into a linear factor and a remainder with tighter slope bounds; None if
    they get no tighter."""
    has_other_channels = scaffold.inputs != scaffold.outputs
    if has_other_channels or scaffold.inputs == 1:
        return None
    m = scaffold.jacobian_centre()
    if m is None or not np.linalg.cond(m) < LARGEST_CONDITION:
        return None
    factor_out = getattr(scaffold, method)
    inverse_centre = np.linalg.inv(m)
    straight = factor_out(inverse_centre)
    before = jacobian_ball(scaffold).ball.relative_radius
    after = jacobian_ball(straight).ball.relative_radius
    return (straight, m) if after < before else None
