"""Gains with a guaranteed cost for models with neurons, from game Riccati equations with
multipliers found by a gradient search.

With `w = (z + v) / 2`, `|v_i| <= |z_i|`, and `J = alpha I + beta Delta`, `p = Delta u`, the
inequality of `theorems.structured_state_feedback` at given `Lambda` and `lambda_p = 1 / sigma` is
the equation

    X = A'X A + Q - (A'X B + S)(R + B'X B)^{-1}(B'X A + S'),     inputs (u, p, v),  Bg = B + E G/2,
    C = G' Lambda G/2,
    A = (A + E F/2)/r,  B = [alpha Bg, beta Bg, E/2]/r,  Q = (Q_x + F' Lambda F/2)/r^2,
    S = [alpha F' Lambda G/2, beta F' Lambda G/2, 0]/r^2,
    R = diag([R_u + lambda_p I + alpha^2 C, alpha beta C; ., -lambda_p I + beta^2 C],
    -Lambda/2)/r^2.

It holds if `X > 0` and the (p, v) block of `H = R + B'X B` is negative definite: then `P = X^{-1}`
and K is the first row of the saddle point. An observer is the same for transposed data. One that
injects plays after v and before p: the p block is negative, and what v has left once (u, p), block
1, answer it; then u is positive. With `g = B'X A + S'` the u rows of `-H_11^{-1} (g_1 - H_12 E')`
and `-2 H_11^{-1} H_12` are `L'` and `L_z'`. The gradient costs one Lyapunov equation, because the
saddle point stays put to first order: in the norm of the loop's Gramian it is `(|z_i|^2 - |v_i|^2)
/ 2 r^2` for `Lambda_i` and `(|u|^2 - |p|^2) / r^2` for `lambda_p`.

Source: docs/theory.md, "With neurons"; Basar & Bernhard 1995 (games), Petersen & Hollot 1986
(guaranteed cost).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.problem import Neurons, NoSolution, Problem, Solution, symmetric_part
from ssm_study.synthesis.game_kernel import solve_saddle_point

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "_"]
SLOWER = 1.5
SLOWEST = (
    1e3  # until the first multipliers hold the rate is slowed by this factor a step, up to that one
)
# Weight of the barrier, evaluations at each rate on the way, and the share of that way, in log r,
# below which the search has come to its end; each where the one before gets stuck.
TRIES = ((3.0, 4, 0.02), (30.0, 16, 0.02), (30.0, 16, 0.005), (0.3, 30, 0.005))
# The same at the asked rate, where the cost decides. In steps: straight to the last one the search
# gets stuck at the edge of what is admissible, at up to seventeen times the cost.
LAST = ((0.3, 10), (0.03, 10), (1e-3, 30))
ROOM = np.arange(
    0.0, 40.0, 2.0
)  # by how much known multipliers may have to grow, log, to cover the weights
# of the metric: what a multiplier without effect may take of it, where the ball has no radius
BALL_SLACK = 1e-9
STRIDE = 2.0  # the largest change of a log multiplier in one step
FLAT = 1e-3  # a descent ends when a step gains less of the logarithm of its goal


@dataclass(frozen=True, kw_only=True)
class RiccatiGame:
    """Dynamic game whose Riccati equation gives the gain of a model with neurons, for one
    contraction factor. The search starts with slower factors, which may exceed one."""

    problem: Problem
    r: float

    @cached_property
    def neurons(self) -> Neurons:
        """Neurons of the synthesis problem in balanced units. Raises `ValueError` if it has
        none."""
        return self.problem.required_neurons.in_balanced_units()

    @cached_property
    def solver_arguments(self) -> tuple[Any, ...]:
        """Arguments of the compiled solver of the game, without the multipliers.

        `w = (z + v) / 2`, so half of each neuron is linear; without a radius of the ball there is
        no p.
        """
        neurons_e = self.neurons.e
        of, neurons, half = self.problem, self.neurons, neurons_e / 2
        alpha = of.ball.alpha
        beta = of.ball.beta
        radii = (alpha, beta)
        shares = radii[: 1 + (beta > 0)]
        mean_path = neurons.e @ neurons.g
        drive = of.b + mean_path / 2
        moved_rows = [share * neurons.g for share in shares]
        moved = np.hstack(moved_rows)
        a = of.a + half @ neurons.f
        shared_drives = (share * drive for share in shares)
        b = np.hstack([*shared_drives, half])
        scaled_a = a / self.r
        scaled_b = b / self.r
        matrices = (scaled_a, scaled_b, neurons.f, moved, of.state_weight)
        # numba would compile everything once more for any other layout or kind of number
        contiguous = (np.ascontiguousarray(matrix, dtype=float) for matrix in matrices)
        input_weight = float(of.input_weight)
        self_r = float(self.r)
        input_count = of.b.shape[1]
        return *contiguous, input_weight, input_count, self_r, neurons.allows_injection


class SaddlePoint(NamedTuple):
    """Saddle point of the game: the guaranteed cost, its gradient and the Riccati solution."""

    goal: float
    gradient: Vector
    x: Matrix
    h: Matrix
    toward: Matrix


def evaluate_saddle_point(
    game: RiccatiGame, log_multipliers: Vector, barrier_weight: float
) -> SaddlePoint:
    """Saddle point of a game for given logarithms of the multipliers, with the guaranteed cost and
    its gradient. Its goal is infinite if they are inadmissible.

    The goal is `log trace X - barrier log det(-T'H T / D)`, `D = diag(lambda_p, Lambda)`: the
    second term keeps the search off the edge of what is admissible, where the gradient of the first
    one leads.
    """
    try:
        saddle_numbers = solve_saddle_point(*game.solver_arguments, log_multipliers, barrier_weight)
        return SaddlePoint(*saddle_numbers)
    except (np.linalg.LinAlgError, ArithmeticError):
        none = np.empty((0, 0))
        gradient = np.empty(0)
        return SaddlePoint(np.inf, gradient, none, none, none)


def minimise_guaranteed_cost(
    game: RiccatiGame, log_multipliers: Vector, barrier_weight: float, evaluation_count: int
) -> Vector:
    """Logarithms of the multipliers that minimise the guaranteed cost of a game, by the BFGS
    method. A step to an inadmissible point is shortened."""
    at = evaluate_saddle_point(game, log_multipliers, barrier_weight)
    metric = np.eye(len(log_multipliers))
    left = evaluation_count
    gained = np.inf
    while np.isfinite(at.goal) and left > 0 and gained >= FLAT:
        step = -(metric @ at.gradient)
        step_sizes = np.abs(step)
        largest_step = max(step_sizes.max(), 1e-300)
        step *= min(1.0, STRIDE / largest_step)
        there = at
        lower = False
        while left > 0 and not lower and np.abs(step).max() > 1e-6:
            left -= 1
            there = evaluate_saddle_point(game, log_multipliers + step, barrier_weight)
            slope_along_step = step @ at.gradient
            sufficient_goal = at.goal + 1e-4 * slope_along_step
            lower = bool(there.goal < sufficient_goal)  # Armijo's condition
            step = step if lower else step / 3
        if not lower:
            break
        log_multipliers = log_multipliers + step
        change = there.gradient - at.gradient
        gained = at.goal - there.goal
        along = step @ change
        at = there
        if (
            along > 1e-12
        ):  # BFGS's curvature condition: without it the metric would lose definiteness
            outer_product = np.outer(step, change)
            parameter_count = len(log_multipliers)
            turn = np.eye(parameter_count) - outer_product / along
            turned_metric = turn @ metric @ turn.T
            step_product = np.outer(step, step)
            metric = turned_metric + step_product / along
    return log_multipliers


def least_guaranteed_cost(problem: Problem, start_solution: Solution | None = None) -> Solution:
    """Gain with the smallest guaranteed cost for a model with neurons, and the matrices that
    certify this gain. Raises `NoSolution` if the search stops before the requested rate.

    It starts from the multipliers of `start_solution` if they are admissible. Scaled up they must
    be if that solution has a faster rate, since smaller weights and a slower rate only relax the
    inequality. A `start_solution` without multipliers is returned as the solution itself.
    """
    if start_solution is not None and start_solution.logs is None:
        return start_solution  # it is the solution itself
    game = RiccatiGame(problem=problem, r=problem.contraction_factor)
    near_logs = None if start_solution is None else start_solution.logs
    for logs in () if near_logs is None else near_logs + ROOM[:, None]:
        goal = evaluate_saddle_point(game, logs, 0.0).goal
        if np.isfinite(goal):
            return solution_of_game(game, least_cost_multipliers(game, logs))
    for effort in TRIES:
        logs, reached = continue_to_rate(game, *effort)
        if reached <= game.r:
            return solution_of_game(game, logs)
    raise NoSolution(f"multipliers were found only for factors from {reached:.4f} per sample on")


def continue_to_rate(
    game: RiccatiGame, barrier_weight: float, evaluations_per_rate: int, shortest_step: float
) -> tuple[Vector, float]:
    """Admissible multipliers (as logarithms) at the requested contraction rate, found by
    continuation from a slower rate."""
    # a neuron counts as much as its step is worth in the state's weight; the ball as its centre's
    # step
    of = game.problem
    e = game.neurons.e
    neuron_weights = np.einsum("nq,nj,jq->q", e, of.state_weight, e)
    logs = np.log(2 * neuron_weights + 1e-9)
    if of.ball.beta > 0:
        beta = of.ball.beta
        weighted_b = of.b.T
        curvature = weighted_b @ of.state_weight @ of.b
        input_weight = np.linalg.norm(curvature, 2)
        ball_weight = 1 + 4 * beta**2 * input_weight
        log_ball_weight = np.log(ball_weight)
        logs = np.append(logs, log_ball_weight)
    slow = game
    share = 1.0
    while np.isinf(evaluate_saddle_point(slow, logs, 0.0).goal):
        r = slow.r * SLOWER
        slow = replace(slow, r=r)
        if slow.r > SLOWEST:
            return logs, slow.r
    while slow.r > game.r:
        logs = minimise_guaranteed_cost(slow, logs, barrier_weight, evaluations_per_rate)
        while np.isinf(
            evaluate_saddle_point(_interpolate_games(game, slow, share), logs, 0.0).goal
        ):
            share /= 2
            if share < shortest_step:
                return logs, slow.r
        slow = _interpolate_games(game, slow, share)
        share = min(1.0, 4 * share)
    return least_cost_multipliers(game, logs), game.r


def least_cost_multipliers(game: RiccatiGame, log_multipliers: Vector) -> Vector:
    """Multipliers (as logarithms) with the smallest guaranteed cost, by a search that starts at
    admissible ones."""
    for barrier, evaluations in LAST:
        log_multipliers = minimise_guaranteed_cost(game, log_multipliers, barrier, evaluations)
    return log_multipliers


def log_multipliers(problem: Problem, solution: Solution) -> Vector:
    """Logarithms of the multipliers in a solution of the matrix inequality of a model with
    neurons."""
    assert solution.multipliers is not None
    units = problem.required_neurons.neuron_scales
    r2 = 1 - problem.rate
    beta = problem.ball.beta
    observes = problem.required_neurons.observes
    weights = (
        r2 / (solution.multipliers * units**2) if observes else solution.multipliers / units**2
    )
    bound = (
        [1 / (solution.sigma / (r2 * beta**2) if observes else solution.sigma)] if beta > 0 else []
    )
    multipliers = np.append(weights, bound)
    return np.log(multipliers)


def _interpolate_games(game: RiccatiGame, slow_game: RiccatiGame, fraction: float) -> RiccatiGame:
    """Dynamic game whose contraction factor is interpolated between the contraction factors of two
    games."""
    if fraction == 1.0:
        return game
    ratio = game.r / slow_game.r
    between = slow_game.r * ratio**fraction
    return replace(game, r=between)


def solution_of_game(game: RiccatiGame, logs: Vector) -> Solution:
    """Gain, metric and multipliers of a design with neurons, from the Riccati equation of its
    linear-quadratic game. Raises
    `NoSolution` if the conditions do not hold there."""
    saddle = evaluate_saddle_point(game, logs, 0.0)
    problem = game.problem
    neurons = game.neurons
    if np.isinf(saddle.goal):
        raise NoSolution("the game has no saddle point at these multipliers")
    x = saddle.x
    h = saddle.h
    toward = saddle.toward
    m = problem.b.shape[1]
    q = neurons.e.shape[1]
    if neurons.allows_injection:
        inputs = len(h) - q
        order = len(x)
        own_block = h[:inputs, :inputs]
        right_side = np.hstack([toward[:inputs], h[:inputs, inputs:]])
        all_gains = np.linalg.solve(own_block, right_side)
        player_gains = all_gains[:m]
        state_gain = player_gains[:, :order]
        neuron_gain = player_gains[:, order:]
        k = neuron_gain @ neurons.f - state_gain
        k_w = -2 * neuron_gain
    else:
        k = -np.linalg.solve(h, toward)[:m]
        k_w = np.zeros((m, q))
    matrix = np.linalg.inv(x)
    p = symmetric_part(matrix)
    weights = np.exp(logs[:q])
    beta = problem.ball.beta
    sigma = float(np.exp(-logs[-1])) if beta > 0 else zero_radius_multiplier(problem, p, k)
    if neurons.observes:
        # From the state feedback of transposed data: the congruence that exchanges rows 1 and 4
        # divides one by r and multiplies the other, and the neurons' row, by it. So `Lambda = r^2
        # T`, `eta = r^2 beta^2 sigma`.
        r2 = 1 - problem.rate
        weights = r2 / weights
        sigma = r2 * beta**2 * sigma if beta > 0 else sigma
    solution = Solution(
        p=p, y=p, k=k, k_w=k_w, sigma=sigma, multipliers=weights, status="game", logs=logs
    )
    return solution.undo_neuron_scaling(problem.required_neurons)


def zero_radius_multiplier(
    problem: Problem, p: Float[np.ndarray, "n n"], k: Float[np.ndarray, "m n"]
) -> float:
    """Multiplier of the ball of Jacobians in the matrix inequality, for a ball of radius zero. It
    is so large (of an observer so small) that it hardly reduces P.

    What it takes is `X^T X / sigma` of P, `eta C^T C` of Q.
    """
    if problem.required_neurons.observes:
        eigenvalues = np.linalg.eigvalsh(p)
        smallest_slack = BALL_SLACK * eigenvalues[0]
        input_norm = np.linalg.norm(problem.b, 2)
        return float(smallest_slack / (input_norm**2 + 1e-300))
    effort = k @ p @ k.T
    largest_effort = np.linalg.norm(effort, 2)
    return float(largest_effort / BALL_SLACK + 1.0)
