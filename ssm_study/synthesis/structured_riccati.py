"""Guaranteed-cost gains of a structured model from game Riccati equations, multipliers found by a gradient search.

With `w = (z + v) / 2`, `|v_i| <= |z_i|`, and `J = alpha I + beta Delta`, `p = Delta u`, the inequality of
`theorems.structured_state_feedback` at given `Lambda` and `lambda_p = 1 / sigma` is the equation

    X = A'X A + Q - (A'X B + S)(R + B'X B)^{-1}(B'X A + S'),     inputs (u, p, v),  Bg = B + E G/2,  C = G' Lambda G/2,
    A = (A + E F/2)/r,  B = [alpha Bg, beta Bg, E/2]/r,  Q = (Q_x + F' Lambda F/2)/r^2,
    S = [alpha F' Lambda G/2, beta F' Lambda G/2, 0]/r^2,
    R = diag([R_u + lambda_p I + alpha^2 C, alpha beta C; ., -lambda_p I + beta^2 C], -Lambda/2)/r^2.

It holds if `X > 0` and the (p, v) block of `H = R + B'X B` is negative definite: then `P = X^{-1}` and K is the first
row of the saddle point. An observer is the same for transposed data. One that injects plays after v and before p: the p
block is negative, and what v has left once (u, p), block 1, answer it; then u is positive. With `g = B'X A + S'` the
u rows of `-H_11^{-1} (g_1 - H_12 E')` and `-2 H_11^{-1} H_12` are `L'` and `L_z'`. The gradient costs one Lyapunov
equation, because the saddle point stays put to first order: in the norm of the loop's Gramian it is
`(|z_i|^2 - |v_i|^2) / 2 r^2` for `Lambda_i` and `(|u|^2 - |p|^2) / r^2` for `lambda_p`.

Source: docs/theory.md, "With neurons"; Basar & Bernhard 1995 (games),
Petersen & Hollot 1986 (guaranteed cost).
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.synthesis.game import Game, descend, evaluate
from ssm_study.synthesis.problem import NoSolution, Problem, Solution, symmetric

SLOWER, SLOWEST = 1.5, 1e3  # until the first multipliers hold the rate is slowed by this factor a step, up to that one
# Weight of the barrier, evaluations at each rate on the way, and the share of that way, in log r, below which the
# search has come to its end; each where the one before gets stuck.
TRIES = ((3.0, 4, 0.02), (30.0, 16, 0.02), (30.0, 16, 0.005), (0.3, 30, 0.005))
# The same at the asked rate, where the cost decides. In steps: straight to the last one the search gets stuck at the
# edge of what is admissible, at up to seventeen times the cost.
LAST = ((0.3, 10), (0.03, 10), (1e-3, 30))
ROOM = np.arange(0.0, 40.0, 2.0)  # by how much known multipliers may have to grow, log, to cover the weights
BALL_SLACK = 1e-9  # of the metric: what a multiplier without effect may take of it, where the ball has no radius


def least_cost(problem: Problem, near: Solution | None = None) -> Solution:
    """The gain and the matrices of the theorem; raises `NoSolution` where the search gets stuck before the rate.

    It starts from the multipliers of `near` where they hold: as they must, scaled up, if that is a solution at a
    faster rate, since smaller weights and a slower rate only relax the inequality. Without any it is the solution.
    """
    if near is not None and near.logs is None:
        return near  # it is the solution itself
    game, known = game_of(problem), None if near is None else near.logs
    for logs in () if known is None else known + ROOM[:, None]:
        if np.isfinite(evaluate(game, logs, 0.0).goal):
            return solution(problem, game, cheapest(game, logs))
    for effort in TRIES:
        logs, reached = searched(game, *effort)
        if reached <= game.r:
            return solution(problem, game, logs)
    raise NoSolution(f"multipliers found down to a factor {reached:.4f} a sample")


def game_of(problem: Problem) -> Game:
    """The problem as the search takes it; raises `ValueError` for a problem without neurons."""
    neurons, ball = problem.of_neurons.scaled(), problem.ball
    parts = {"a": problem.a, "b": problem.b, "e": neurons.e, "f": neurons.f, "g": neurons.g}
    parts |= {"state_weight": problem.state_weight}
    numbers = {"alpha": ball.alpha, "beta": ball.beta, "r": problem.contraction, "input_weight": problem.input_weight}
    told: dict[str, Any] = {name: np.array(part, dtype=float, order="C") for name, part in parts.items()}
    return Game(**told | {name: float(number) for name, number in numbers.items()}, injects=neurons.injects)


def searched(
    game: Game, centred: float = 3.0, per_rate: int = 4, shortest: float = 0.02
) -> tuple[Float[np.ndarray, "s"], float]:
    """Log multipliers, and the factor they hold at: from a slow rate to the asked one, centred on the way."""
    # a neuron counts as much as its step is worth in the state's weight; the ball as its centre's step
    logs = np.log(2 * np.einsum("nq,nj,jq->q", game.e, game.state_weight, game.e) + 1e-9)
    if game.beta > 0:
        logs = np.append(logs, np.log(1 + 4 * game.beta**2 * np.linalg.norm(game.b.T @ game.state_weight @ game.b, 2)))
    slow, share = game, 1.0
    while np.isinf(evaluate(slow, logs, 0.0).goal):
        slow = replace(slow, r=slow.r * SLOWER)
        if slow.r > SLOWEST:
            return logs, slow.r
    while slow.r > game.r:
        logs = descend(slow, logs, centred, per_rate)
        while np.isinf(evaluate(_between(game, slow, share), logs, 0.0).goal):
            share /= 2
            if share < shortest:
                return logs, slow.r
        slow, share = _between(game, slow, share), min(1.0, 4 * share)
    return cheapest(game, logs), game.r


def cheapest(game: Game, logs: Float[np.ndarray, "s"]) -> Float[np.ndarray, "s"]:
    """The multipliers of least cost that are found from these, which hold."""
    for barrier, evaluations in LAST:
        logs = descend(game, logs, barrier, evaluations)
    return logs


def logs_of(problem: Problem, found: Solution) -> Float[np.ndarray, "s"]:
    """The log multipliers of the inequality's matrices: the inverse of what `solution` makes of them."""
    assert found.multipliers is not None
    units, r2, beta = problem.of_neurons.units, 1 - problem.rate, problem.ball.beta
    observes = problem.of_neurons.observes
    weights = r2 / (found.multipliers * units**2) if observes else found.multipliers / units**2
    bound = [1 / (found.sigma / (r2 * beta**2) if observes else found.sigma)] if beta > 0 else []
    return np.log(np.append(weights, bound))


def _between(game: Game, slow: Game, share: float) -> Game:
    return game if share == 1.0 else replace(game, r=slow.r * (game.r / slow.r) ** share)


def solution(problem: Problem, game: Game, logs: Float[np.ndarray, "s"]) -> Solution:
    """The theorem's matrices at these multipliers. Raises `NoSolution` where they do not hold."""
    saddle = evaluate(game, logs, 0.0)
    if np.isinf(saddle.goal):
        raise NoSolution("the game has no saddle point at these multipliers")
    x, h, toward = saddle.x, saddle.h, saddle.toward
    m, q = game.b.shape[1], game.e.shape[1]
    if game.injects:
        inputs = len(h) - q
        known = np.linalg.solve(h[:inputs, :inputs], np.hstack([toward[:inputs], h[:inputs, inputs:]]))[:m]
        k, k_w = known[:, len(x) :] @ game.f - known[:, : len(x)], -2 * known[:, len(x) :]
    else:
        k, k_w = -np.linalg.solve(h, toward)[:m], np.zeros((m, q))
    p, weights = symmetric(np.linalg.inv(x)), np.exp(logs[:q])
    sigma = float(np.exp(-logs[-1])) if game.beta > 0 else 0.0
    if problem.of_neurons.observes:
        # From the state feedback of transposed data: the congruence that exchanges rows 1 and 4 divides one by r and
        # multiplies the other, and the neurons' row, by it. So `Lambda = r^2 T`, `eta = r^2 beta^2 sigma`.
        r2 = 1 - problem.rate
        weights, sigma = r2 / weights, r2 * game.beta**2 * sigma
    sigma = sigma if game.beta > 0 else without_ball(problem, p, k)
    found = Solution(p=p, y=p, k=k, k_w=k_w, sigma=sigma, multipliers=weights, status="game", logs=logs)
    return found.of_neurons(problem.of_neurons)


def without_ball(problem: Problem, p: Float[np.ndarray, "n n"], k: Float[np.ndarray, "m n"]) -> float:
    """A sigma so large (of an observer an eta so small) that it takes next to nothing of P: for a ball without radius.

    What it takes is `X^T X / sigma` of P, `eta C^T C` of Q.
    """
    if problem.of_neurons.observes:
        return float(BALL_SLACK * np.linalg.eigvalsh(p)[0] / (np.linalg.norm(problem.b, 2) ** 2 + 1e-300))
    return float(np.linalg.norm(k @ p @ k.T, 2) / BALL_SLACK + 1.0)
