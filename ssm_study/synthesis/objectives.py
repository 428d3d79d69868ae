"""Objectives of a linear matrix inequality: any solution, the deepest inside, or the least
guaranteed cost."""

from typing import Any

import cvxpy as cp
import numpy as np

from ssm_study.certificates.theorem import Blocks, full

Goal = tuple[cp.Expression, list[cp.Constraint]]


def goal_and_constraints(
    objective: str, upper: Blocks, p: cp.Expression, at: int, performance: list[cp.Expression]
) -> Goal:
    """Goal and constraints of an inequality with this upper triangle, linear in P and other
    unknowns.

    `feasibility`: any solution. `largest_margin`: `max t` with the matrix `>= t I` at fixed trace,
    deepest inside. `guaranteed_cost`: `min trace Z`, `Z >= P^{-1}`, with rows of `performance`
    coupled to block `at`. Source: [Z26]; docs/theory.md, "With neurons".
    """
    if objective != "guaranteed_cost":
        matrix = cp.bmat(full(upper))
        t = cp.Variable()
        one = np.eye(matrix.shape[0])
        if objective == "feasibility":
            return cp.Constant(0), [matrix >> one]
        return -t, [matrix >> t * one, cp.trace(matrix) == len(one)]
    zeros: list[Any] = [0] * len(performance)
    bordered = [[*row, *zeros] for row in upper]
    bordered[at][-len(zeros) :] = [rows.T for rows in performance]
    bordered += [[np.eye(rows.shape[0]), *zeros[i + 1 :]] for i, rows in enumerate(performance)]
    one = np.eye(p.shape[0])
    z = cp.Variable(p.shape, symmetric=True)
    return cp.trace(z), [cp.bmat(full(bordered)) >> 0, cp.bmat([[z, one], [one, p]]) >> 0]
