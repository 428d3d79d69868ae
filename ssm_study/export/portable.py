"""Controller and model as plain arrays, from which every export format is made.

Every target of the export starts from these.
"""

from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.bounds.network import InverseMap, PortableMap
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.models.structured import Model, StructuredSSM, evaluate_activations
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Scale
from ssm_study.systems import (
    Gains,
    StateSpace,
    StructuredSystem,
    System,
    error_input_matrix,
    stopped_integrator_matrix,
)

Vector = Float[np.ndarray, "_"]
MATRICES = ("a", "b", "c", "d", "k", "l", "e")


@dataclass(frozen=True, kw_only=True)
class PortableNeurons:
    """Neurons of a controller's model as plain arrays, with their activation functions. `phi(F x +
    G S_u(v) + L_z e + b) - phi(b)` with e the observer's output error.

    `into (n, r)` is the model's E, which drives x+; `h (q, r)` reads them into the output;
    `phi_bias` is `evaluate_activations(b)`. Zero rows of `into` and columns of `f` stand for the
    internal model.
    """

    into: Float[np.ndarray, "n r"]
    f: Float[np.ndarray, "r n"]
    g: Float[np.ndarray, "r k"]
    h: Float[np.ndarray, "q r"]
    l_z: Float[np.ndarray, "r p"]
    bias: Float[np.ndarray, "r"]
    phi_bias: Float[np.ndarray, "r"]
    kinds: tuple[str, ...]

    def __call__(self, x: Vector, lifted: Vector, error: Vector | None = None) -> Vector:
        """Outputs of the neurons, computed in the same order of operations as in the C code.
        Without `error` no correction is injected."""
        from_state = multiply_in_order(self.f, x, self.bias)
        z = multiply_in_order(self.g, lifted, from_state)
        if error is not None:
            z = multiply_in_order(self.l_z, error, z)
        return evaluate_activations(self.kinds, z) - self.phi_bias


@dataclass(frozen=True, kw_only=True)
class PortableController:
    """Controller with observer as plain arrays, from which it can be computed without any library.

    `u = u_eq + s_u K x,  x+ = A x + B S_u(v) + L (S_y(C x + D S_u(v)) - w) + E w`, with
    `v = (u - u_eq)/s_u`, `w = (y - y_eq)/s_y`; physical `u (m,)`, `y (p,)`. The state `x (n,)`
    starts at zero, the equilibrium: the estimate of the model's scaled state and, below it, the
    state of an internal model, `z+ = A_z z + E_z w` (`E` is zero without). `neurons` are those of a
    structured model, added to `x+` and to what `S_y` reads. `b_d (n, k)` adds scaled measured
    disturbances to `x+`; it is empty without any.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n k"]
    c: Float[np.ndarray, "q n"]
    d: Float[np.ndarray, "q k"]
    k: Float[np.ndarray, "m n"]
    l: Float[np.ndarray, "n p"]  # noqa: E741 - the paper's letter
    e: Float[np.ndarray, "n p"]
    s_in: PortableMap
    s_out: PortableMap
    scale: Scale
    step_s: float
    neurons: PortableNeurons | None = None
    b_d: Float[np.ndarray, "_ _"] = field(default_factory=partial(np.zeros, (0, 0)))

    def to_json(self) -> dict[str, Any]:
        """Constants of the controller as plain lists, by name."""
        numbers: dict[str, Any] = {name: each.tolist() for name, each in self.arrays().items()}
        numbers["s_in"] = self.s_in.to_json()
        numbers["s_out"] = self.s_out.to_json()
        if self.neurons:
            numbers["kinds"] = self.neurons.kinds
        numbers["step_s"] = self.step_s
        return numbers

    def arrays(self) -> dict[str, Float[np.ndarray, "..."]]:
        """Constant arrays of the controller by name, without its static maps."""
        matrices = {name: getattr(self, name) for name in MATRICES}
        scale = {name: values for name, values in vars(self.scale).items() if values.size}
        neurons = dict(vars(self.neurons)) if self.neurons else {}
        neurons.pop("kinds", None)
        arrays = matrices | scale | neurons
        if self.b_d.size:
            arrays["b_d"] = self.b_d
        return arrays

    @property
    def frozen_state_range(self) -> slice:
        """Index range of internal-model states that are held constant while an input limit is
        active. They are the integrators of a ramp's internal model.

        They come first in its model.
        """
        rows = np.flatnonzero(self.e.any(axis=1))
        modes = self.a[rows][:, rows]
        rest_by_themselves = np.array_equal(stopped_integrator_matrix(modes), modes)
        is_integrator = np.diagonal(modes) == 1
        count = 0 if rest_by_themselves else int(is_integrator.sum())
        first = len(self.a) - len(rows)
        return slice(first, first + count)

    def recurrence(self) -> System:
        """Linear or neural recurrence of the controller's model, without the internal model of
        references and disturbances."""
        is_internal = self.e.any(axis=1)  # E drives the internal model alone
        n = len(self.a) - int(is_internal.sum())
        a = self.a[:n, :n].astype(float)
        b = self.b[:n].astype(float)
        c = self.c[:, :n].astype(float)
        d = self.d.astype(float)
        linear = StateSpace(a=a, b=b, c=c, d=d)
        if not self.neurons:
            return linear
        neurons = convert_floats(self.neurons, np.float64)
        e = neurons.into[:n]
        f = neurons.f[:, :n]
        return StructuredSystem(
            a=linear.a, b=linear.b, c=linear.c, d=linear.d, e=e, f=f, g=neurons.g, h=neurons.h
        )


def _refuse_unexportable_design(design: Design) -> None:
    """Raise `BadRequest` for a design that lacks a gain."""
    for name, part in (("state_feedback", design.state_feedback), ("observer", design.observer)):
        if isinstance(part, Infeasible):
            reason = part.reason.rstrip(".")
            raise BadRequest(f"certificate.{name}", "infeasible", reason, "export another run")


def _refuse_gains_of_another_model(gains: Gains, order: int, output_count: int) -> None:
    """Raise `BadRequest` for gains whose sizes do not fit a model's order and number of outputs."""
    added = len(gains.modes)
    controller_fits = gains.k.shape[1] == order + added
    observer_fits = len(gains.l) == order
    fits = controller_fits and observer_fits and added % output_count == 0
    problem = f"the model has order {order}"
    require(fits, "certificate", gains.k.shape, problem, "export the run as stored")


def convert_controller(model: Model, design: Design) -> PortableController:
    """Convert the controller of a model and its design to plain arrays.

    Raises `BadRequest` when the design has no controller or observer, or was made for another
    model.
    """
    _refuse_unexportable_design(design)
    gains = design.gain_pair
    modes = gains.modes
    linear = model.linear
    n = model.order
    p = model.scale.outputs
    added = len(modes)
    _refuse_gains_of_another_model(gains, n, p)
    below = ((0, added), (0, 0))
    beside = ((0, 0), (0, added))
    into_modes = error_input_matrix(modes, p)
    into_model = np.zeros((n, p))
    a = scipy.linalg.block_diag(linear.a, modes)
    b = np.pad(linear.b, below)
    c = np.pad(linear.c, beside)
    l_ = np.pad(gains.l, below)
    e = np.vstack([into_model, into_modes])
    s_in = model.scaffold_in.as_portable()
    s_out = model.scaffold_out.as_portable()
    neurons = _convert_neurons(model, gains.l_z, added)
    disturbances = model.scale.disturbances
    b_d = np.pad(model.b_d, below) if disturbances else model.b_d
    return PortableController(
        a=a,
        b=b,
        c=c,
        d=linear.d,
        k=gains.k,
        l=l_,
        e=e,
        s_in=s_in,
        s_out=s_out,
        scale=model.scale,
        step_s=model.step_s,
        neurons=neurons,
        b_d=b_d,
    )


def _convert_neurons(
    model: Model, l_z: Float[np.ndarray, "r p"] | None, internal_state_count: int
) -> PortableNeurons | None:
    """Neurons of a model as plain arrays; None for a model without neurons."""
    if not isinstance(model, StructuredSSM) or not model.neurons:
        return None
    below = ((0, internal_state_count), (0, 0))
    beside = ((0, 0), (0, internal_state_count))
    into = np.pad(model.e, below)
    f = np.pad(model.f, beside)
    if l_z is None:
        l_z = np.zeros((len(model.neurons), model.scale.outputs))
    phi_bias = evaluate_activations(model.neurons, model.bias)
    return PortableNeurons(
        into=into,
        f=f,
        g=model.g,
        h=model.h,
        l_z=l_z,
        bias=model.bias,
        phi_bias=phi_bias,
        kinds=model.neurons,
    )


def multiply_in_order(
    matrix: Float[np.ndarray, "r c"], vector: Vector, initial_value: Vector | None = None
) -> Vector:
    """Product of a matrix and a vector, summed column by column in the same order as in the C code.
    `initial_value + a x`.

    `@` does not promise it.
    """
    y = np.zeros(len(matrix), dtype=matrix.dtype) if initial_value is None else initial_value
    for j, value in enumerate(vector):
        product = matrix[:, j] * value  # two roundings, as in C without contraction
        y = y + product
    return y


def evaluate_static_map(static_map: PortableMap, v: Vector) -> Vector:
    """Value of a static map, computed in the same order of operations as in the C code."""
    out = multiply_in_order(static_map.linear, v)
    if static_map.network is None:
        return out
    d = v
    for w, b, low, high in static_map.network.hidden_layers():
        z = multiply_in_order(w, d, b)
        slopes_at_zero = np.where(b >= 0, high, low)
        at_zero = slopes_at_zero * b
        activated = np.where(z >= 0, high * z, low * z)
        d = activated - at_zero
    last_weight = static_map.network.weights[-1]
    return multiply_in_order(last_weight, d, out)


def evaluate_inverse_map(inverse_map: InverseMap, w: Vector) -> Vector:
    """Value of the inverse of a static map, computed in the same order of operations as in the C
    code.

    Channel by channel the order is that already; for a product `@` promises none.
    """
    if inverse_map.matrix is None:
        return inverse_map(w)
    return multiply_in_order(inverse_map.matrix, w)


def convert_floats(item: Any, float_type: Any) -> Any:
    """Copy an object, with every array at any depth converted to a given float type."""
    if isinstance(item, np.ndarray):
        return item.astype(float_type)
    if isinstance(item, tuple):
        return tuple(convert_floats(part, float_type) for part in item)
    if is_dataclass(item) and not isinstance(item, type):
        parts = {}
        for part in fields(item):
            parts[part.name] = convert_floats(getattr(item, part.name), float_type)
        return replace(item, **parts)
    return item
