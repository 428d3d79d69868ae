"""Processor milliseconds per certificate by method and order: `OMP_NUM_THREADS=1 python
benchmarks/synthesis_times.py`.

Writes `results/reference/certificates/times.csv` (median of repetitions; the methods of one order
are timed in turn; microseconds as the mean of many calls) and `sweep.csv` (twenty rates through one
compiled inequality against twenty fresh ones). Processor time of one thread, not wall time: a
machine that does other work stretches the latter by as much as it is busy. `--orders n ...`
restricts; rows of other orders are kept.
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.linalg
from common import REFERENCE, cpu_seconds, keep
from synthesis_instances import random_model

from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.certificates.problem import Problem
from ssm_study.certificates.riccati import solve_riccati
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis.guaranteed_cost import guaranteed_cost, solve_at_tau
from ssm_study.synthesis.lmi import CompiledLmi
from ssm_study.synthesis.minimum_energy import minimum_energy_gain, minimum_energy_solution
from ssm_study.synthesis.modes import split_modes
from ssm_study.systems import JacobianBall

FOLDER = REFERENCE / "certificates"
ORDERS = (4, 8, 16, 32, 64, 128, 256, 512)
LARGEST = {
    "paper_lmi_full": 32,
    "lmi_y_equals_p": 32,
    "exact_verification": 64,
    "riccati_search": 128,
    "scipy_dare": 512,
}
REPETITIONS = {4: 15, 8: 15, 16: 9, 32: 2, 64: 3, 128: 3}
SWEPT = (4, 8, 16)
LONG_S = 1e-3


def problem_of(order: int) -> Problem:
    """A stable model, slopes in [0.3, 1], half way to the frontier."""
    linear = random_model(np.random.default_rng(order), order, "stable")
    ball = JacobianBall.from_slopes(0.3, 1.0)
    rate = 0.5 * contraction_frontier(linear.a, linear.b, ball).rate_limit
    weight = linear.c.T @ linear.c + 1e-3 * np.eye(order)
    return Problem(
        a=linear.a, b=linear.b, ball=ball, rate=rate, state_weight=weight, input_weight=0.1
    )


def compiled(problem: Problem, objective: str, full: bool = False) -> CompiledLmi:
    weights = {"state_weight": np.eye(len(problem.a)), "input_weight": 1.0}
    return CompiledLmi(a=problem.a, b=problem.b, objective=objective, full=full, **weights)


def tasks(problem: Problem) -> dict[str, Callable[[], object]]:
    ball = problem.ball
    lmis = {full: compiled(problem, "feasibility", full) for full in (True, False)}
    solution = minimum_energy_solution(problem)
    certificate = StateFeedbackOfBall.certificate_numbers(problem, solution)
    kappa = np.eye(1) / 4.0

    def smallest_gain() -> object:
        modes = split_modes(problem.a, problem.b, problem.contraction_factor)
        return minimum_energy_gain(modes, ball, problem.contraction_factor, widens_ball=False).k

    return {
        "paper_lmi_full": lambda: lmis[True].solve(problem),
        "lmi_y_equals_p": lambda: lmis[False].solve(problem),
        "closed_form_gain_from_matrices": smallest_gain,
        "closed_form_with_metric": lambda: minimum_energy_solution(problem),
        "riccati_at_one_tau": lambda: solve_at_tau(problem, 10.0),
        "riccati_search": lambda: guaranteed_cost(problem),
        "doubling": lambda: solve_riccati(problem.a_hat, problem.b_hat, problem.state_weight, 4.0),
        "scipy_dare": lambda: scipy.linalg.solve_discrete_are(
            problem.a_hat, problem.b_hat, problem.state_weight, kappa
        ),
        "exact_verification": lambda: StateFeedbackOfBall.holds(**certificate),
    }


def milliseconds(task: Callable[[], object]) -> float:
    """One call; what takes less than `LONG_S` is the mean of many."""
    once = cpu_seconds(task)
    if once > LONG_S:
        return 1e3 * once
    calls = max(1, min(100, int(LONG_S / max(once, 1e-9))))
    return 1e3 * cpu_seconds(task, calls) / calls


def timed(order: int) -> dict[str, object]:
    samples: dict[str, list[float]] = {}
    runnable = {
        name: task
        for name, task in tasks(problem_of(order)).items()
        if order <= LARGEST.get(name, max(ORDERS))
    }
    for repetition in range(REPETITIONS.get(order, 1) + 1):
        for name, task in runnable.items():
            spent = milliseconds(task)
            if repetition > 0 or order > 128:  # the first round compiles and warms up
                samples.setdefault(name, []).append(spent)
    return {"order": order} | {name: f"{np.median(values):.4f}" for name, values in samples.items()}


def sweep(order: int, rates: int = 20) -> dict[str, object]:
    problem = problem_of(order)
    asked = (
        np.linspace(0.1, 0.9, rates)
        * contraction_frontier(problem.a, problem.b, problem.ball).rate_limit
    )
    cases = [
        replace(problem, rate=float(r), state_weight=np.eye(order), input_weight=1.0) for r in asked
    ]

    def through_one() -> None:
        shared = compiled(problem, "smallest_gain")
        for case in cases:
            shared.solve(case)

    apart = cpu_seconds(lambda: [compiled(problem, "smallest_gain").solve(case) for case in cases])
    together = cpu_seconds(through_one)
    return {
        "order": order,
        "rates": rates,
        "fresh_s": f"{apart:.3f}",
        "compiled_s": f"{together:.3f}",
        "ratio": f"{apart / together:.1f}",
    }


def kept(name: str, row: dict[str, object]) -> None:
    """In place of the row of the same order."""
    keep(FOLDER / name, [row], ["order"], lambda each: int(str(each["order"])))
    print(row, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--orders", type=int, nargs="+", default=ORDERS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for order in arguments.orders:
        if order in SWEPT:
            kept("sweep.csv", sweep(order))
        kept("times.csv", timed(order))


if __name__ == "__main__":
    main()
