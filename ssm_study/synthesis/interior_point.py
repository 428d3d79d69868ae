"""Interior-point method for programs with few unknowns and many small Hermitian matrix constraints.

    maximise  goal' x   subject to   S_k = C_k + sum_j x_j L_jk >= 0,   s = R x - bounds >= 0

Primal and dual variables go together along the central path `S_k Z_k = mu I`, `s z = mu`, by the
direction of Helmberg, Kojima and Monteiro with predictor and corrector (Helmberg, Rendl,
Vanderbei & Wolkowicz, SIAM J. Optim. 6 (1996) 342-361; Mehrotra 1992). A step solves one system of
the size of the unknowns, `M_ij = sum_k tr(L_ik Z_k L_jk S_k^-1)`. A solver for sparse cones
factorises a dense block of some `4 G^4` entries for each matrix: with 15 matrices of size 12 and
27 unknowns Clarabel takes 3.8 s and this method 0.13 s.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.certificates.problem import NoSolution

STEPS = 60
SHARE = 0.95  # of the way to the boundary
FIRST_SIZE = 3e3  # of the first matrices: from smaller ones many short steps are taken
FIRST_PRODUCT = 300.0
LEAST_CENTRING = 1e-6
DUAL_ACCURACY = 1e-3  # of the dual equations' terms: rounding leaves up to 1e-4 at an optimum
DIVERGED = 1e20  # sum of products beyond which the constraints contradict each other
REGULAR = 1e-13  # added to the scaled Newton matrix

Matrices = Complex[np.ndarray, "A G G"]
Vector = Float[np.ndarray, "n"]
Rows = Float[np.ndarray, "r"]


def _adjoint(matrices: Any) -> Any:
    """Conjugate transpose of each matrix of a stack."""
    return np.conj(np.swapaxes(matrices, -1, -2))


def _hermitian_part(matrices: Any) -> Any:
    """Hermitian part of each matrix of a stack."""
    return (matrices + _adjoint(matrices)) / 2


def _inverse_factor(matrices: Any) -> Any:
    """Inverse of the Cholesky factor of each matrix of a stack."""
    factors = np.linalg.cholesky(matrices)
    return np.linalg.inv(factors)


def _longest_matrix_step(inverse_factor: Any, change: Any) -> float:
    """Longest step along a change of positive definite matrices that leaves all of them
    semidefinite."""
    relative_change = inverse_factor @ change @ _adjoint(inverse_factor)
    smallest = float(np.linalg.eigvalsh(relative_change).min())
    return -1 / smallest if smallest < 0 else np.inf


def _longest_vector_step(values: Any, change: Any) -> float:
    """Longest step along a change of positive numbers that leaves all of them nonnegative."""
    falling = change < 0
    ratios = -values[falling] / change[falling]
    return float(ratios.min(initial=np.inf))


@dataclass(frozen=True, kw_only=True)
class CentralPoint:
    """Point near the central path: unknowns x, matrices S and slacks s, and their dual variables Z
    and z."""

    x: Vector
    matrices: Matrices
    slacks: Rows
    dual_matrices: Matrices
    dual_slacks: Rows

    @property
    def complementarity(self) -> float:
        """Sum of all products of primal and dual variables, zero at the optimum."""
        of_matrices = (self.matrices * np.conj(self.dual_matrices)).sum().real
        return float(of_matrices + self.slacks @ self.dual_slacks)

    def step_along(
        self, direction: "CentralPoint", primal_step: float, dual_step: float
    ) -> "CentralPoint":
        """Point that primal and dual steps of given lengths along a direction lead to."""
        matrices = self.matrices + primal_step * direction.matrices
        dual_matrices = self.dual_matrices + dual_step * direction.dual_matrices
        return CentralPoint(
            x=self.x + primal_step * direction.x,
            matrices=_hermitian_part(matrices),
            slacks=self.slacks + primal_step * direction.slacks,
            dual_matrices=_hermitian_part(dual_matrices),
            dual_slacks=self.dual_slacks + dual_step * direction.dual_slacks,
        )

    def longest_steps(self, direction: "CentralPoint", share: float) -> tuple[float, float]:
        """Lengths of the primal and the dual step along a direction: a share of the way to the
        boundary, at most one."""
        primal_factor = _inverse_factor(self.matrices)
        dual_factor = _inverse_factor(self.dual_matrices)
        primal = min(
            _longest_matrix_step(primal_factor, direction.matrices),
            _longest_vector_step(self.slacks, direction.slacks),
        )
        dual = min(
            _longest_matrix_step(dual_factor, direction.dual_matrices),
            _longest_vector_step(self.dual_slacks, direction.dual_slacks),
        )
        return min(1.0, share * primal), min(1.0, share * dual)


@dataclass(frozen=True, kw_only=True)
class HermitianProgram:
    """Program with a linear goal, Hermitian matrix constraints that are affine in the unknowns, and
    linear constraints."""

    goal: Vector
    constant: Matrices
    linear: Complex[np.ndarray, "n A G G"]
    rows: Float[np.ndarray, "r n"]
    bounds: Rows

    def maximise(self, accuracy: float) -> tuple[Vector, Matrices]:
        """Maximise the goal, and return the unknowns at the optimum and the dual variables `Z_k` of
        the matrix constraints. Raises `NoSolution`."""
        try:
            return _PathFollowing.from_program(self).solve(accuracy)
        except np.linalg.LinAlgError as error:
            raise NoSolution(f"interior-point method: {error}") from error


@dataclass(frozen=True, kw_only=True)
class _PathFollowing:
    """Path-following method for one program."""

    program: HermitianProgram
    stacked: Complex[np.ndarray, "n AGG"]
    conjugate: Complex[np.ndarray, "A n GG"]
    side_by_side: Complex[np.ndarray, "A G nG"]

    @classmethod
    def from_program(cls, program: HermitianProgram) -> "_PathFollowing":
        """Arrange the coefficient matrices of a program in the layouts that the products need."""
        linear = np.ascontiguousarray(program.linear)
        n, blocks, size, _ = linear.shape
        by_block = np.swapaxes(linear, 0, 1).reshape(blocks, n, size * size)
        side_by_side = linear.transpose(1, 2, 0, 3).reshape(blocks, size, n * size)
        return cls(
            program=program,
            stacked=linear.reshape(n, blocks * size * size),
            conjugate=np.conj(by_block),
            side_by_side=np.ascontiguousarray(side_by_side),
        )

    def matrices_at(self, x: Vector) -> Matrices:
        """Linear part of the constrained matrices, `sum_j x_j L_j`."""
        return (x @ self.stacked).reshape(self.program.constant.shape)

    def inner_products(self, matrices: Matrices) -> Vector:
        """Inner product of given matrices with the coefficient matrices of each unknown."""
        blocks, size, _ = matrices.shape
        columns = matrices.reshape(blocks, size * size, 1)
        products = self.conjugate @ columns
        return np.asarray(products.sum(axis=0)[:, 0].real)

    def initial_point(self) -> CentralPoint:
        """First point of the central path: unknowns at zero, far inside all constraints. Each
        product of primal and dual variables is `FIRST_PRODUCT`."""
        program = self.program
        x = np.zeros(len(program.goal))
        largest_entry = float(np.abs(program.constant).max())
        smallest_eigenvalue = float(np.linalg.eigvalsh(program.constant).min())
        largest = FIRST_SIZE * max(1.0, largest_entry, -2 * smallest_eigenvalue)
        identity = np.eye(program.constant.shape[-1])
        matrices = program.constant + largest * identity
        slacks = np.maximum(-program.bounds, FIRST_SIZE)
        factor = _inverse_factor(matrices)
        return CentralPoint(
            x=x,
            matrices=matrices,
            slacks=slacks,
            dual_matrices=FIRST_PRODUCT * _adjoint(factor) @ factor,
            dual_slacks=FIRST_PRODUCT / slacks,
        )

    def solve(self, accuracy: float) -> tuple[Vector, Matrices]:
        """Follow the central path of the program to the optimum, and return the unknowns and the
        dual matrices there. Raises `LinAlgError` where it does not get there."""
        point = self.initial_point()
        count = point.matrices[:, :, 0].size + len(point.slacks)
        for _ in range(STEPS):
            step = _NewtonStep.at_point(self, point)
            gap = point.complementarity
            if not gap < DIVERGED:
                break
            size = 1 + abs(float(self.program.goal @ point.x))
            if step.is_feasible(accuracy) and gap < accuracy * size:
                return point.x, point.dual_matrices
            predictor = step.direction(0.0)
            ends = point.longest_steps(predictor, 1.0)
            remaining_share = point.step_along(predictor, *ends).complementarity / gap
            centring = min(max(remaining_share**3, LEAST_CENTRING), 1.0)
            corrector = step.direction(centring * gap / count, predictor)
            steps = point.longest_steps(corrector, SHARE)
            point = point.step_along(corrector, *steps)
        raise np.linalg.LinAlgError("no convergence")


@dataclass(frozen=True, kw_only=True)
class _NewtonStep:
    """Newton equations of the central path at one point, with their residuals."""

    path: _PathFollowing
    point: CentralPoint
    inverse: Matrices
    matrix_residual: Matrices
    slack_residual: Rows
    dual_residual: Vector
    dual_size: float
    newton_matrix: Float[np.ndarray, "n n"]
    newton_inverse: Float[np.ndarray, "n n"]

    @classmethod
    def at_point(cls, path: _PathFollowing, point: CentralPoint) -> "_NewtonStep":
        """Set up the Newton equations of the central path at a point near it."""
        program = path.program
        factor = _inverse_factor(point.matrices)
        inverse = _adjoint(factor) @ factor
        of_maps = path.inner_products(point.dual_matrices)
        of_rows = program.rows.T @ point.dual_slacks
        blocks, size, _ = inverse.shape
        n = len(program.goal)
        from_left = point.dual_matrices @ path.side_by_side
        by_unknown = from_left.reshape(blocks, size, n, size).swapaxes(1, 2)
        products = by_unknown.reshape(blocks, n * size, size) @ inverse
        flat_products = products.reshape(blocks, n, size * size)
        of_matrices = (path.conjugate @ flat_products.swapaxes(1, 2)).sum(axis=0).real
        ratios = point.dual_slacks / point.slacks
        newton = (of_matrices + of_matrices.T) / 2
        newton = newton + program.rows.T @ (ratios[:, None] * program.rows)
        root = 1 / np.sqrt(np.diagonal(newton))
        scale = np.outer(root, root)
        return cls(
            path=path,
            point=point,
            inverse=inverse,
            matrix_residual=program.constant + path.matrices_at(point.x) - point.matrices,
            slack_residual=program.rows @ point.x - program.bounds - point.slacks,
            dual_residual=-(program.goal + of_maps + of_rows),
            dual_size=1 + float(np.abs(of_maps).max()),
            newton_matrix=newton,
            newton_inverse=np.linalg.inv(newton * scale + REGULAR * np.eye(n)) * scale,
        )

    def is_feasible(self, accuracy: float) -> bool:
        """Whether a point meets the constraints to a given accuracy, and the dual equations
        roughly."""
        of_rows = self.slack_residual / (1 + np.abs(self.path.program.bounds))
        largest = max(np.abs(self.matrix_residual).max(), np.abs(of_rows).max(initial=0.0))
        dual = np.abs(self.dual_residual).max() / self.dual_size
        return bool(largest < accuracy and dual < max(accuracy, DUAL_ACCURACY))

    def direction(self, centre: float, predictor: CentralPoint | None = None) -> CentralPoint:
        """Direction of a Newton step to the point of the central path at which primal and dual
        variables have a given product. With a predictor, its second-order terms are
        subtracted."""
        path, point, inverse = self.path, self.point, self.inverse
        wanted_matrices = centre * inverse - point.dual_matrices
        wanted_slacks = centre - np.zeros_like(point.slacks)
        if predictor is not None:
            second = predictor.dual_matrices @ predictor.matrices
            wanted_matrices = wanted_matrices - _hermitian_part(second @ inverse)
            wanted_slacks = centre - predictor.slacks * predictor.dual_slacks
        dual_change = wanted_slacks / point.slacks - point.dual_slacks
        ratios = point.dual_slacks / point.slacks
        rows = path.program.rows
        of_matrices = wanted_matrices - self._dual_change(self.matrix_residual)
        right = path.inner_products(of_matrices)
        right = right + rows.T @ (dual_change - ratios * self.slack_residual)
        right = right - self.dual_residual
        x = self.newton_inverse @ right
        x = x + self.newton_inverse @ (right - self.newton_matrix @ x)
        matrices = path.matrices_at(x) + self.matrix_residual
        slacks = rows @ x + self.slack_residual
        return CentralPoint(
            x=x,
            matrices=matrices,
            slacks=slacks,
            dual_matrices=wanted_matrices - self._dual_change(matrices),
            dual_slacks=dual_change - ratios * slacks,
        )

    def _dual_change(self, change: Matrices) -> Matrices:
        """Decrease of the dual matrices that a change of the primal matrices causes, `Z dS
        S^-1`."""
        return _hermitian_part(self.point.dual_matrices @ change @ self.inverse)
