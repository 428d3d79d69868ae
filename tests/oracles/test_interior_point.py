"""Interior-point method for Hermitian constraints: an optimum by hand, another solver, the meaning
of its dual variables, and a program without a solution."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.certificates.problem import NoSolution
from ssm_study.synthesis.interior_point import HermitianProgram
from ssm_study.synthesis.measured_discs_program import ConeProgram

UNKNOWNS = 5
BLOCKS = 4
SIZE = 6
BOX = 3.0
ACCURACY = 1e-8


def random_hermitian(rng: np.random.Generator, *shape: int):
    real = rng.standard_normal(shape)
    imaginary = rng.standard_normal(shape)
    matrices = real + 1j * imaginary
    transposed = np.swapaxes(matrices, -1, -2)
    return matrices + np.conj(transposed)


def random_program(seed: int) -> HermitianProgram:
    """The unknowns in a box, and matrices that are positive at zero."""
    rng = np.random.default_rng(seed)
    box = np.eye(UNKNOWNS)
    small = random_hermitian(rng, BLOCKS, SIZE, SIZE)
    constant = 0.1 * small + 2 * np.eye(SIZE)
    goal = rng.standard_normal(UNKNOWNS)
    linear = random_hermitian(rng, UNKNOWNS, BLOCKS, SIZE, SIZE)
    rows = np.concatenate([box, -box])
    bounds = np.full(2 * UNKNOWNS, -BOX)
    return HermitianProgram(goal=goal, constant=constant, linear=linear, rows=rows, bounds=bounds)


def test_the_optimum_by_hand_with_its_dual_matrix() -> None:
    off_diagonal = np.array([[0, 1j], [-1j, 0]])
    linear = off_diagonal[None, None]
    identity = np.eye(2, dtype=complex)
    constant = identity[None]
    far = np.array([-10.0])
    row = -np.ones((1, 1))
    goal = np.ones(1)
    program = HermitianProgram(goal=goal, constant=constant, linear=linear, rows=row, bounds=far)
    x, dual = program.maximise(ACCURACY)
    np.testing.assert_allclose(x, [1.0], atol=1e-6)
    hermitian = np.array([[1, -1j], [1j, 1]])
    expected = hermitian / 2
    np.testing.assert_allclose(dual[0], expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_another_solver_finds_the_same_optimum(seed) -> None:
    program = random_program(seed)
    cones = ConeProgram(unknowns=UNKNOWNS)
    cones.add_rows(program.rows, program.bounds)
    for k in range(BLOCKS):
        cones.add_semidefinite(program.constant[k], program.linear[:, k])
    expected = cones.minimise(-program.goal)
    x, _ = program.maximise(ACCURACY)
    optimum = program.goal @ x
    assert optimum == pytest.approx(program.goal @ expected, rel=1e-6)
    linear_part = np.tensordot(x, program.linear, axes=1)
    matrices = program.constant + linear_part
    eigenvalues = np.linalg.eigvalsh(matrices)
    assert eigenvalues.min() > -1e-7


def test_the_dual_matrices_are_slopes_of_the_optimum() -> None:
    program = random_program(0)
    rng = np.random.default_rng(9)
    change = random_hermitian(rng, BLOCKS, SIZE, SIZE)
    _, dual = program.maximise(ACCURACY)
    optima = []
    for step in (1e-3, -1e-3):
        constant = program.constant + step * change
        moved = replace(program, constant=constant)
        x, _ = moved.maximise(ACCURACY)
        optima.append(program.goal @ x)
    difference = optima[0] - optima[1]
    products = dual * np.conj(change)
    expected = 2e-3 * products.sum().real
    assert difference == pytest.approx(expected, rel=1e-3)


def test_the_method_starts_where_the_constant_matrix_is_indefinite_and_no_row_constrains() -> None:
    constant = -np.ones((1, SIZE, SIZE))
    identity = np.eye(SIZE)
    program = HermitianProgram(
        goal=-np.ones(1),
        constant=constant.astype(complex),
        linear=identity[None, None].astype(complex),
        rows=np.zeros((0, 1)),
        bounds=np.zeros(0),
    )
    x, _ = program.maximise(ACCURACY)
    np.testing.assert_allclose(x, [SIZE], atol=1e-5)


def test_constraints_that_contradict_each_other_have_no_solution() -> None:
    program = random_program(0)
    beyond_the_box = np.full(2 * UNKNOWNS, BOX)
    contradictory = replace(program, bounds=beyond_the_box)
    with pytest.raises(NoSolution):
        contradictory.maximise(ACCURACY)
