"""Objectives for a linear matrix inequality: any solution, the largest margin, or the smallest
guaranteed cost."""

from typing import Any

import cvxpy as cp
import numpy as np

from ssm_study.certificates.theorem import Blocks, symmetric_from_upper

Goal = tuple[cp.Expression, list[cp.Constraint]]


def goal_and_constraints(
    objective: str, upper: Blocks, p: cp.Expression, at: int, performance: list[cp.Expression]
) -> Goal:
    """Objective and constraints of a program that solves one matrix inequality. The inequality is
    given by its upper triangle, linear in P and other unknowns.

    `feasibility`: any solution. `largest_margin`: `max t` with the matrix `>= t I` at fixed trace,
    deepest inside. `guaranteed_cost`: `min trace Z`, `Z >= P^{-1}`, with rows of `performance`
    coupled to block `at`. Source: [Z26]; docs/theory.md, "With neurons".
    """
    if objective != "guaranteed_cost":
        matrix = cp.bmat(symmetric_from_upper(upper))
        t = cp.Variable()
        one = np.eye(matrix.shape[0])
        if objective == "feasibility":
            constant = cp.Constant(0)
            return constant, [matrix >> one]
        margin = t * one
        is_deep_inside = matrix >> margin
        has_fixed_trace = cp.trace(matrix) == len(one)
        return -t, [is_deep_inside, has_fixed_trace]
    blocks = _append_performance_rows(upper, at, performance)
    bordered = cp.bmat(symmetric_from_upper(blocks))
    one = np.eye(p.shape[0])
    z = cp.Variable(p.shape, symmetric=True)
    schur_complement = cp.bmat([[z, one], [one, p]])
    constraints = [bordered >> 0, schur_complement >> 0]
    return cp.trace(z), constraints


def _append_performance_rows(upper: Blocks, at: int, performance: list[cp.Expression]) -> Blocks:
    """Extend a symmetric block matrix by the rows of a performance measure. The rows are coupled to
    block `at`."""
    zeros: list[Any] = [0] * len(performance)
    bordered = [[*row, *zeros] for row in upper]
    bordered[at][-len(zeros) :] = [rows.T for rows in performance]
    for i, rows in enumerate(performance):
        bordered.append([np.eye(rows.shape[0]), *zeros[i + 1 :]])
    return bordered
