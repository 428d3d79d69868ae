"""Certificate that the closed loop comes to rest on every plant whose model error lies within a
disc measured from records.

Problem. The loop `u = K xh` with its observer runs on a plant whose output is `y = m + e`, m the
model's output for the same input. Records bound e in a disc around `c m`, by frequency, with two
references: m where the model speaks, u where it is silent. How much larger may e be than the
records show?

Hypotheses. `S_u` in the ball `alpha I + beta Delta`, slopes free to vary; `S_y` in the ball
`alpha_out I + beta_out Delta`, one fixed map. The premise: for every start of the plant there is a
gamma such that for every input of finite energy, over all time,

    sum |e - c m|^2  <=  kappa^2 sum ( floor^2 |m|^2 + |W m|^2 + |V u|^2 )  +  gamma

with stable filters W and V, from zero. No input limit acts, no load is constant, noise has finite
energy.

Statement. With `eps = xh - x`, `v = alpha u + p`, `o = C x + D v`, `do = C eps`, `m = alpha_out o +
r2`, `inj = alpha_out do + r1 - e` (that is `yh - y`),

    x+ = A x + B v + E e,    eps+ = A eps + L inj,    u = K (x, z) + K_x eps

(x with its internal model z, which E feeds e to), and the states of W and V beside them in xi, if
`P > 0`, `lambda_p > 0`, `lambda_out > 0`, `kappa floor > |c|` and

    xi' P xi - xi+' P xi+  - lambda_p (beta^2 |u|^2 - |p|^2)
      - sum over (a, b) in (r1, do), (r2, o), (r1 + r2, do + o)  of lambda_out (beta_out^2 |b|^2 -
      |a|^2)
      + |e - c m|^2 - kappa^2 (floor^2 |m|^2 + |W m|^2 + |V u|^2)   >  0   for all (xi, p, e, r1,
      r2)

then x, eps and e are square-summable: input and output of the plant come to rest from every start.
Where the premise also holds for differences of two inputs and S_y is linear, the loop contracts.

The tolerated gain is the case `c = 0, W = 0, V = 1`: however a plant differs from its model, it
does no harm while `|e| <= kappa |u|` over all time. Without a ball this is small gain, `kappa = 1
/ ||T_ue||_inf`.

Why a premise over all time is enough, although a loop stops at no time: the disc holds `e = 0`
(`kappa floor > |c|`) and is convex, so with e it holds `tau e` for tau in [0, 1]. The inequality
bounds every loop of finite energy alike in tau; at `tau = 0` the loop is the certified model, and a
small step of tau keeps energies finite (Megretski & Rantzer 1997, Theorem 1). So a plant that
answers a sample before its model is covered too, whose sums up to a time exceed the disc's.

When not to use it. As a forecast: that the plant meets the premise is what records show, not what
is proved. Where kappa is below what they need nothing is covered, and the number is no fraction.

Reference. docs/theory.md, "Measured discs"; Megretski & Rantzer, IEEE TAC 42 (1997) 819-830,
Theorem 1.

Example. `x+ = 0.5 x + u`, `K = -0.25`, `L = -0.5`, `|e| <= kappa |u|`: small gain. `T_ue = 0.125 (z
- 0.5) / (z (z - 0.25))` is 0.15 at z = -1.

>>> import numpy as np
>>> from ssm_study.synthesis.measured_discs_search import certify_largest_radius
>>> from ssm_study.certificates.theorem import VerificationContext
>>> from ssm_study.systems import JacobianBalls, JacobianBall, StateSpace
>>> one, unit = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> loop = StateSpace(a=0.5 * one, b=one, c=one, d=0 * one)
>>> gains, balls = {"k": -0.25 * one, "l": -0.5 * one}, JacobianBalls(input=unit, output=unit)
>>> context = VerificationContext(system=loop, controlled=loop, balls=balls, gains=gains)
>>> proof = certify_largest_radius(context)
>>> print(f"{proof.tolerated_gain:.3f} = 0.999 / 0.15, certified: {proof.certified}")
6.660 = 0.999 / 0.15, certified: True
"""

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.problem import DUAL
from ssm_study.certificates.theorem import (
    Blocks,
    Theorem,
    VerificationContext,
    assemble_blocks,
    multiplier_matrix,
)
from ssm_study.systems import JacobianBall, error_input_matrix

OF_THE_OUTPUT = ("c", "d", "h")  # read from the model, the others from what is controlled


@dataclass(frozen=True, kw_only=True)
class MeasuredDiscs(Theorem):
    """Certificate that the closed loop comes to rest on every plant whose model error lies within a
    disc measured from records. `kappa` and its proof `p (n_xi, n_xi)`, `lambda_p`, `lambda_out
    (3,)`, which is empty for a linear S_y.

    The disc is `centre, floor, weight_output, weight_input`: `[A, B; C, D]` of a filter of one
    channel, applied to each. The loop is `a, b, k` (controlled), `c, d, l, alpha_out, beta_out`
    (observed).
    """

    a: Float[np.ndarray, "s s"]
    b: Float[np.ndarray, "s m"]
    c: Float[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]
    k: Float[np.ndarray, "m s"]
    l: Float[np.ndarray, "n p"]  # noqa: E741 - the paper's letter
    alpha_out: float
    beta_out: float
    centre: float
    floor: float
    weight_output: Float[np.ndarray, "y y"]
    weight_input: Float[np.ndarray, "v v"]
    kappa: float
    lambda_p: float
    lambda_out: Float[np.ndarray, "r"]
    p: Float[np.ndarray, "x x"]

    part: ClassVar[str] = "coverage"
    metric_matrix: ClassVar[str] = "p"

    @property
    def tolerated_gain(self) -> float | None:
        """Largest gain from the input to the model error with which the closed loop is proved to
        come to rest, `kappa |V|`.

        None where the disc is not centred on the model or V is no constant. A disc that also lets
        in model output holds all of the mismatch that this gain allows.
        """
        is_constant = self.weight_input.shape == (1, 1)
        if self.centre != 0 or not is_constant:
            return None
        return float(self.kappa * abs(self.weight_input[0, 0]))

    @classmethod
    def conditions(cls, proof: Any) -> dict[str, Blocks]:
        """Matrices that must be positive definite for the loop to come to rest on every plant with
        a model error within the disc."""
        signals = cls.signal_matrices(proof)
        storage = signals.xi.T @ proof.p @ signals.xi
        next_storage = signals.step.T @ proof.p @ signals.step
        form = storage - next_storage
        form = form + cls.disc_constraint(proof, signals)
        for multiplier, map_form in cls.static_map_constraints(proof, signals):
            form = form + multiplier * map_form
        disc = proof.kappa * proof.kappa * proof.floor * proof.floor - proof.centre * proof.centre
        conditions = {"inequality": [[form]], "model inside the disc": [[disc]]}
        for name in ("p", "lambda_p", "kappa", "floor"):
            conditions[name] = [[getattr(proof, name)]]
        if proof.lambda_out.shape[1]:
            conditions["lambda_out"] = [[multiplier_matrix(proof.lambda_out)]]
        return conditions

    @staticmethod
    def disc_constraint(proof: Any, signals: Any) -> Any:
        """Quadratic form of the closed loop's signals that is negative where the model error lies
        within the certified disc around a centre. `|e - c m|^2 - kappa^2 (floor^2 |m|^2 + |W m|^2 +
        |V u|^2)`."""
        deviation = signals.e - proof.centre * signals.m
        output_power = signals.m.T @ signals.m
        weighted_output_power = signals.w_m.T @ signals.w_m
        weighted_input_power = signals.v_u.T @ signals.v_u
        reference = proof.floor * proof.floor * output_power
        reference = reference + weighted_output_power + weighted_input_power
        return deviation.T @ deviation - proof.kappa * proof.kappa * reference

    @classmethod
    def static_map_constraints(cls, proof: Any, signals: Any) -> list[tuple[Any, Any]]:
        """Quadratic constraints on the inputs and outputs of the model's static maps, each with its
        multiplier."""
        u = signals.u
        p = signals.p
        input_form = p.T @ p - proof.beta * proof.beta * (u.T @ u)
        forms = [(proof.lambda_p, input_form)]
        if not proof.lambda_out.shape[1]:
            return forms
        model_pair = (signals.r2, signals.o)
        error_pair = (signals.r1, signals.do)
        observer_pair = (signals.r1 + signals.r2, signals.do + signals.o)
        pairs = [error_pair, model_pair, observer_pair]
        squared_radius = proof.beta_out * proof.beta_out
        for i, (remainder, argument) in enumerate(pairs):
            output_form = remainder.T @ remainder - squared_radius * (argument.T @ argument)
            multiplier = proof.lambda_out[:, i : i + 1]
            forms.append((multiplier, output_form))
        return forms

    @classmethod
    def free_signal_sizes(cls, proof: Any) -> dict[str, int]:
        """Number of channels of each free signal of the closed loop, such as the model error, in
        column order."""
        inputs = proof.b.shape[1]
        outputs = proof.c.shape[0]
        sizes = {"p": inputs, "e": outputs}
        if proof.lambda_out.shape[1]:
            sizes |= {"r1": outputs, "r2": outputs}
        return sizes

    @classmethod
    def signal_matrices(cls, proof: Any) -> SimpleNamespace:
        """Matrices that give every signal of the closed loop as a linear function of its states and
        free signals."""
        s, m = proof.b.shape
        p, n = proof.c.shape
        output_filter_order = count_rows(proof.weight_output) - 1
        input_filter_order = count_rows(proof.weight_input) - 1
        states = {"x": s, "eps": n, "x_w": output_filter_order * p, "x_v": input_filter_order * m}
        free_signals = cls.free_signal_sizes(proof)
        rows = SimpleNamespace(**selection_matrices(states | free_signals))
        rows.xi = np.vstack([getattr(rows, name) for name in states])
        rows.u = proof.k @ rows.x + proof.k[:, :n] @ rows.eps
        rows.drive = proof.alpha * rows.u + rows.p
        zero = np.zeros((p, rows.xi.shape[1]))
        neurons_in_output = cls.neuron_contribution(proof, rows, "w")
        neurons_in_error = cls.neuron_contribution(proof, rows, "d")
        rows.o = proof.c @ rows.x[:n] + proof.d @ rows.drive + neurons_in_output
        rows.do = proof.c @ rows.eps + neurons_in_error
        remainder = getattr(rows, "r2", zero)
        remainder_of_error = getattr(rows, "r1", zero)
        rows.m = proof.alpha_out * rows.o + remainder
        rows.injected = proof.alpha_out * rows.do + remainder_of_error - rows.e
        internal_input = error_input_matrix(np.eye(s - n), p)
        error_input = np.vstack([np.zeros((n, p)), internal_input])
        next_x = proof.a @ rows.x + proof.b @ rows.drive + error_input @ rows.e
        model_a = proof.a[:n, :n]
        next_eps = model_a @ rows.eps + proof.l @ rows.injected
        next_w, rows.w_m = apply_filter(proof.weight_output, rows.x_w, rows.m, p)
        next_v, rows.v_u = apply_filter(proof.weight_input, rows.x_v, rows.u, m)
        next_x, next_eps = cls.add_neurons_to_states(proof, rows, next_x, next_eps)
        next_states = [[next_x], [next_eps]]
        next_states += [[filtered] for filtered in (next_w, next_v) if filtered.shape[0]]
        rows.step = assemble_blocks(next_states)
        return rows

    @classmethod
    def neuron_contribution(cls, proof: Any, rows: Any, signal_name: str) -> Any:
        """Contribution of the neurons to the model's output, as a matrix; zero for a model without
        neurons. Zero for a model with one layer."""
        del signal_name
        return np.zeros((proof.c.shape[0], rows.xi.shape[1]))

    @classmethod
    def add_neurons_to_states(
        cls, proof: Any, rows: Any, next_state: Any, next_error: Any
    ) -> tuple[Any, Any]:
        """Add the contribution of the neurons to the next states of the model and of the estimation
        error. A model with one layer has none, so that the states stay unchanged."""
        del proof, rows
        return next_state, next_error

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of the certificate that follow from the model and the design's gains."""
        matrices = self.loop_matrices(context)
        ball = context.balls.output
        linear_map = len(self.lambda_out) == 0
        if linear_map and ball.beta > 0:  # no multiplier for a bend that there is: proves nothing
            matrices["beta_out"] = np.nan
        return matrices

    @classmethod
    def loop_matrices(cls, context: VerificationContext) -> dict[str, Any]:
        """Matrices of the closed loop that a certificate stores, from the model and the gains of
        the design."""
        names = [field.name for field in fields(cls) if field.name in DUAL]
        matrices = dict[str, Any]()
        for name in names:
            system = context.system if name in OF_THE_OUTPUT else context.controlled
            matrices[name] = getattr(system, name)
        matrices |= context.gains
        ball = context.balls.output
        matrices["alpha_out"] = ball.alpha
        matrices["beta_out"] = ball.beta
        return matrices

    @staticmethod
    def required_ball(context: VerificationContext) -> JacobianBall:
        """Ball of Jacobians of the model's static input map, which the ball in the certificate
        must contain."""
        return context.balls.input

    @classmethod
    def largest_provable_rate(cls, context: VerificationContext) -> None:
        """Return None, because the theorem proves that a loop comes to rest, but no contraction
        rate."""


def count_rows(matrix: Any) -> int:
    """Number of rows of a matrix of floats or of exact numbers."""
    return int(matrix.shape[0])


def selection_matrices(sizes: dict[str, int]) -> dict[str, Float[np.ndarray, "_ N"]]:
    """Matrices that select each named block of a stacked vector."""
    ends = np.cumsum(list(sizes.values()))
    identity = np.eye(int(ends[-1]))
    pieces = np.split(identity, ends[:-1])
    return dict(zip(sizes, pieces, strict=True))


def apply_filter(filter_matrix: Any, state: Any, signal: Any, channels: int) -> tuple[Any, Any]:
    """Next state and output of a single-channel filter that is applied to each channel of a
    signal."""
    order = count_rows(filter_matrix) - 1
    a = filter_matrix[:order, :order]
    b = filter_matrix[:order, order:]
    c = filter_matrix[order:, :order]
    direct = filter_matrix[order:, order:]
    if not order:
        no_state = np.zeros((0, signal.shape[1]))
        return no_state, direct * signal
    next_states = []
    outputs = []
    for i in range(channels):
        start = i * order
        own_state = state[start : start + order]
        entering = signal[i : i + 1, :]
        next_state = a @ own_state + b @ entering
        output = c @ own_state + direct * entering
        next_states.append([next_state])
        outputs.append([output])
    return assemble_blocks(next_states), assemble_blocks(outputs)
