"""Models with neurons, on random ones: the fast route against its oracle, sampled slopes against
what is certified.

    python benchmarks/synthesis_structured.py [models] [first] >>
    results/reference/certificates/structured.csv

Per row: size, side, ball, and whether neurons enter the output (`h`); the best factor r found by
bisecting the LMI; whether the game Riccati search certifies a rate 10 % below, and its cost over
that of the LMI (nothing where the solver fails); the slowest contraction that vertices, 400 random
slopes and a gradient search find at the certificate (the search's, else the LMI's); seconds of the
search, the cost form, the feasibility form and the exact verdict, in turn.

    python benchmarks/synthesis_structured.py told results/reference/certificates/structured.csv
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.certificates.problem import Neurons, NoSolution, Problem, Solution, dual_system
from ssm_study.synthesis.structured_lmi import (
    StructuredLmi,
    is_confirmed_exactly,
    largest_rate_with_neurons,
)
from ssm_study.synthesis.structured_riccati import least_guaranteed_cost
from ssm_study.systems import JacobianBall, StructuredSystem

BELOW = 0.9
SIZES = ((2, 1), (4, 2), (4, 4), (8, 4), (8, 8))
BALLS = {"none": JacobianBall(alpha=1.0, beta=0.0), "wide": JacobianBall.from_slopes(0.6, 1.0)}
KINDS = tuple(product(SIZES, ("controller", "observer"), BALLS, (False, True)))
RANDOM = 400
CLIMBED = 5
STEPS = 20
COLUMNS = "model,states,neurons,side,ball,h,best_r,asked_r,certified,cost_ratio,sampled_r,"
COLUMNS += "game_s,cost_s,feasible_s,exact_s"


def drawn(rng: np.random.Generator, n: int, q: int, h: bool) -> StructuredSystem:
    """`A` of radius 0.8 to 1.05, neurons from weak to strong."""
    a = rng.normal(size=(n, n))
    size = rng.uniform(0.1, 0.5)
    return StructuredSystem(
        a=a * rng.uniform(0.8, 1.05) / np.abs(np.linalg.eigvals(a)).max(),
        b=rng.normal(size=(n, 1)),
        c=rng.normal(size=(1, n)),
        d=np.zeros((1, 1)),
        e=size * rng.normal(size=(n, q)) / np.sqrt(n),
        f=size * rng.normal(size=(q, n)),
        g=0.3 * rng.normal(size=(q, 1)),
        h=h * 0.3 * rng.normal(size=(1, q)),
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
    system = dual_system(system) if observes else system
    weight = np.eye(system.order)
    neurons = Neurons(e=system.e, f=system.f, g=system.g, observes=observes)
    return Problem(
        a=system.a,
        b=system.b,
        ball=ball,
        rate=0.5,
        state_weight=weight,
        input_weight=0.1,
        neurons=neurons,
    )


def sampled(
    system: StructuredSystem, problem: Problem, found: Solution, rng: np.random.Generator
) -> float:
    """The largest factor by which frozen slopes, the last one that of S_u or S_y, stretch in the
    certified metric."""
    assert problem.neurons is not None
    ball = problem.ball
    k = found.k
    k_w = found.k_w
    root = np.linalg.cholesky(found.p if problem.neurons.observes else np.linalg.inv(found.p)).T
    inverse = np.linalg.inv(root)

    def step(at: Float[np.ndarray, "s"]) -> Float[np.ndarray, "n n"]:
        slopes = at[:-1]
        j = ball.lower + at[-1] * (ball.upper - ball.lower)
        frozen = system.linearise_at_slopes(slopes)
        if not problem.neurons.observes:
            return root @ (frozen.a + j * frozen.b @ k) @ inverse
        injected = 0.0 if k_w is None else (system.e * slopes) @ k_w.T @ system.c
        return root @ (frozen.a + j * (k.T @ frozen.c + injected)) @ inverse

    def norm(at: Float[np.ndarray, "s"]) -> float:
        return float(np.linalg.norm(step(at), 2))

    size = system.neurons + 1
    points = [
        *(np.array(at) for at in product((0.0, 1.0), repeat=size)),
        *rng.uniform(size=(RANDOM, size)),
    ]
    norms = [norm(at) for at in points]
    worst = max(norms)
    for start in np.argsort(norms[-RANDOM:])[-CLIMBED:]:
        at = points[len(points) - RANDOM + start]
        for _ in range(STEPS):
            here, (u, _, v) = step(at), np.linalg.svd(step(at))
            slope = [u[:, 0] @ (step(at + one) - here) @ v[0] for one in 1e-3 * np.eye(size)]
            at = np.clip(at + 0.3 * np.array(slope) / (np.abs(slope).max() + 1e-300), 0, 1)
            worst = max(worst, norm(at))
    return worst


def row(index: int) -> str | None:
    """The line of one model; None where no rate worth the name is certified for it."""
    rng, ((n, q), side, ball, h) = np.random.default_rng(index), KINDS[index % len(KINDS)]
    system = drawn(rng, n, q, h and side == "observer")
    observes = side == "observer"
    problem = problem_of(system, observes, BALLS[ball])
    best = largest_rate_with_neurons(problem)
    if best < 0.02:
        return None
    problem = replace(problem, rate=BELOW * best)
    programs = [
        StructuredLmi(problem=problem, objective=goal)
        for goal in ("guaranteed_cost", "largest_margin")
    ]
    for program in programs:  # compiles
        timed(lambda program=program: program.solve(problem.rate / 2))
    fast, game_s = timed(lambda: least_guaranteed_cost(problem))
    (slow, cost_s), (deep, deep_s) = (
        timed(lambda program=p: program.solve(problem.rate)) for p in programs
    )
    certified = fast is not None and is_confirmed_exactly(problem, fast)
    costs = [
        np.nan if found is None else np.trace(np.linalg.inv(found.p)) for found in (fast, slow)
    ]
    ratio = costs[0] / costs[1] * (1 - problem.rate if observes else 1.0)
    proof = fast if certified else deep
    started = time.process_time()
    assert proof is not None
    assert is_confirmed_exactly(problem, proof)
    exact_s = time.process_time() - started
    worst = sampled(system, problem, proof, rng)
    ratio_cell = "" if np.isnan(ratio) else f"{ratio:.4f}"
    factors = f"{np.sqrt(1 - best):.4f},{problem.contraction_factor:.4f},{certified},{ratio_cell}"
    times = f"{game_s:.5f},{cost_s:.5f},{deep_s:.5f},{exact_s:.5f}"
    return f"{index},{n},{q},{side},{ball},{h and observes},{factors},{worst:.6f},{times}"


def told(path: str) -> Iterator[str]:
    """What the table says."""
    table = pd.read_csv(path)
    every = (table.sampled_r <= np.sqrt(1 - BELOW * (1 - table.best_r**2)) + 1e-4).sum()
    yield f"{len(table)} models; sampled slopes contract no slower than certified on {every}"
    share = f"{table.certified.sum()} ({table.certified.mean():.1%})"
    solved = table.cost_ratio.notna().sum()
    yield f"search certified {share}, cost form solved {solved}"
    low, middle, high = (table.cost_s / table.game_s).quantile([0.25, 0.5, 0.75])
    yield f"cost form over search, time: median {middle:.1f}, quartiles {low:.1f}, {high:.1f}"
    for size, group in table.groupby(["states", "neurons"]):
        ms = 1e3 * group[["game_s", "cost_s", "feasible_s", "exact_s"]].median()
        ratio = (group.cost_s / group.game_s).median()
        yield (
            f"{size}: {ms.round(1).to_dict()}, {ratio:.1f} times, {group.certified.mean():.1%} "
            f"of {len(group)}"
        )


def main(models: int, first: int) -> None:
    if first == 0:
        print(COLUMNS)
    row(0)  # compiles
    for index in range(first, first + models):
        if line := row(index):
            print(line, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["told"]:
        print("\n".join(told(sys.argv[2])))
    else:
        main(
            int(sys.argv[1]) if len(sys.argv) > 1 else 1000,
            int(sys.argv[2]) if len(sys.argv) > 2 else 0,
        )
