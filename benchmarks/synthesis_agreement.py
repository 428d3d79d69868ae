"""The frontier against an LMI solver that is not told of it: `python
benchmarks/synthesis_agreement.py` (minutes).

A thousand random models of orders 1 to 32, one percent inside the frontier and one percent beyond.
Clarabel maximises the smallest eigenvalue t of Theorem 1's block matrix at fixed trace, on the
modes with `|lambda| > r` in balanced coordinates (the same theorem: the other modes need no input).
It says *feasible* when exact arithmetic finds its matrices positive definite, *infeasible* when it
ends optimal with t below minus `TELLING`, and otherwise cannot tell. Adds one row per side to
`results/reference/certificates/certified.csv`, method `modal_lmi_alone`. Options: `--count N`,
`--gaps g ...`.
"""

import argparse
import time
import warnings
from collections import Counter

import numpy as np
import scipy.linalg
from synthesis_certified import instances, kept, named, told
from synthesis_instances import Instance

from ssm_study.certificates.frontier import inverse_time_gramian_root
from ssm_study.certificates.problem import NoSolution, Problem
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis.lmi import CompiledLmi, LmiSynthesis
from ssm_study.synthesis.modes import split_modes

FEASIBLE = "feasible"
INFEASIBLE = "infeasible"
CANNOT_TELL = "cannot tell"
TELLING = 1e-7  # Clarabel stops at 1e-8
GAPS = (0.01, -0.01)


def on_fast_modes(case: Instance) -> Problem:
    """The asked inequality on its fast modes, balanced and scaled by 1/r. Nothing here knows the
    frontier."""
    asked = LmiSynthesis(rate_controller=case.rate, rate_observer=0.5).problem(
        case.linear, case.ball
    )
    r = asked.contraction_factor
    modes = split_modes(asked.a, asked.b, r)
    if modes.fast_mode_count == 0:
        raise NoSolution("no fast modes")
    root = inverse_time_gramian_root(modes.a_fast / r, modes.b_fast / r)
    return Problem(
        a=scipy.linalg.solve_triangular(root, modes.a_fast / r @ root, lower=True),
        b=scipy.linalg.solve_triangular(root, modes.b_fast / r, lower=True),
        ball=case.ball,
        rate=float(np.finfo(float).eps),  # scaled by 1/r, the asked factor is one
        state_weight=np.eye(modes.fast_mode_count),
        input_weight=1.0,
    )


def opinion(case: Instance) -> str:
    try:
        problem = on_fast_modes(case)
        lmi = CompiledLmi(
            a=problem.a,
            b=problem.b,
            objective="largest_margin",
            full=False,
            state_weight=problem.state_weight,
            input_weight=1.0,
        )
        found = lmi.solve(problem)
    except NoSolution as nothing:
        return (
            INFEASIBLE
            if "infeasible" in str(nothing) and "inaccurate" not in str(nothing)
            else CANNOT_TELL
        )
    if StateFeedbackOfBall.holds(**StateFeedbackOfBall.certificate_numbers(problem, found)):
        return FEASIBLE
    telling = lmi.problem.status == "optimal" and -lmi.problem.value < -TELLING
    return INFEASIBLE if telling else CANNOT_TELL


def row(gap: float, cases: list[Instance]) -> dict[str, object]:
    said = []
    seconds = []
    for case in cases:
        started = time.perf_counter()
        said.append(opinion(case))
        seconds.append(time.perf_counter() - started)
    right, wrong = (FEASIBLE, INFEASIBLE) if gap > 0 else (INFEASIBLE, FEASIBLE)
    counts = Counter(said)
    models = [(case.linear.order, case.kind) for case in cases]
    row = told(
        ("random", "modal_lmi_alone", gap), models, [word == FEASIBLE for word in said], seconds
    )
    return row | {
        "misses": named([model for model, word in zip(models, said, strict=True) if word != right]),
        "agrees": counts[right],
        "cannot_tell": counts[CANNOT_TELL],
        "contradicts": counts[wrong],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--gaps", type=float, nargs="+", default=GAPS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for gap in arguments.gaps:
        new = row(gap, instances("random", gap, arguments.count, (1, 32)))
        kept(new)
        print(*new.items(), flush=True)


if __name__ == "__main__":
    main()
