"""The controller as plain arrays: one form for every scaffolding, so that each export target is written once."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.network import Network
from ssm_study.models.scaffold import Scaffold
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.scaffold_monotone import MonotoneScaffold
from ssm_study.models.scaffold_residual import ResidualScaffold
from ssm_study.refusal import BadRequest, require
from ssm_study.synthesis.certificate import Design, Infeasible


@dataclass(frozen=True, kw_only=True)
class PortableMap:
    """`S(v) = linear v + N(v)`, N a leaky-ReLU network around its value at zero, or None. `linear (k, m)`."""

    linear: Float[np.ndarray, "k m"]
    network: Network | None

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        straight = v @ self.linear.T
        return straight if self.network is None else straight + self.network(v)

    def to_json(self) -> dict[str, Any]:
        return {"linear": self.linear.tolist()} | ({} if self.network is None else self.network.to_json())


@dataclass(frozen=True, kw_only=True)
class PortableController:
    """`u = u_eq + s_u K x,  x+ = A x + B S_u(v) + L (S_y(C x + D S_u(v)) - w) + E w,  v = (u - u_eq)/s_u`.

    `w = (y - y_eq)/s_y`; physical `u (m,)`, `y (p,)`. The state `x (n,)` starts at zero, the equilibrium: the estimate
    of the model's scaled state and, with integral action, the integrators `z+ = z + w` below it (`E` is zero without).
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
    input_scale: Float[np.ndarray, "m"]
    output_scale: Float[np.ndarray, "p"]
    input_equilibrium: Float[np.ndarray, "m"]
    output_equilibrium: Float[np.ndarray, "p"]
    step_s: float

    def to_json(self) -> dict[str, Any]:
        maps = {"s_in": self.s_in.to_json(), "s_out": self.s_out.to_json()}
        return {name: getattr(self, name).tolist() for name in ARRAYS} | maps | {"step_s": self.step_s}


SCALES = ("input_scale", "output_scale", "input_equilibrium", "output_equilibrium")
ARRAYS = ("a", "b", "c", "d", "k", "l", "e", *SCALES)


def portable_map(scaffold: Scaffold) -> PortableMap:
    """The same map for every input: exactly for linear, mlp and residual, to rounding for monotone; refuses others."""
    match scaffold:
        case LinearScaffold():
            return PortableMap(linear=scaffold.gain, network=None)
        case MlpScaffold():
            return PortableMap(linear=np.zeros((scaffold.outputs, scaffold.inputs)), network=scaffold.network)
        case ResidualScaffold():
            n = scaffold.network
            weights = (*n.weights[:-1], scaffold.beta * n.weights[-1])
            network = Network(
                weights=weights, biases=n.biases, negative_slopes=n.negative_slopes, positive_slopes=n.positive_slopes
            )
            return PortableMap(linear=scaffold.alpha * np.eye(scaffold.inputs), network=network)
        case MonotoneScaffold():
            return _monotone(scaffold)
    raise BadRequest("scaffold", type(scaffold).__name__, "cannot be exported", "use linear, mlp, monotone or residual")


def _monotone(scaffold: MonotoneScaffold) -> PortableMap:
    """`S_c(v) = s_0 v + sum_j (s_{j+1} - s_j) (relu(v - t_j) - relu(-t_j))`: one neuron per break point."""
    channels, breaks = scaffold.breakpoints.shape
    network = None
    if breaks:
        neurons = np.repeat(np.eye(channels), breaks, axis=0)
        network = Network(
            weights=(neurons, neurons.T * np.diff(scaffold.slopes, axis=1).ravel()),
            biases=(-scaffold.breakpoints.ravel(),),
            negative_slopes=(np.zeros(channels * breaks),),
            positive_slopes=(np.ones(channels * breaks),),
        )
    return PortableMap(linear=np.diag(scaffold.slopes[:, 0]), network=network)


def portable(model: SSM, design: Design) -> PortableController:
    """Raises `BadRequest` when the design has no controller or observer, or was made for another model."""
    feedback, observer = design.state_feedback, design.observer
    if isinstance(feedback, Infeasible):
        raise BadRequest("certificate.state_feedback", "infeasible", feedback.reason.rstrip("."), "export another run")
    if isinstance(observer, Infeasible):
        raise BadRequest("certificate.observer", "infeasible", observer.reason.rstrip("."), "export another run")
    n, p = model.order, len(model.output_scale)
    fits = feedback.k.shape[1] in (n, n + p) and observer.l.shape[0] == n
    require(fits, "certificate", feedback.k.shape, f"the model has order {model.order}", "export the run as stored")
    linear, added = model.linear, feedback.k.shape[1] - n
    below = np.zeros((added, max(p, linear.b.shape[1])))
    return PortableController(
        a=np.block([[linear.a, np.zeros((n, added))], [np.zeros((added, n)), np.eye(added)]]),
        b=np.vstack([linear.b, below[:, : linear.b.shape[1]]]),
        c=np.hstack([linear.c, np.zeros((len(linear.c), added))]),
        d=linear.d,
        k=feedback.k,
        l=np.vstack([observer.l, below[:, :p]]),
        e=np.vstack([np.zeros((n, p)), np.eye(p)[:added]]),
        s_in=portable_map(model.scaffold_in),
        s_out=portable_map(model.scaffold_out),
        **{name: getattr(model, name) for name in SCALES},
        step_s=model.step_s,
    )
