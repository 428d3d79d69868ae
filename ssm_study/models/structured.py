"""Structured model: a recurrence with neurons inside, between static input and output maps. No
torch here."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import SSM, DelayLine, MappedInput, Outputs, ScaffoldedModel, State
from ssm_study.models.matrix_shapes import matrix_shapes
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.refusal import require
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace, StructuredSystem, System

if TYPE_CHECKING:
    from ssm_study.models.structured_kernel import KernelMatrices

Values = Float[np.ndarray, "*batch"] | float  # of one argument NumPy makes a float


class Activation(NamedTuple):
    """Activation function of a neuron, with its derivative and its expression in C code. The slope
    `phi'(z)` is in [0, 1] (right of a kink); the C text is an expression in `z` for math.h.

    What it serves: tanh friction and saturation, softplus overflow and rectifiers, clipped_cubic
    hardening, relu and saturation the same with kinks. Source: docs/theory.md, "With neurons".
    """

    value: Callable[[Values], Values]
    slope: Callable[[Values], Values]
    c: str


def tanh_slope(z: Values) -> Values:
    """Derivative of the hyperbolic tangent."""
    return 1.0 - np.tanh(z) ** 2


def softplus(z: Values) -> Values:
    """Softplus function `log(1 + exp(z))`, computed without overflow."""
    return np.logaddexp(0.0, z)


def softplus_slope(z: Values) -> Values:
    """Derivative of the softplus function, which is the logistic function."""
    half_tanh = np.tanh(0.5 * z)
    return 0.5 * (1.0 + half_tanh)


def clipped_cubic(z: Values) -> Values:
    """Cubic function `z^3 / 3` between -1 and 1, continued by straight lines of slope one."""
    inside = z**3 / 3.0
    edge = np.copysign(2.0 / 3.0, z)
    beyond = z - edge
    size = np.abs(z)
    return np.where(size < 1.0, inside, beyond)


def clipped_cubic_slope(z: Values) -> Values:
    """Derivative of the clipped cubic function."""
    return np.minimum(z * z, 1.0)


def relu(z: Values) -> Values:
    """Rectified linear unit: the positive part of a number."""
    return np.maximum(z, 0.0)


def relu_slope(z: Values) -> Values:
    """Derivative of the rectified linear unit; one at zero."""
    return np.asarray(z >= 0.0, dtype=float)


def saturation(z: Values) -> Values:
    """Saturation function: a number limited to the interval from -1 to 1. 1."""
    return np.clip(z, -1.0, 1.0)


def saturation_slope(z: Values) -> Values:
    """Derivative of the saturation function."""
    is_above = z >= -1.0
    inside = np.logical_and(is_above, z < 1.0)
    return np.asarray(inside, dtype=float)


SOFTPLUS_IN_C = "(z > 0.0 ? z : 0.0) + log1p(exp(-fabs(z)))"
CUBIC_IN_C = "(fabs(z) < 1.0 ? z * z * z / 3.0 : z - copysign(2.0 / 3.0, z))"
# In the order of the compiled form's codes (`structured_kernel.activation_and_slope`).
NEURONS: dict[str, Activation] = {}
NEURONS["tanh"] = Activation(np.tanh, tanh_slope, "tanh(z)")
NEURONS["softplus"] = Activation(softplus, softplus_slope, SOFTPLUS_IN_C)
NEURONS["clipped_cubic"] = Activation(clipped_cubic, clipped_cubic_slope, CUBIC_IN_C)
NEURONS["relu"] = Activation(relu, relu_slope, "(z > 0.0 ? z : 0.0)")
NEURONS["saturation"] = Activation(saturation, saturation_slope, "fmin(fmax(z, -1.0), 1.0)")


def activation_codes(kinds: tuple[str, ...]) -> Int[np.ndarray, "q"]:
    """Integer codes of the neurons' activation functions, for use in compiled code. Raises
    `BadRequest` for an unknown activation."""
    known_kinds = list(NEURONS)
    for kind in kinds:
        require(
            kind in known_kinds, "neurons", kind, "unknown neuron", f"use {', '.join(known_kinds)}"
        )
    codes = [known_kinds.index(kind) for kind in kinds]
    return np.array(codes, dtype=np.int64)


def evaluate_activations(
    kinds: tuple[str, ...], z: Float[np.ndarray, "*batch q"], quantity: str = "value"
) -> Float[np.ndarray, "*batch q"]:
    """Evaluate the activation functions of all neurons, or their derivatives. `phi_i(z_i)` for each
    neuron i, or `phi_i'(z_i)` where `quantity` is "slope"."""
    out = np.empty_like(z)
    for i, kind in enumerate(kinds):
        activation = getattr(NEURONS[kind], quantity)
        channel_values = z[..., i]
        out[..., i] = activation(channel_values)
    return out


Matrix = Float[np.ndarray, "_ _"]  # `matrix_shapes` says which
Injected = Float[np.ndarray, "*batch q"] | float


@dataclass(frozen=True, kw_only=True)
class StructuredSSM(ScaffoldedModel):
    """Identified model with neurons inside its recurrence, between a static input map and a static
    output map. `x+ = A x + B v + E w, y = y_eq + output_scale S_y(C x + D v + H w), v = S_u((u -
    u_eq) / input_scale)`.

    `z = F x + G v + b,  w = phi(z) - phi(b)`, elementwise with slopes in [0, 1]: rest stays at
    rest. Shapes:
    `a (n, n)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, `e (n, q)`, `f (q, n)`, `g (q, m)`, `h (p, q)`,
    `bias (q,)`;
    `neurons` names the kind of each of the q neurons. Without any it is the model of one layer
    (`SSM`). With k measured disturbances `x+` has the further term `b_d (d - d_eq) / d_scale`,
    `b_d (n, k)`.
    Raises `BadRequest` for shapes that do not fit, entries that are not finite, an unknown kind.
    Source: Revay, Wang & Manchester (2023), REN with D11 = 0.
    """

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    e: Matrix
    f: Matrix
    g: Matrix
    h: Matrix
    bias: Float[np.ndarray, "_"]
    neurons: tuple[str, ...]
    scaffold_in: Scaffold
    scaffold_out: Scaffold
    scale: Scale
    step_s: float
    b_d: Float[np.ndarray, "_ _"] = field(default_factory=partial(np.zeros, (0, 0)))

    def __post_init__(self) -> None:
        n = len(self.a)
        m = self.scaffold_in.outputs
        p = self.scaffold_out.inputs
        q = len(self.neurons)
        activation_codes(self.neurons)
        shapes = matrix_shapes(n, m, p, q)
        for name, shape in shapes.items():
            value = getattr(self, name)
            fits = value.shape == shape and bool(np.isfinite(value).all())
            problem = f"must be finite and of shape {shape}: {n} states, {q} neurons"
            require(fits, name, value.shape, problem, "write model.json again")
        self.check_dimensions()

    @property
    def linear(self) -> StateSpace:  # type: ignore[override] # read only, as every field here
        """Linear part `(A, B, C, D)` of a recurrence with neurons."""
        return StateSpace(a=self.a, b=self.b, c=self.c, d=self.d)

    @property
    def system(self) -> System:
        """State-space system of a model without its static maps, with neurons where the model has
        them."""
        return self._structured_system if self.neurons else self.linear

    @property
    def _structured_system(self) -> StructuredSystem:
        """Recurrence with neurons in the form for which certificates are computed."""
        names = [block.name for block in fields(StructuredSystem)]
        blocks = {name: getattr(self, name) for name in names}
        return StructuredSystem(**blocks)

    @cached_property
    def kernel_matrices(self) -> "KernelMatrices":
        """Matrices of the model's recurrence in the layout for compiled code."""
        # Here, for it loads numba: reading a model does without.
        from ssm_study.models.structured_kernel import KernelMatrices

        codes = activation_codes(self.neurons)
        return KernelMatrices.from_parts(vars(self), codes)

    @cached_property
    def kernel_matrices_with_disturbances(self) -> "KernelMatrices":
        """Matrices of the model's recurrence for compiled code, with measured disturbances as
        further inputs. Disturbances only act on the state."""
        from ssm_study.models.structured_kernel import KernelMatrices

        system = self.system_with_disturbances
        columns = (0, self.scale.disturbances)
        driven = {"b": system.b, "d": system.d}
        no_rows = (0, 0)
        driven["g"] = np.pad(self.g, (no_rows, columns))
        codes = activation_codes(self.neurons)
        matrices = vars(self) | driven
        return KernelMatrices.from_parts(matrices, codes)

    def linearise_at(
        self, x: Float[np.ndarray, "n"], ubar: Float[np.ndarray, "mbar"]
    ) -> StateSpace:
        """Linearise the recurrence with neurons at a given state and a given output of the static
        input map. Neurons are replaced by their slopes there."""
        linear_input = self.f @ x + self.g @ ubar
        z = linear_input + self.bias
        slopes = evaluate_activations(self.neurons, z, "slope")
        return self._structured_system.linearise_at_slopes(slopes)

    def neuron_outputs(
        self, x: State, ubar: MappedInput, injected: Injected = 0.0
    ) -> Float[np.ndarray, "*batch q"]:
        """Outputs of all neurons for a state and an input after the static input map. `w = phi(F x
        + G v + b + injected) - phi(b)`; an observer injects `L_z (yh - y)`."""
        linear_input = x @ self.f.T + ubar @ self.g.T
        z = linear_input + self.bias + injected  # what the neurons see
        at_rest = evaluate_activations(self.neurons, self.bias)
        return evaluate_activations(self.neurons, z) - at_rest

    def next_state(self, x: State, ubar: MappedInput, injected: Injected = 0.0) -> State:
        """State of the recurrence with neurons one sample later, `x+ = A x + B v + E w`. `injected`
        is as in `neuron_outputs`."""
        w = self.neuron_outputs(x, ubar, injected)
        linear_motion = x @ self.a.T + ubar @ self.b.T
        neuron_motion = w @ self.e.T
        return linear_motion + neuron_motion

    def scaled_output_at(self, x: State, ubar: MappedInput) -> Float[np.ndarray, "*batch p"]:
        """Scaled output `S_y(C x + D v + H w)`: the output map `S_y`, applied to the recurrence's
        output."""
        w = self.neuron_outputs(x, ubar)
        linear_output = x @ self.c.T + ubar @ self.d.T
        neuron_output = w @ self.h.T
        ybar = linear_output + neuron_output
        return self.scaffold_out(ybar)

    def simulate_recurrence(
        self, ubar: Float[np.ndarray, "*batch T mbar"], x0: State | None = None
    ) -> tuple[Outputs, Float[np.ndarray, "*batch T1 n"]]:
        """Simulate the recurrence with neurons, without the static maps, in compiled code. `C x + D
        v + H w`, and the states, one more than samples: the last is the one after the last
        sample."""
        from ssm_study.models.structured_kernel import simulate_compiled

        batch = ubar.shape[:-2]
        samples = ubar.shape[-2]
        inputs = ubar.shape[-1]
        # No broadcast view: numba compiles anew for what is read-only.
        start_shape = (*batch, self.order)
        start = np.zeros(start_shape)
        if x0 is not None:
            start[...] = x0
        records = ubar.reshape(-1, samples, inputs)
        v = np.ascontiguousarray(records, dtype=np.float64)
        has_disturbances = inputs != self.b.shape[1]
        matrices = (
            self.kernel_matrices_with_disturbances if has_disturbances else self.kernel_matrices
        )
        flat_start = start.reshape(-1, self.order)
        ybar, states = simulate_compiled(matrices, v, flat_start)
        outputs = ybar.reshape(*batch, samples, -1)
        states_of_batch = states.reshape(*batch, samples + 1, -1)
        return outputs, states_of_batch

    def with_dead_time(self, samples: int) -> "StructuredSSM":
        """Copy of the model with a dead time at its input. The neurons see the input as many
        samples late, too."""
        n, m = self.b.shape
        line = DelayLine(states=n, channels=m, samples=samples)
        neuron_count = len(self.neurons)
        idle = np.zeros((line.state_count, neuron_count))
        a = line.state_matrix(self.a, self.b)
        b = line.input_matrix()
        c = line.append_delay_columns(self.c, self.d)
        d = np.zeros_like(self.d)
        e = np.vstack([self.e, idle])
        f = line.append_delay_columns(self.f, self.g)
        g = np.zeros_like(self.g)
        b_d = line.append_delay_rows(self.b_d)
        return replace(self, a=a, b=b, c=c, d=d, e=e, f=f, g=g, b_d=b_d)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "StructuredSSM":
        """Read a structured model from its JSON form. A model with one layer has q = 0. Raises as
        `JsonDataclass` does."""
        if data.get("neurons"):
            return super().from_json(data)
        plain = vars(SSM.from_json(data))
        parts = vars(plain.pop("linear"))
        n, m = parts["b"].shape
        p = len(parts["c"])
        shapes = matrix_shapes(n, m, p, 0)
        none: Any = {name: np.zeros(shape) for name, shape in shapes.items()}
        return cls(**none | parts, **plain, neurons=())


Model = SSM | StructuredSSM  # of one layer, or with neurons in the recurrence: what is certified


def linearise_at_equilibrium(model: Model) -> StateSpace:
    """Linear system obtained by linearising a model's recurrence with neurons at the
    equilibrium."""
    if isinstance(model, SSM):
        return model.linear
    zero_state = np.zeros(model.order)
    mapped_inputs = model.b.shape[1]
    return model.linearise_at(zero_state, np.zeros(mapped_inputs))
