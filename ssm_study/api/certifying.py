"""Certification of the gains of an existing controller or observer. Certify gains that somebody
else designed: the largest provable rate, decided exactly."""

import math
import time
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import scipy
from jaxtyping import Float

from ssm_study.api.arguments import Slopes
from ssm_study.api.controlling import jacobian_ball_of_slopes
from ssm_study.api.design import Design
from ssm_study.api.known_maps import describe_slope_range
from ssm_study.api.loop_of_both import add_loop_verdict, describe_loop_verdict, unstable_loop_text
from ssm_study.api.missing_rate import describe_uncontrollable_mode, explain_uncertifiable_gain
from ssm_study.api.summaries import html_table, rate_text, render_text_table
from ssm_study.api.systems import read_linear_system, read_matrix, read_matrix_or_vector
from ssm_study.certificates.certificate import GainTheorem
from ssm_study.certificates.decay_time import decay_time_text
from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.certificates.problem import (
    NoSolution,
    Problem,
    Solution,
    linear_algebra_failures_as_no_solution,
)
from ssm_study.certificates.theorems.deployed_rate import INSIDE, LARGEST_RATE, SLACKS, largest_rate
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.refusal import require
from ssm_study.synthesis.modes import least_metric
from ssm_study.systems import JacobianBall, spectral_radius

MATRICES = "give A, B, C (for example P.A, P.B, P.C)"
SMALLEST_RATE = 1e-9  # what is asked of the problem while its gain is analysed


@dataclass(frozen=True, kw_only=True, repr=False)
class GainCertificate:
    """Result of certifying one gain: the proved contraction rate with its certificate, or the
    reason why no rate is proved.

    For every slope s in `slopes`, with `P = certificate.p` of a state feedback and `Q =
    certificate.q` of an observer (other letters of the certificate: [Z26], (11) and (15)),

        (1 - rate) P - (A + s B K) P (A + s B K)' > 0,
        (1 - rate) Q - (A + s L C)' Q (A + s L C) > 0.

    So `metric`, M = P^{-1} or Q, is a metric in which distances `sqrt(dx' M dx)` are multiplied by
    at most `sqrt(1 - rate)` each sample: between two trajectories with the state measured, or from
    the estimate to the state. Euclidean distances are at most `overshoot` times what they were, at
    any time. With several channels the slopes stand for the ball of all Jacobians J with `||J - a
    I|| <= b`, which is more than each channel by itself (a the mean slope, b half the range).

    `rate` is confirmed in exact arithmetic, at most 0.1 % inside `rate_of_gain` in most cases, and
    None where nothing is. `rate_of_gain` is the supremum over constant quadratic metrics for this
    gain, `rate_limit` that of all gains, `rate_without` that of no gain (negative where the system
    alone does not contract); these three are floats, not certificates.
    """

    rate: float | None
    certificate: GainTheorem | None
    rate_of_gain: float
    rate_limit: float
    rate_without: float
    reason: str
    slopes: tuple[float, float]

    def __repr__(self) -> str:
        name = "observer" if self.is_observer else "gain"
        rows = gain_certificate_lines(name, self)
        lines = pd.Series(rows, dtype=object)
        return render_text_table("GainCertificate", lines)

    @property
    def certified(self) -> bool:
        """Whether a contraction rate is proved in exact arithmetic for the gain."""
        return self.certificate is not None and self.certificate.certified

    @property
    def metric(self) -> Float[np.ndarray, "n n"] | None:
        """Metric in which distances between trajectories contract, as a matrix; None without a
        certificate. It is the inverse of the certificate's `p`, or its `q`."""
        if self.certificate is None:
            return None
        metric_name = self.certificate.metric_matrix
        matrix = getattr(self.certificate, metric_name)
        metric: Float[np.ndarray, "n n"] = matrix if self.is_observer else np.linalg.inv(matrix)
        return metric

    @property
    def is_observer(self) -> bool:
        """Whether the certified gain is that of an observer."""
        return self.certificate is not None and self.certificate.observes

    @property
    def overshoot(self) -> float | None:
        """Largest possible growth of a Euclidean distance between trajectories: the square root of
        the condition number of the certificate's metric. None without a certificate."""
        metric = self.metric
        return None if metric is None else float(np.sqrt(np.linalg.cond(metric)))


@dataclass(frozen=True, kw_only=True, repr=False)
class Certification:
    """Certificates of a given state-feedback gain, of a given observer gain, or of both. None
    stands for a gain that was not given.

    `unknown_maps` are the static maps of which only a range of slopes was given, and
    `unstable_example` is an unstable loop within these slopes, if one was found; its observer has
    the mean slopes.
    """

    controller: GainCertificate | None
    observer: GainCertificate | None
    unknown_maps: dict[str, str] = field(default_factory=dict)
    unstable_example: str | None = None

    @property
    def certified(self) -> bool:
        """Whether every given gain is certified, and the closed loop of both if both were given."""
        return bool(self.verdicts) and all(self.verdicts.values())

    @property
    def verdicts(self) -> dict[str, bool]:
        """Verdicts of exact arithmetic, by name, on each given gain and on the closed loop of
        controller and observer. `u = K xh`; the loop is judged where both gains are given.

        The loop is certified where both gains are and the observer computes the plant's own maps;
        it cannot where `unknown_maps` has an entry.
        """
        gains = {"controller": self.controller, "observer": self.observer}
        verdicts = {name: gain.certified for name, gain in gains.items() if gain is not None}
        if len(verdicts) < len(gains):
            return verdicts
        return add_loop_verdict(verdicts, self.unknown_maps)

    def summary(self) -> pd.Series:
        """Table of each gain's proved rate, rate limit and reason for failure, and the loop's
        verdict."""
        lines: dict[str, str] = {}
        for name, gain in (("controller", self.controller), ("observer", self.observer)):
            if gain is not None:
                lines |= gain_certificate_lines(name, gain)
        if "loop" in self.verdicts:
            lines["loop of both"] = describe_loop_verdict(
                self.verdicts, self.unknown_maps, self.unstable_example
            )
        return pd.Series(lines, name="certification", dtype=object)

    def __repr__(self) -> str:
        return render_text_table("Certification", self.summary())

    def _repr_html_(self) -> str:
        """Render the certificates as an HTML table for notebooks."""
        return html_table("Certification", self.summary())


def gain_certificate_lines(name: str, gain: GainCertificate) -> dict[str, str]:
    """Rows of a printed table on one certified gain: its rate, slopes, overshoot and limits. `name`
    is controller or observer."""
    lines = {name: f"nothing is proved: {gain.reason}"}
    if gain.rate is not None:
        rate = f"rate {rate_text(gain.rate, 6)} per sample"
        decay = decay_time_text(gain.rate)
        lines[name] = f"contracts at {rate} ({decay}), decided exactly"
        if gain.is_observer:
            lines[name] += ", if it computes the plant's own input and output maps"
    lines[f"{name}, slopes"] = _describe_slopes(name, gain.slopes)
    if gain.overshoot is not None:
        thousandths = gain.overshoot * 1000
        growth = math.ceil(thousandths) / 1000
        lines[f"{name}, overshoot"] = f"Euclidean distances grow at most {growth:g} times"
    lines[f"{name}, without it"] = _describe_largest_rate(gain.rate_without)
    lines[f"{name}, this gain"] = _describe_largest_rate(gain.rate_of_gain)
    lines[f"{name}, any gain"] = _describe_largest_rate(gain.rate_limit)
    return lines


def _describe_largest_rate(rate: float) -> str:
    """Text on the largest contraction rate that a constant quadratic metric can prove."""
    return f"provable below {rate_text(rate, 6)}" if rate > 0 else "no rate is provable"


def _describe_slopes(name: str, slopes: tuple[float, float]) -> str:
    """Text with the name of a static map and the range of slopes for which a certificate holds."""
    lowest, highest = (f"{slope:.6g}" for slope in slopes)
    is_one_slope = slopes[0] == slopes[1]
    between = lowest if is_one_slope else f"{lowest} to {highest}"
    return f"{between} of the {'output' if name == 'observer' else 'input'} map"


def certify(
    A: Any,
    B: Any = None,
    C: Any = None,
    *,
    K: Any = None,
    L: Any = None,
    slopes: Slopes = (1.0, 1.0),
    output_slopes: Slopes = (1.0, 1.0),
) -> Certification:
    """Certify given state-feedback and observer gains with the largest contraction rate that can be
    proved.

    K enters as `u = K x`, L as `L (S_y(C xh) - y)`: of `x+ = A x + B S_u(u)`, every slope of `S_u`
    in `slopes`, and of the observer `xh+ = A xh + B S_u(u) + L (S_y(C xh) - y)`, every slope of
    `S_y` in `output_slopes`. Either gain may be left out. In place of A, B, C a python-control
    state space or `(A, B, C, D, step_s)` may stand alone. A rate `rho` means that
    distances in the metric of the certificate are multiplied by at most `sqrt(1 - rho)` each
    sample, however the slopes vary; whether it holds is decided in exact arithmetic. With several
    inputs (outputs) `slopes` stand for all maps whose Jacobians lie within the ball around the mean
    slope. `rate` is 0.1 % inside what the gain allows. `controller.certificate.k` and
    `observer.certificate.l` are the gains of the result.

    The loop of both, `u = K xh`, comes to rest where both gains are certified and the observer
    computes the plant's own S_u and S_y. It does where each range is one known gain `(g, g)`; where
    a range is wider the third entry of `verdicts`, and with it `certified`, is False: the proof
    does not cover an observer that computes another map. As in a `Design`, `certified` says whether
    all of `verdicts` hold. Source: [Z26] Theorems 1 and 2 at given gains.

    Raises `BadRequest` for matrices that do not fit, and where no gain is given.

    >>> import ssm_study as st
    >>> proof = st.certify([[1.0]], [[1.0]], K=[[-0.7]], slopes=(0.8, 1.2))
    >>> print(f"{proof.controller.rate:.3f} of {proof.controller.rate_of_gain:.4f}")
    0.806 of 0.8064
    >>> proof = st.certify([[0.9]], C=[[1.0]], L=[[-0.6]], output_slopes=(0.9, 1.1))
    >>> print(f"{proof.observer.rate:.3f}, {proof.observer.certificate.l}")
    0.870, [[-0.6]]
    """
    if B is None and C is None:
        A, B, C = read_system_to_certify(A)
    has_a_gain = K is not None or L is not None
    require(has_a_gain, "K, L", None, "no gain is given", "give one or both")
    a = read_matrix("A", A, (None, None))
    n = len(a)
    a = read_matrix("A", a, (n, n))
    controller = observer = None
    if K is not None:
        has_input_matrix = B is not None
        require(has_input_matrix, "B", None, "a state feedback needs it", "give the input matrix")
        b = read_matrix_or_vector("B", B, (n, None))
        inputs = b.shape[1]
        k = read_matrix("K", K, (inputs, n))
        jacobian_ball = jacobian_ball_of_slopes("slopes", slopes)
        controller = certify_gain(a, b, k, jacobian_ball, StateFeedbackOfBall)
        controller = replace(controller, slopes=(float(slopes[0]), float(slopes[1])))
    if L is not None:
        has_output_matrix = C is not None
        require(has_output_matrix, "C", None, "an observer needs it", "give the output matrix")
        c = read_matrix("C", C, (None, n))
        outputs = len(c)
        gain = read_matrix_or_vector("L", L, (n, outputs))
        ball = jacobian_ball_of_slopes("output_slopes", output_slopes)
        observer = certify_gain(a.T, c.T, gain.T, ball, ObserverOfBall)
        output_range = (float(output_slopes[0]), float(output_slopes[1]))
        observer = replace(observer, slopes=output_range)
    result = Certification(controller=controller, observer=observer)
    if controller is None or observer is None:
        return result
    ranges = {"slopes": controller.slopes, "output_slopes": observer.slopes}
    unknown = {
        name: describe_slope_range(name, *ends)
        for name, ends in ranges.items()
        if ends[0] < ends[1]
    }
    example = unstable_loop_text(a, b @ k, gain @ c, controller.slopes, observer.slopes)
    shown_example = example if unknown else None
    return replace(result, unknown_maps=unknown, unstable_example=shown_example)


def read_system_to_certify(system: Any) -> tuple[Any, Any, Any]:
    """Read matrices A, B and C of a linear system; B and C are None where only a state matrix is
    given.

    Raises `BadRequest` for a transfer function, whose states are not known, and for a design or
    any other object.
    """
    kind = type(system).__name__
    is_tuple = isinstance(system, tuple)
    is_linear_system = is_tuple and len(system) == 5 and np.ndim(system[-1]) == 0
    if is_linear_system or all(hasattr(system, name) for name in ("A", "B", "C", "D", "dt")):
        linear, _ = read_linear_system(system)
        return linear.a, linear.b, linear.c
    problem = "is no state space, and the gains act on its states"
    require(not hasattr(system, "num"), "A", kind, problem, f"convert it: control.ss; {MATRICES}")
    is_design = isinstance(system, Design)
    require(not is_design, "A", kind, "has certificates of its own", f"print it, or {MATRICES}")
    is_object = hasattr(system, "__dict__")
    foreign = is_object and not hasattr(system, "__array__")
    require(not foreign, "A", kind, "is no matrix of numbers", MATRICES)
    return system, None, None


def certify_gain(
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n m"],
    k: Float[np.ndarray, "m n"],
    ball: JacobianBall,
    theorem: type[GainTheorem],
) -> GainCertificate:
    """Find the largest contraction rate that a given gain achieves, and prove it in exact
    arithmetic.

    For an observer the matrices are transposed: `a = A^T, b = C^T, k = L^T`.
    """
    matrices = (a, b, k)
    a, b, k = (np.ascontiguousarray(matrix) for matrix in matrices)
    frontier = contraction_frontier(a, b, ball)
    limit = frontier.rate_limit
    rate_of_gain = largest_rate(a, b, k, ball)
    supremum = min(rate_of_gain, LARGEST_RATE)
    open_loop_radius = spectral_radius(a)
    rate_without = 1 - open_loop_radius**2
    result = partial(
        GainCertificate,
        rate_of_gain=supremum,
        rate_limit=limit,
        rate_without=rate_without,
        slopes=(ball.lower, ball.upper),
    )
    if supremum <= 0:
        reason = describe_uncontrollable_mode(frontier, theorem.observes)
        reason = reason or explain_uncertifiable_gain(a, b @ k, ball)
        return result(rate=None, certificate=None, reason=reason)
    problem_rate = max(SMALLEST_RATE, 0.5 * supremum)
    state_weight = np.eye(len(a))
    problem = Problem(
        a=a, b=b, ball=ball, rate=problem_rate, state_weight=state_weight, input_weight=1.0
    )
    for inside, slack in product(INSIDE, SLACKS):
        rate = supremum * (1 - inside)
        problem_at_rate = problem.at_rate(rate)
        part = _prove_rate(problem_at_rate, k, slack, supremum, limit, theorem)
        if part is not None and part.certified:
            reason = f"{inside:.1%} inside the supremum {supremum:.6g}"
            return result(rate=rate, certificate=part, reason=reason)
    reason = "floats hold no metric close to the supremum; scale the states"
    return result(rate=None, certificate=None, reason=reason)


def _prove_rate(
    problem: Problem,
    k: Float[np.ndarray, "m n"],
    slack: float,
    supremum: float,
    limit: float,
    theorem: type[GainTheorem],
) -> GainTheorem | None:
    """Certificate that a gain achieves a required contraction rate; None if no quadratic metric is
    found."""
    started = time.perf_counter()
    remaining_rate = 1 - problem.rate
    factor = float(((1 - supremum) * remaining_rate) ** 0.25)  # between the two, in log r
    try:
        with linear_algebra_failures_as_no_solution():
            coordinates = _well_conditioned_coordinates(problem, k, factor)
            inverse = np.linalg.inv(coordinates)
            p = least_metric(problem, k, factor, coordinates, inverse, slack)
    except NoSolution:
        return None
    solution = Solution(p=p, y=p, k=k, sigma=1.0, status="bounded-real equation")
    numbers = theorem.certificate_numbers(problem, solution)
    part: GainTheorem = theorem.from_numbers(
        numbers, rate_limit=limit, method="given", status=solution.status, started=started
    )
    return part


def _well_conditioned_coordinates(
    problem: Problem, k: Float[np.ndarray, "m n"], factor: float
) -> Float[np.ndarray, "n n"]:
    """State coordinates in which the matrices of a certificate for a given gain are well
    conditioned. They are a Cholesky factor of the loop's own Gramian at the mean slope."""
    alpha = problem.ball.alpha
    closed_loop = problem.a + alpha * problem.b @ k
    closed = closed_loop / factor
    input_gramian = problem.b @ problem.b.T
    drive = input_gramian / factor**2
    mean_eigenvalue = float(np.trace(drive)) / len(drive)
    smallest_float = np.finfo(float).tiny
    size = max(mean_eigenvalue, smallest_float)
    regularisation = 1e-6 * size * np.eye(len(drive))
    right_side = drive + regularisation
    gramian = scipy.linalg.solve_discrete_lyapunov(closed, right_side)
    symmetric_gramian = (gramian + gramian.T) / 2
    lower: Float[np.ndarray, "n n"] = np.linalg.cholesky(symmetric_gramian)
    return lower
