"""Objectives for a linear matrix inequality: any solution, the largest margin, or the smallest
guaranteed cost."""

from typing import Any

import cvxpy as cp
import numpy as np

from ssm_study.certificates.theorem import Blocks, symmetric_from_upper

Goal = tuple[cp.Expression, list[cp.Constraint]]


def goal_and_constraints(
    objective: str,
    upper_blocks: Blocks,
    p: cp.Expression,
    coupled_block: int,
    performance_rows: list[cp.Expression],
) -> Goal:
    """Objective and constraints of a semidefinite program that solves one matrix inequality. The
    inequality is given by its upper triangle, linear in P and other unknowns.

    `feasibility`: any solution. `largest_margin`: `max t` with the matrix `>= t I` at fixed trace,
    deepest inside. `guaranteed_cost`: `min trace Z`, `Z >= P^{-1}`, with rows of `performance_rows`
    coupled to block `coupled_block`. Source: [Z26]; docs/theory.md, "With neurons".
    """
    if objective != "guaranteed_cost":
        matrix = cp.bmat(symmetric_from_upper(upper_blocks))
        t = cp.Variable()
        row_count = matrix.shape[0]
        one = np.eye(row_count)
        if objective == "feasibility":
            constant = cp.Constant(0)
            return constant, [matrix >> one]
        margin = t * one
        is_deep_inside = matrix >> margin
        trace = cp.trace(matrix)
        trace_of_identity = len(one)
        has_fixed_trace = trace == trace_of_identity
        return -t, [is_deep_inside, has_fixed_trace]
    blocks = _append_performance_rows(upper_blocks, coupled_block, performance_rows)
    bordered = cp.bmat(symmetric_from_upper(blocks))
    state_count = p.shape[0]
    one = np.eye(state_count)
    z = cp.Variable(p.shape, symmetric=True)
    upper_row = [z, one]
    lower_row = [one, p]
    schur_complement = cp.bmat([upper_row, lower_row])
    constraints = [bordered >> 0, schur_complement >> 0]
    return cp.trace(z), constraints


def _append_performance_rows(
    upper_blocks: Blocks, coupled_block: int, performance_rows: list[cp.Expression]
) -> Blocks:
    """Extend a symmetric block matrix by the rows that express a quadratic cost. The rows are
    coupled to block `coupled_block`."""
    row_count = len(performance_rows)
    zeros: list[Any] = [0] * row_count
    bordered = [[*row, *zeros] for row in upper_blocks]
    bordered[coupled_block][-len(zeros) :] = [rows.T for rows in performance_rows]
    for i, rows in enumerate(performance_rows):
        identity = np.eye(rows.shape[0])
        remaining_zeros = zeros[i + 1 :]
        bordered.append([identity, *remaining_zeros])
    return bordered
