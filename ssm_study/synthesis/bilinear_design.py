"""Gains of controller and observer for a bilinear model, and the certificates of its closed loop.

Gains are those of least guaranteed cost over all vertices (semidefinite programs); then metrics are
sought for these gains, as they are rounded. What counts is decided afterwards in exact arithmetic.
Source: docs/theory.md, "Products of input and state".
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from jaxtyping import Float

from ssm_study.certificates.bilinear_certificates import BilinearDesign
from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.theorem import Theorem
from ssm_study.certificates.theorems.bilinear_contraction import BilinearContraction
from ssm_study.certificates.theorems.bilinear_everywhere import BilinearEverywhere
from ssm_study.certificates.theorems.bilinear_loop import BilinearLoop
from ssm_study.models.bilinear import Bilinear
from ssm_study.refusal import require_positive
from ssm_study.synthesis.bilinear_gains import (
    SOLVER,
    STRICT,
    Matrix,
    feedback_gain,
    input_vector_slopes,
    observer_gains,
    solve_or_raise,
    symmetric_solution_matrix,
)
from ssm_study.systems import spectral_radius

HALVINGS = 6  # of the interval in which a factor is sought
ROUNDING = 1e-6  # relative: what keeps an inequality strict after numbers are rounded
BACK_OFF = 0.05  # share of the way from the least factor to one, which leaves room for the metric
OBSERVER_SHARE = 0.25  # of the way from the observer's factor to one, that of the loop at least
SENSOR_NOISE = 0.05  # deviation of the sensor's noise, scaled units
LARGEST_FACTOR = 0.98  # of a set that is said to contract


@dataclass(frozen=True, kw_only=True)
class BilinearSynthesis:
    """Settings of the design for a bilinear model: weight of the input in the cost, and standard
    deviation of the sensor noise."""

    input_weight: float = 1.0
    sensor_noise: float = SENSOR_NOISE

    def __post_init__(self) -> None:
        require_positive("input_weight", self.input_weight, "try 1")
        require_positive("sensor_noise", self.sensor_noise, "try 0.05")

    def design(self, model: Bilinear) -> BilinearDesign:
        """Design controller and observer of a bilinear model, and certify their closed loop."""
        try:
            k = feedback_gain(model, self.input_weight)
            gains = observer_gains(model, self.sensor_noise)
        except NoSolution as failure:
            k = np.zeros((1, model.order))
            node_count = len(model.nodes)
            output_count = len(model.c)
            gains = np.zeros((node_count, model.order, output_count))
            failure_text = str(failure)
            return BilinearDesign(k=k, l_nodes=gains, parts={}, reasons={"gains": failure_text})
        loop = LoopVertices(model=model, k=k, gains=gains)
        parts: dict[str, Theorem] = {}
        reasons: dict[str, str] = {}
        searches: dict[str, Callable[[LoopVertices], Theorem]] = {
            BilinearLoop.part: certify_bilinear_loop,
            BilinearEverywhere.part: certify_loop_from_any_state,
            BilinearContraction.part: certify_bilinear_contraction,
        }
        for label, certify in searches.items():
            try:
                parts[label] = certify(loop)
            except NoSolution as failure:
                reasons[label] = str(failure)
        return BilinearDesign(k=k, l_nodes=gains, parts=parts, reasons=reasons)


@dataclass(frozen=True, kw_only=True)
class LoopVertices:
    """Matrices of a bilinear closed loop at its input levels (nodes) and segments between levels,
    with contraction metrics."""

    model: Bilinear
    k: Float[np.ndarray, "1 n"]
    gains: Float[np.ndarray, "q n p"]

    @property
    def largest_input_amplitude(self) -> float:
        """Largest input amplitude, in both directions, that stays between the outermost input
        levels (nodes) of a bilinear model."""
        down = self.model.nodes[0]
        up = self.model.nodes[-1]
        return float(min(-down, up))

    @cached_property
    def closed_loop_matrices(self) -> list[Matrix]:
        """Closed-loop matrices `A_i + B_k K` for all input levels i and segments k."""
        state_matrices = self.model.a
        return [a + b @ self.k for a in state_matrices for b in input_vector_slopes(self.model)]

    @cached_property
    def estimation_error_matrices(self) -> list[Matrix]:
        """Matrices `A_i + L_i C` of the estimation error at all input levels (nodes)."""
        pairs = zip(self.model.a, self.gains, strict=True)
        return [a + gain @ self.model.c for a, gain in pairs]

    @property
    def smallest_allowed_metric(self) -> Matrix:
        """Lower bound `K^T K` on the state's metric P, which ensures `|K x|^2 <= x^T P x`."""
        squared_gain = self.k.T @ self.k
        identity = np.eye(self.model.order)
        return squared_gain + ROUNDING * identity

    @cached_property
    def state_metric(self) -> Matrix:
        """Metric in which the state contracts under the state feedback."""
        reason = "no metric is found in which the state shrinks at all input levels"
        return contraction_metric(self.closed_loop_matrices, self.smallest_allowed_metric, reason)

    @cached_property
    def metric_with_and_without_feedback(self) -> Matrix:
        """Metric in which the state contracts with and without the state feedback."""
        reason = "the model without control is not shown to come to rest at all input levels"
        uncontrolled = self.model.a
        return contraction_metric(
            [*self.closed_loop_matrices, *uncontrolled], self.smallest_allowed_metric, reason
        )

    @cached_property
    def estimation_error_metric(self) -> Matrix:
        """Metric in which the estimation error contracts."""
        reason = "no metric is found in which the observer's error shrinks"
        return contraction_metric(
            self.estimation_error_matrices, self.smallest_allowed_metric, reason
        )


def contraction_metric(matrices: list[Matrix], least_metric: Matrix, failure_reason: str) -> Matrix:
    """Smallest metric in which several given matrices all contract, at nearly the smallest possible
    common factor. Raises `NoSolution` with the reason where none is found."""
    highest = 1.0 - 10.0 * ROUNDING
    metric = metric_for_factor(matrices, highest, least_metric, failure_reason)
    lowest = max(spectral_radius(matrix) for matrix in matrices)
    for _ in range(HALVINGS):
        factor = 0.5 * (lowest + highest)
        try:
            metric = metric_for_factor(matrices, factor, least_metric, failure_reason)
            highest = factor
        except NoSolution:
            lowest = factor
    try:
        back_off = BACK_OFF * (1.0 - highest)
        return metric_for_factor(matrices, highest + back_off, least_metric, failure_reason)
    except NoSolution:
        return metric


def metric_for_factor(
    matrices: list[Matrix], factor: float, least_metric: Matrix, failure_reason: str
) -> Matrix:
    """Metric in whose norm several given matrices all contract by a given factor."""
    n = len(least_metric)
    p = cp.Variable((n, n), symmetric=True)
    constraints = [p >> least_metric]
    for matrix in matrices:
        contracted = factor**2 * p
        moved = matrix.T @ p
        rows = [[contracted, moved], [p @ matrix, p]]
        whole_matrix = cp.bmat(rows)
        identity = np.eye(2 * n)
        constraints.append(whole_matrix >> STRICT * identity)
    trace = cp.trace(p)
    program = cp.Problem(cp.Minimize(trace), constraints)
    status = solve_or_raise(program, failure_reason)
    if not status.endswith("optimal"):
        raise NoSolution(f"{failure_reason} ({status})")
    return symmetric_solution_matrix(p)


def largest_norm_ratio(matrices: list[Matrix], metric: Matrix) -> float:
    """Largest factor by which any of several matrices can increase the norm of a vector in a given
    metric, rounded up."""
    root = np.linalg.cholesky(metric).T
    inverse = np.linalg.inv(root)
    norms = [float(np.linalg.norm(root @ matrix @ inverse, 2)) for matrix in matrices]
    largest_norm = max(*norms, ROUNDING)
    return largest_norm * (1.0 + ROUNDING)


def gain_between_metrics(
    matrix: Float[np.ndarray, "_ n"],
    metric: Matrix,
    output_metric: Float[np.ndarray, "_ _"] | None = None,
) -> float:
    """Smallest g with `|M x| <= g |x|` for a matrix M, both sides in the norms of given metrics,
    rounded up."""
    factor_of_metric = np.linalg.cholesky(metric)
    inverse = np.linalg.inv(factor_of_metric.T)
    left = np.eye(len(matrix)) if output_metric is None else np.linalg.cholesky(output_metric).T
    transformed = left @ matrix @ inverse
    return max(float(np.linalg.norm(transformed, 2)), ROUNDING) * (1.0 + ROUNDING)


def model_and_feedback_fields(loop: LoopVertices, p: Matrix) -> dict[str, Any]:
    """Fields that every certificate of a bilinear closed loop stores: model matrices,
    state-feedback gain and its metric."""
    model = loop.model
    a_nodes = model.a.reshape(-1, model.order)
    factor_controller = largest_norm_ratio(loop.closed_loop_matrices, p)
    return {
        "alpha": 1.0,
        "beta": 0.0,
        "nodes": model.nodes,
        "a_nodes": a_nodes,
        "b_nodes": model.b,
        "k": loop.k,
        "p": p,
        "factor_controller": factor_controller,
    }


def observer_fields(loop: LoopVertices, p: Matrix, least_factor: float) -> dict[str, Any]:
    """Fields that every certificate of a bilinear closed loop with an observer stores: observer
    gains and their metric."""
    model = loop.model
    m = loop.estimation_error_metric
    factor_observer = largest_norm_ratio(loop.estimation_error_matrices, m)
    columns = input_vector_slopes(model)
    coupling = max(gain_between_metrics(b @ loop.k, m, p) for b in columns)
    through_observer = factor_observer + OBSERVER_SHARE * (1.0 - factor_observer)
    back_off = BACK_OFF * (1.0 - least_factor)
    above = least_factor + ROUNDING + back_off
    factor = max(above, through_observer)
    observer_nodes = loop.gains.reshape(-1, len(model.c))
    weight = coupling / (factor - factor_observer)
    return {
        "c": model.c,
        "l_nodes": observer_nodes,
        "m": m,
        "factor_observer": factor_observer,
        "coupling": coupling,
        "weight": weight * (1.0 + ROUNDING),
        "factor": factor,
    }


def certify_bilinear_loop(loop: LoopVertices) -> BilinearLoop:
    """Certificate that the closed loop of a bilinear model comes to rest from a set of initial
    states."""
    started = time.perf_counter()
    refuse_one_sided_input(loop)
    numbers = model_and_feedback_fields(loop, loop.state_metric)
    numbers |= observer_fields(loop, loop.state_metric, numbers["factor_controller"])
    gain_state = gain_between_metrics(loop.k, loop.state_metric)
    gain_error = gain_between_metrics(loop.k, loop.estimation_error_metric)
    reach_of_error = gain_error / numbers["weight"]
    reach = max(gain_state, reach_of_error)
    numbers["gain_state"] = gain_state
    numbers["gain_error"] = gain_error
    radius = loop.largest_input_amplitude / reach
    numbers["radius"] = radius * (1.0 - ROUNDING)
    return certify_exactly(BilinearLoop, numbers, started)


def certify_loop_from_any_state(loop: LoopVertices) -> BilinearEverywhere:
    """Certificate that the closed loop of a bilinear model with a limited input comes to rest from
    every initial state."""
    started = time.perf_counter()
    p = loop.metric_with_and_without_feedback
    numbers = model_and_feedback_fields(loop, p)
    state_matrices = loop.model.a
    uncontrolled = largest_norm_ratio([*state_matrices], p)
    numbers["factor_uncontrolled"] = uncontrolled
    least_factor = max(numbers["factor_controller"], uncontrolled)
    numbers |= observer_fields(loop, p, least_factor)
    return certify_exactly(BilinearEverywhere, numbers, started)


def certify_bilinear_contraction(loop: LoopVertices) -> BilinearContraction:
    """Certificate that any two trajectories of a bilinear closed loop approach each other inside a
    set of states."""
    started = time.perf_counter()
    refuse_one_sided_input(loop)
    model = loop.model
    numbers = model_and_feedback_fields(loop, loop.state_metric)
    node_distances = np.diff(model.nodes)
    widths = node_distances[:, None, None]
    changes_of_a = np.diff(model.a, axis=0)
    changes = changes_of_a / widths
    variation = largest_norm_ratio([*changes], loop.state_metric)
    gain_state = gain_between_metrics(loop.k, loop.state_metric)
    slope = variation * gain_state
    controller = numbers["factor_controller"]
    middle_factor = 0.5 * (1.0 + controller)
    largest = max(LARGEST_FACTOR, middle_factor)
    slope_radius = (largest - controller) / slope
    limit_radius = loop.largest_input_amplitude / gain_state
    radius = min(slope_radius, limit_radius)
    radius *= 1.0 - ROUNDING
    change_of_factor = radius * slope * (1.0 + ROUNDING)
    factor = controller + change_of_factor + STRICT
    numbers |= {
        "gain_state": gain_state,
        "variation": variation,
        "radius": radius,
        "factor": factor,
    }
    return certify_exactly(BilinearContraction, numbers, started)


def refuse_one_sided_input(loop: LoopVertices) -> None:
    """Raise `NoSolution` if the equilibrium input is at an end of the recorded range, so that a
    controller could act in one direction only."""
    if loop.largest_input_amplitude <= 0.0:
        raise NoSolution("the equilibrium of the input is an end of the inputs that the log has")


def certify_exactly(theorem: Any, numbers: dict[str, Any], start_time: float) -> Any:
    """Certificate made from given numbers and decided in exact arithmetic; raises `NoSolution` if
    exact arithmetic refuses it."""
    status = f"{SOLVER.lower()}: optimal"
    certificate = theorem.from_numbers(
        numbers, started=start_time, status=status, method="vertices"
    )
    if not certificate.certified:
        raise NoSolution("the solver's numbers do not prove it in exact arithmetic")
    return certificate
