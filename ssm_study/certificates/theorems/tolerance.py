"""The largest mismatch of the model under which contraction of the closed loop is proved, for
slopes that vary at will.

Problem. The loop `u = K xh` with its observer runs on a plant whose output is `y = y_model + e`, `e
= Delta(W u)`: how large may the mismatch Delta be? Shapes: `K (m, s)`, `L (n, p)`, W a stable
filter of the input, m channels.

Hypotheses. `S_u` as in `state_feedback`; `S_y` linear, `S_y(v) = alpha_out v`; Delta is causal, and
for any two inputs `||e - e'||_2 <= s ||W (u - u')||_2` from rest. Nothing is asked of it sample by
sample, so no rate is claimed.

Statement. With `xi = (x, eps, x_W)`, `eps = xh - x`, `C_u = [K, K_x, 0]`, `C_W = [D_W C_u, C_w]`,

    A_xi = [A + alpha B K, alpha B K_x, 0; 0, A_x + alpha_out L C, 0; B_W K, B_W K_x, A_W],
    B_p = [B; 0; 0],    B_e = [E; -L; 0]

(x with its internal model, which E feeds e to), if `P > 0`, `lambda_p > 0` and `s > 0` satisfy

    diag( P - lambda_p beta^2 C_u^T C_u - s^2 C_W^T C_W,  lambda_p I,  I ) - [A_xi B_p B_e]^T P
    [A_xi B_p B_e]  >  0

then differences of trajectories are square-summable and tend to zero. Without a ball this is small
gain, `s = 1 / ||W T_ue||_inf`; with one, slopes may vary at will, and s is below what the margin at
constant slopes says.

When not to use it. As a forecast: that the plant's mismatch is below s is a premise. With a
nonlinear output map.

Reference. docs/theory.md; [Z26] Theorem 3 is the case without mismatch; cf. Megretski & Rantzer
1997 (multipliers).

Example. `x+ = 0.5 x + u`, `K = -0.25`, `L = -0.5`: `T_ue = 0.125 (z - 0.5) / (z (z - 0.25))`, 0.15
at z = -1.

>>> import numpy as np
>>> from ssm_study.systems import Balls, JacobianBall, StateSpace
>>> one, unit = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> loop = StateSpace(a=0.5 * one, b=one, c=one, d=0 * one)
>>> gains, balls = {"k": -0.25 * one, "l": -0.5 * one}, Balls(input=unit, output=unit)
>>> context = VerificationContext(system=loop, controlled=loop, balls=balls, gains=gains)
>>> found = largest_tolerance(context, weight=one)
>>> print(f"{found.s:.3f} = 0.999 / 0.15, certified: {found.certified}")
6.660 = 0.999 / 0.15, certified: True
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import product
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.bounds.frequency import frequency_response
from ssm_study.certificates.problem import DUAL, symmetric_part
from ssm_study.certificates.riccati import solve_riccati_by_doubling
from ssm_study.certificates.theorem import (
    Blocks,
    Theorem,
    VerificationContext,
    assemble_blocks,
    multiplier_matrix,
    symmetric_from_upper,
)
from ssm_study.systems import JacobianBall, StateSpace, error_input_matrix

# Frequencies (rad/sample) of the search, beside those of the loop's own modes; then as many again
# around the worst.
ANGLES = np.concatenate([[0.0], np.geomspace(1e-4, np.pi, 400)])
# lambda_p over the gain from e to u: the coarse search, then a line search.
MULTIPLIERS = np.geomspace(1e-8, 1e8, 65)
# Shares of the largest s, in order of trial; the equation is solved half way there.
INSIDE = (1e-3, 3e-3, 1e-2, 3e-2, 0.1)
# Of the inequality, as shares of its supply, where the loop's Gramian is the identity.
SLACKS = (1e-7, 1e-10)
# directions of the loop that no signal reaches keep this share of the mean in these coordinates
FLOOR = 1e-10
Into = Float[np.ndarray, "m x"]
Candidates = Iterator[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Tolerance(Theorem):
    """Certificate of the largest mismatch under which the loop contracts. `s` and its proof `p
    (n_xi, n_xi)`, `lambda_p`; the loop `a, b, k` (controlled), `c, l, alpha_out` (observed).

    `weight (w + m, w + m)` is `[A_W, B_W; C_W, D_W]`, of order w: for a constant weight just `D_W`.
    """

    a: Float[np.ndarray, "s s"]
    b: Float[np.ndarray, "s m"]
    c: Float[np.ndarray, "p n"]
    k: Float[np.ndarray, "m s"]
    l: Float[np.ndarray, "n p"]  # noqa: E741 - the paper's letter
    alpha_out: float
    weight: Float[np.ndarray, "v v"]
    s: float
    lambda_p: float
    p: Float[np.ndarray, "x x"]

    part: ClassVar[str] = "tolerance"
    metric_matrix: ClassVar[str] = "p"

    @classmethod
    def conditions(cls, of: Any) -> dict[str, Blocks]:  # of the class: it says what is `seen`
        loop, into_u, *neurons = cls.matrices(of)
        into_w = cls.seen(of)
        ball = of.lambda_p * of.beta * of.beta * (into_u.T @ into_u)
        storage = of.p - ball - of.s * of.s * (into_w.T @ into_w)
        of_ball = of.lambda_p * np.eye(of.b.shape[1])
        of_mismatch = np.eye(of.c.shape[0])
        supply = assemble_blocks(
            symmetric_from_upper([[storage, 0, 0], [of_ball, 0], [of_mismatch]])
        )
        for neuron_inputs in neurons:  # none, or what `structured_tolerance` adds
            weights = multiplier_matrix(of.lambda_)
            coupling = -1.0 * (weights @ neuron_inputs).T
            supply = assemble_blocks(symmetric_from_upper([[supply, coupling], [2.0 * weights]]))
        positive = {name: [[getattr(of, name)]] for name in ("p", "lambda_p", "s")}
        return {"inequality": [[supply - loop.T @ of.p @ loop]], **positive}

    @staticmethod
    def matrices(of: Any) -> Any:
        """Matrices of the loop in the theorem's statement, from the fields of the certificate."""
        s, m = of.b.shape
        p, n = of.c.shape
        w = of.weight.shape[0] - m
        k_x = of.k[:, :n]
        none = np.zeros((s, w))
        a_w = of.weight[:w, :w]
        b_w = of.weight[:w, w:]
        closed = of.a + of.alpha * (of.b @ of.k)
        observed = of.a[:n, :n] + of.alpha_out * (of.l @ of.c)
        fed = np.vstack([np.zeros((n, p)), error_input_matrix(np.eye(s - n), p)])  # E
        top = [closed, of.alpha * (of.b @ k_x), none, of.b, fed]
        middle = [np.zeros((n, s)), observed, np.zeros((n, w)), np.zeros((n, m)), -of.l]
        bottom = [b_w @ of.k, b_w @ k_x, a_w, np.zeros((w, m)), np.zeros((w, p))]
        return assemble_blocks([top, middle, bottom]), assemble_blocks(
            [[of.k, k_x, np.zeros((m, w))]]
        )

    @staticmethod
    def seen(of: Any) -> Any:
        """Output matrix of the weighted input, to which the gain from the model error is
        measured."""
        n = of.c.shape[1]
        m = of.b.shape[1]
        w = of.weight.shape[0] - m
        c_w = of.weight[w:, :w]
        d_w = of.weight[w:, w:]
        return assemble_blocks([[d_w @ of.k, d_w @ of.k[:, :n], c_w]])

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        return self.loop_of(context) | {"weight": np.eye(len(self.k))}

    @classmethod
    def loop_of(cls, context: VerificationContext) -> dict[str, Any]:
        """Fields of the certificate that come from the model or are gains. `alpha_out` is NaN for a
        nonlinear output map."""
        numbers: dict[str, Any] = {}
        for name in (part.name for part in fields(cls) if part.name in DUAL):
            system = context.system if name in ("c", "h") else context.controlled
            numbers[name] = getattr(system, name)
        output = context.balls.output
        alpha_out = np.nan if output.beta > 0 else output.alpha
        return {**numbers, **context.gains, "alpha_out": alpha_out}

    @classmethod
    def candidates(
        cls, into_w: Into, beta: float, loop: Float[np.ndarray, "x c"], into_u: Into
    ) -> Candidates:
        """Candidate values of the tolerance with their multiplier and metric, the largest tolerance
        first.

        A search over the one multiplier: at a given `lambda_p` the largest s is a peak over
        frequency, and P the least solution of a Riccati equation. No solver is asked; one is the
        oracle of the test.
        """
        if np.abs(np.linalg.eigvals(loop[:, : len(loop)])).max() >= 1:
            return
        lambda_p, largest = _best_multiplier(loop, beta * into_u, into_w)
        if not largest < np.inf:
            return
        scaled_u = lambda_p**0.5 * beta * into_u
        for inside, slack in product(INSIDE, SLACKS):
            s = largest * (1 - inside)
            half_way = largest * (1 - inside / 2) * into_w
            p = _solve_riccati(loop, scaled_u, half_way, lambda_p, slack)
            if p is not None and s > 0:
                status = f"{inside:.1%} inside the largest at this multiplier"
                yield {"s": s, "lambda_p": lambda_p, "p": p, "status": status}

    @staticmethod
    def ball(context: VerificationContext) -> JacobianBall:
        return context.balls.input

    @classmethod
    def rate_limit_of(cls, context: VerificationContext) -> None:
        """Return None, as this theorem claims no rate."""


def largest_tolerance(
    context: VerificationContext,
    weight: Float[np.ndarray, "v v"],
    theorem: type[Tolerance] = Tolerance,
) -> Tolerance | None:
    """Certificate with the largest tolerated mismatch for a weight. The largest s that is
    certified for this weight; None with a nonlinear output map, where none is found, and where
    no mismatch has an effect (K or L is zero): no number is the largest then."""
    started = time.perf_counter()
    if context.balls.output.beta > 0:
        return None
    data = theorem.loop_of(context) | vars(context.balls.input) | {"weight": weight}
    of = SimpleNamespace(**data)
    for numbers in theorem.candidates(theorem.seen(of), of.beta, *theorem.matrices(of)):
        status = numbers.pop("status")
        proof: Tolerance = theorem.proved(
            data | numbers, status=status, method="tolerance", started=started
        )
        if proof.certified:
            return proof
    return None


def _best_multiplier(
    loop: Float[np.ndarray, "x c"], into_u: Into, into_w: Into
) -> tuple[float, float]:
    """Multiplier at which the tolerated mismatch is largest, with that mismatch. The multiplier,
    and the largest s that it allows: peaks on a grid of frequencies, refined around the worst."""
    order = len(loop)
    m = len(into_u)
    outputs = np.vstack([into_u, into_w])
    direct = np.zeros((len(outputs), loop.shape[1] - order))
    system = StateSpace(a=loop[:, :order], b=loop[:, order:], c=outputs, d=direct)
    angles = np.union1d(ANGLES, np.abs(np.angle(np.linalg.eigvals(system.a))))
    response = frequency_response(system, angles)
    # the square of the largest gain from e to `beta u`, one if there is none: the scale of `1 /
    # lambda_p`
    gain = float(np.linalg.norm(response[:, :m, m:], ord=2, axis=(1, 2)).max())
    logs = np.log(MULTIPLIERS * (1 / gain**2 if gain > 0 else 1.0))

    def peak(log_multiplier: float) -> float:
        """Largest inverse squared tolerance over frequency at one logarithm of the multiplier."""
        return float(_inverse_squares(response, m, log_multiplier).max())

    best = int(np.argmin([peak(log) for log in logs]))
    around = _neighbouring_values(logs, best)
    refined = float(scipy.optimize.minimize_scalar(peak, bounds=around, method="bounded").x)
    log = min((float(logs[best]), refined), key=peak)
    worst = int(np.argmax(_inverse_squares(response, m, log)))
    near = np.linspace(*_neighbouring_values(angles, worst), len(ANGLES))
    between = float(_inverse_squares(frequency_response(system, near), m, log).max())
    highest = max(peak(log), between)
    largest = highest**-0.5 if highest > 0 else np.inf
    return float(np.exp(log)), largest


def _neighbouring_values(values: Float[np.ndarray, "K"], at: int) -> tuple[float, float]:
    """Entries before and after one entry of a sorted row, or the entry itself at an end."""
    last = len(values) - 1
    return values[max(at - 1, 0)], values[min(at + 1, last)]


def _inverse_squares(response: np.ndarray, m: int, log_multiplier: float) -> Float[np.ndarray, "F"]:
    """Inverse squared tolerance at each frequency for a multiplier. `1 / s^2` at each frequency:
    the largest eigenvalue of `M_2 (I - M_1^* M_1)^{-1} M_2^*`, infinite if that fails.

    `M_1` maps `(p, e)` to `beta u` and `M_2` to `W u`, scaled by the multiplier: `p /
    sqrt(lambda)`, `sqrt(lambda) u`.
    """
    root = np.exp(log_multiplier / 2)
    scaled = response.copy()
    scaled[:, :, :m] /= root  # the first input is p, the others e
    first = root * scaled[:, :m]
    second = scaled[:, m:]
    room = np.eye(scaled.shape[2]) - _conjugate_transpose(first) @ first
    through = second @ np.linalg.solve(room, _conjugate_transpose(second))
    hermitian = (through + _conjugate_transpose(through)) / 2
    largest = np.linalg.eigvalsh(hermitian)[:, -1]
    has_room = np.linalg.eigvalsh(room)[:, 0] > 0
    return np.where(has_room, largest, np.inf)


def _conjugate_transpose(matrices: np.ndarray) -> np.ndarray:
    """Conjugate transpose of each matrix of a stack."""
    return np.conj(matrices.transpose(0, 2, 1))


def _solve_riccati(
    loop: Float[np.ndarray, "x c"], into_u: Into, into_w: Into, lambda_p: float, slack: float
) -> Float[np.ndarray, "x x"] | None:
    """Solve the Riccati equation of the theorem for a fixed multiplier; None if there is no
    solution. `P = A^T P A + A^T P B (R - B^T P B)^{-1} B^T P A + C^T C + E`, solved in the
    Gramian's coordinates."""
    order = len(loop)
    m = len(into_u)
    a = loop[:, :order]
    b = loop[:, order:].copy()
    b[:, :m] /= lambda_p**0.5  # sqrt(lambda_p) p then has unit weight, as e has
    gramian = scipy.linalg.solve_discrete_lyapunov(a, b @ b.T)
    one = np.eye(order)
    least = FLOOR * np.trace(gramian) / order * one
    right = np.linalg.cholesky(symmetric_part(gramian) + least)
    left = np.linalg.inv(right)
    scaled_u = into_u @ right
    scaled_w = into_w @ right
    energy = scaled_u.T @ scaled_u + scaled_w.T @ scaled_w
    scaled_b = left @ b
    slack_of_energy = slack * np.trace(energy) * one
    p = solve_riccati_by_doubling(
        left @ a @ right, -scaled_b @ scaled_b.T, energy + slack_of_energy
    )
    if p is None:
        return None
    return symmetric_part(left.T @ p @ left)
