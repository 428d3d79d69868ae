"""Matrix inequalities of models with neurons, solved directly by the library CVXPY. They check the
game Riccati route independently.

Linear in `(P, X, T, sigma)` for a state feedback and in `(Q, V, Lambda, N, eta)` for an observer;
`Y = P`, `U = Q`. For a ball without radius the rows of its multiplier are left out. Source:
docs/theory.md; the inequalities stand in `theorems.structured_state_feedback` and
`theorems.structured_observer`.
"""

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import LETTERS, GainTheorem
from ssm_study.certificates.problem import Neurons, NoSolution, Problem, Solution, symmetric_part
from ssm_study.certificates.semidefinite import solve_program
from ssm_study.certificates.theorem import Blocks
from ssm_study.certificates.theorems import structured_observer, structured_state_feedback
from ssm_study.synthesis.objectives import goal_and_constraints
from ssm_study.synthesis.structured_riccati import log_multipliers, zero_radius_multiplier

Rows = Float[np.ndarray, "_ _"]

# How far below the largest rate of given gains a certificate is stored, as a share of it.
INSIDE = 1e-3
RATE_STEPS = 12  # halvings of the interval of rates: to 1/4096


class StructuredLmi:
    """Matrix inequality of a synthesis problem with neurons, compiled once and solved for any
    contraction rate.

    `objective` as in `objectives.goal_and_constraints`; a state feedback's cost stands beside the
    state, an observer's noise where the step arrives. With `fixed` the gains are that solution's,
    and only the metric and the multipliers are sought; `of.k` holds the gain, so that one program
    proves many.
    """

    def __init__(self, *, problem: Problem, objective: str, fixed: Solution | None = None) -> None:
        self.problem = problem
        self.fixed = fixed
        neurons = problem.required_neurons.in_balanced_units()
        self.of = self._program_variables(neurons)
        upper, multiplier_rows = self._inequality_blocks(self.of, neurons)
        if problem.ball.beta == 0:
            upper = _delete_block_rows(upper, multiplier_rows)
        complex_root = scipy.linalg.sqrtm(problem.state_weight)
        root = np.real(complex_root)
        weighted_state = root @ self.of.p
        weight_root = np.sqrt(problem.input_weight)
        weighted_input = weight_root * self.of.x
        performance = [weighted_state, weighted_input]
        at = len(upper) - 1 if neurons.observes else 0
        p = self.of.p
        goal, constraints = goal_and_constraints(objective, upper, p, at, performance)
        a = cp.Minimize(goal)
        self.program = cp.Problem(a, constraints)

    def _program_variables(self, neurons: Neurons) -> SimpleNamespace:
        """Variables and parameters of the semidefinite program, keyed by the theorem's symbols."""
        n, m = self.problem.b.shape
        ball = self.problem.ball
        of = SimpleNamespace(alpha=ball.alpha, beta=ball.beta)
        parameter_value = None if self.fixed is None else self.fixed.k
        gain_shape = (m, n)
        of.k = cp.Parameter(gain_shape, value=parameter_value)
        metric_shape = (n, n)
        of.p = cp.Variable(metric_shape, symmetric=True)
        of.x = cp.Variable((m, n)) if self.fixed is None else of.k @ of.p
        neuron_count = neurons.e.shape[1]
        of.t = cp.Variable(neuron_count)
        of.sigma = cp.Variable() if ball.beta > 0 else 0.0
        of.rate = cp.Parameter()
        return of

    def _inequality_blocks(self, symbols: Any, neurons: Neurons) -> tuple[Blocks, list[int]]:
        """Blocks of the matrix inequality for a model with neurons, and the indices of the rows for
        the static map's slopes."""
        q, m = neurons.g.shape
        t = cp.diag(symbols.t)
        a = self.problem.a
        b = self.problem.b
        neuron_matrices = {"e": neurons.e, "f": neurons.f, "g": neurons.g}
        data = {"a": a, "b": b, **neuron_matrices}
        if not neurons.observes:
            variables = vars(symbols)
            named = SimpleNamespace(**variables, **data, y=symbols.p)
            identity = np.eye(q)
            row = (identity, t, t)
            blocks = structured_state_feedback.structured_feedback_inequality(named, row)
            return blocks, [1, 4]
        symbols.n = cp.Variable((q, m)) if neurons.allows_injection else np.zeros((q, m))
        if self.fixed is not None and self.fixed.k_w is not None:
            k_w = self.fixed.k_w
            injected = k_w / self.problem.required_neurons.neuron_scales
            symbols.n = t @ injected.T
        transposed = {LETTERS[letter]: matrix.T for letter, matrix in data.items()}
        transposed_gain = symbols.x.T
        unknowns = {"q": symbols.p, "u": symbols.p, "v": transposed_gain, "eta": symbols.sigma}
        named = SimpleNamespace(**vars(symbols), **transposed, **unknowns)
        blocks = structured_observer.structured_observer_inequality(named, t, symbols.n)
        return blocks, [1]

    def solve(self, rate: float, solver: str = "CLARABEL") -> Solution:
        """Gain, metric and multipliers that satisfy the matrix inequality at a given contraction
        rate. Raises `NoSolution` with the solver's status if there are none."""
        of = self.of
        fixed = self.fixed
        neurons = self.problem.required_neurons
        of.rate.value = rate
        status = solve_program(self.program, solver)
        p = symmetric_part(of.p.value)
        k = of.k.value
        if fixed is None:
            gain_product = of.x.value.T
            k = scipy.linalg.solve(p, gain_product, assume_a="sym").T
        weights = of.t.value if neurons.observes else 1 / of.t.value
        neuron_count = len(of.t.value)
        k_w = np.zeros((len(k), neuron_count))
        if fixed is None and neurons.allows_injection:
            injection_product = of.n.value
            weight_column = weights[:, None]
            injection = injection_product / weight_column
            k_w = injection.T
        has_ball = self.problem.ball.beta > 0
        sigma = float(of.sigma.value) if has_ball else zero_radius_multiplier(self.problem, p, k)
        scaled = Solution(p=p, y=p, k=k, k_w=k_w, sigma=sigma, multipliers=weights, status=status)
        solution = scaled.undo_neuron_scaling(neurons)
        return solution if fixed is None else replace(solution, k_w=fixed.k_w)

    @classmethod
    def for_fixed_gains(cls, problem: Problem) -> "StructuredLmi":
        """Semidefinite program that proves contraction rates for fixed gains that do not act on the
        neurons."""
        n, m = problem.b.shape
        identity = np.eye(n)
        required_neurons_e = problem.required_neurons.e
        neuron_count = required_neurons_e.shape[1]
        none = np.zeros((m, neuron_count))
        k = np.zeros((m, n))
        fixed = Solution(p=identity, y=identity, k=k, sigma=1.0, status="", k_w=none)
        return cls(problem=problem, objective="largest_margin", fixed=fixed)

    def prove_rate(self, k: Rows) -> Solution:
        """Metric and multipliers that prove the requested contraction rate for a given gain. Raises
        `NoSolution` if there are none."""
        self.of.k.value = k
        solution = self.solve(self.problem.rate)
        if not is_confirmed_exactly(self.problem, solution):
            raise NoSolution(f"not certified for all slopes at rate {self.problem.rate:.6g}")
        return solution


def _delete_block_rows(upper_blocks: Blocks, deleted_indices: list[int]) -> Blocks:
    """Upper triangle of a symmetric block matrix without some of its block rows and columns."""
    block_count = len(upper_blocks)
    rows = [i for i in range(block_count) if i not in deleted_indices]
    return [[upper_blocks[i][j - i] for j in rows if j >= i] for i in rows]


def is_confirmed_exactly(problem: Problem, solution: Solution) -> bool:
    """Whether exact arithmetic confirms the matrices that a solver returned for a model with
    neurons."""
    theorem: type[GainTheorem] = structured_state_feedback.StructuredStateFeedback
    if problem.required_neurons.observes:
        theorem = structured_observer.StructuredObserver
    numbers = theorem.certificate_numbers(problem, solution)
    return theorem.holds(**numbers)


def largest_rate_with_neurons(problem: Problem, fixed: Solution | None = None) -> float:
    """Largest contraction rate that the solver finds for a model with neurons; 0 if there is
    none."""
    return fastest_confirmed_solution(problem, fixed)[0]


def fastest_confirmed_solution(
    problem: Problem, fixed_gains: Solution | None = None
) -> tuple[float, Solution | None]:
    """Largest contraction rate that exact arithmetic confirms for a model with neurons, by
    bisection, and the matrices that prove it."""
    program = StructuredLmi(problem=problem, objective="largest_margin", fixed=fixed_gains)
    low = 0.0
    high = 1.0
    best = None
    for _ in range(RATE_STEPS):
        rate = (low + high) / 2
        solution = _confirmed_solution(program, problem, rate)
        if solution is None:
            high = rate
        else:
            low = rate
            best = solution
    return low, best and replace(best, logs=log_multipliers(problem.at_rate(low), best))


def finds_certificate(problem: Problem, rate: float) -> bool:
    """Whether matrices are found that prove a contraction rate of a model with neurons in exact
    arithmetic."""
    program = StructuredLmi(problem=problem, objective="largest_margin")
    return _confirmed_solution(program, problem, rate) is not None


def _confirmed_solution(program: StructuredLmi, problem: Problem, rate: float) -> Solution | None:
    """Matrices that prove a contraction rate in exact arithmetic; None if the solver finds none."""
    try:
        solution = program.solve(rate)
        slower_problem = problem.at_rate(rate)
        return solution if is_confirmed_exactly(slower_problem, solution) else None
    except NoSolution:
        return None


def certify_largest_rate(certificate: Any) -> GainTheorem | None:
    """Certificate of the largest contraction rate that can be proved for the certified gain of a
    model with neurons."""
    started = time.perf_counter()
    problem, gains = certificate.as_problem()
    provable_rate = largest_rate_with_neurons(problem, gains)
    rate = provable_rate * (1 - INSIDE)
    if rate <= certificate.rate:
        return None
    faster = problem.at_rate(rate)
    program = StructuredLmi(problem=faster, objective="largest_margin", fixed=gains)
    try:
        solution = program.solve(rate)
    except NoSolution:
        return None
    numbers = certificate.certificate_numbers(faster, solution)
    status = f"{solution.status}, {INSIDE:.1%} inside the largest rate"
    proved: GainTheorem = certificate.from_numbers(
        numbers,
        status=status,
        started=started,
        rate_limit=certificate.rate_limit,
        method=certificate.method,
    )
    return proved if proved.certified else None
