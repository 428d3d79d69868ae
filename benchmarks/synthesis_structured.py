"""The fast route for models with neurons against its oracle, on random models: how often, how near, how much faster.

    python benchmarks/synthesis_structured.py [models] > benchmarks/synthesis_structured.csv

Per row: size and side, the best factor r found by bisecting the LMI, whether the game Riccati search certifies a rate
10 % below, its cost over that of the LMI (nothing where the solver fails), and both times, one after the other.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssm_study.synthesis.problem import Neurons, NoSolution, Problem, Solution, dual
from ssm_study.synthesis.structured_lmi import StructuredLmi, holds, largest_rate
from ssm_study.synthesis.structured_riccati import least_cost
from ssm_study.systems import JacobianBall, StructuredSystem

BELOW = 0.9
SIZES = ((2, 1), (4, 2), (4, 4), (8, 4))
BALLS = {"none": JacobianBall(alpha=1.0, beta=0.0), "wide": JacobianBall.from_slopes(0.6, 1.0)}


def drawn(rng: np.random.Generator, n: int, q: int) -> StructuredSystem:
    """`A` of radius 0.8 to 1.05, neurons from weak to strong; every third output sees them."""
    a, size = rng.normal(size=(n, n)), rng.uniform(0.1, 0.5)
    return StructuredSystem(
        a=a * rng.uniform(0.8, 1.05) / np.abs(np.linalg.eigvals(a)).max(),
        b=rng.normal(size=(n, 1)),
        c=rng.normal(size=(1, n)),
        d=np.zeros((1, 1)),
        e=size * rng.normal(size=(n, q)) / np.sqrt(n),
        f=size * rng.normal(size=(q, n)),
        g=0.3 * rng.normal(size=(q, 1)),
        h=(rng.uniform() < 1 / 3) * 0.3 * rng.normal(size=(1, q)),
    )


def timed(solve: Callable[[], Solution]) -> tuple[Solution | None, float]:
    """What came of it, and seconds of this process."""
    started = time.process_time()
    try:
        found: Solution | None = solve()
    except NoSolution:
        found = None
    return found, time.process_time() - started


def problem_of(system: StructuredSystem, observes: bool, ball: JacobianBall) -> Problem:
    """The state feedback of the system, or its observer, at any rate."""
    system = dual(system) if observes else system
    weight, neurons = np.eye(system.order), Neurons.of(system, observes)
    return Problem(a=system.a, b=system.b, ball=ball, rate=0.5, state_weight=weight, input_weight=0.1, neurons=neurons)


def main(models: int) -> None:
    """One row per model that some rate is certified for."""
    print("model,states,neurons,side,ball,best_r,asked_r,certified,cost_ratio,game_s,lmi_s")
    rng, done = np.random.default_rng(0), 0
    while done < models:
        (n, q), side, ball = SIZES[done % 4], ("controller", "observer")[done // 4 % 2], ("none", "wide")[done // 8 % 2]
        problem = problem_of(drawn(rng, n, q), side == "observer", BALLS[ball])
        best = largest_rate(problem)
        if best < 0.02:
            continue
        problem = replace(problem, rate=BELOW * best)
        if done == 0:
            timed(lambda problem=problem: least_cost(problem))  # compiles
        fast, game_s = timed(lambda problem=problem: least_cost(problem))
        program = StructuredLmi(problem=problem, objective="guaranteed_cost")
        timed(lambda problem=problem, program=program: program.solve(problem.rate / 2))  # compiles
        slow, lmi_s = timed(lambda problem=problem, program=program: program.solve(problem.rate))
        certified = fast is not None and holds(problem, fast)
        costs = [np.nan if found is None else np.trace(np.linalg.inv(found.p)) for found in (fast, slow)]
        ratio = costs[0] / costs[1] * (1 - problem.rate if side == "observer" else 1.0)
        factors = f"{np.sqrt(1 - best):.4f},{problem.contraction:.4f}"
        told = "" if np.isnan(ratio) else f"{ratio:.4f}"
        print(f"{done},{n},{q},{side},{ball},{factors},{certified},{told},{game_s:.5f},{lmi_s:.5f}", flush=True)
        done += 1


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
