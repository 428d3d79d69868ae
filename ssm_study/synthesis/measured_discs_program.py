"""Convex program for weights, multipliers and radius of a disc of model errors, with constraints at
selected frequencies.

With every signal of the loop as a row over its free signals at `z = e^{jw}` the theorem's
inequality is, by the Kalman-Yakubovich-Popov lemma, a Hermitian matrix that must be positive at
every angle:

    |e - c m|^2 - X(w) |m|^2 - Y(w) |u|^2 + sum of multipliers times forms of the static maps  >  0

`X = kappa^2 (floor^2 + |W|^2)` and `Y = kappa^2 |V|^2` are `sum_j x_j phi_j(w)`, `phi_j = 2 cos(j
w) / |den|^2`, so all is linear in x, y, the multipliers and `nu = kappa^2`. A few angles are
solved, the worst violated of a grid join them, until none is. Source: docs/theory.md, "Measured
discs".
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.synthesis.interior_point import HermitianProgram

Angles = Float[np.ndarray, "F"]
Unknowns = Float[np.ndarray, "n"]
QuadraticForm = Float[np.ndarray, "N N"]
FormsOverAngles = Complex[np.ndarray, "F G G"]
ConstraintRows = Float[np.ndarray, "R n"]
Bounds = Float[np.ndarray, "R"]
HermitianForms = Complex[np.ndarray, "n G G"]
Duals = Complex[np.ndarray, "D G G"]

# Even steps too: those of the geometric row are 0.09 wide near pi, wider than a loop's dip there.
GRID = np.union1d(np.geomspace(1e-4, np.pi, 300), np.linspace(0, np.pi, 257))
FIRST = 14  # angles that are solved first
MORE = 6  # of the worst violated join at a time
ROUNDS = 12
VIOLATED = 1e-9  # a smallest eigenvalue below minus this, where |e|^2 counts one, violates
SOLVED = 1e-7  # by the solver, where angles may miss by more
IDLE = 0.1  # a smallest eigenvalue above this decides nothing
SMALL = 3  # matrices up to this size are left to Clarabel, which is as fast there
MOST = 1e8  # of a multiplier, in units where its form is of the size of |e|^2
Forms = Complex[np.ndarray, "A F G G"]


@dataclass(frozen=True, kw_only=True)
class LoopForms:
    """Quadratic forms of a closed loop's states and free signals: one for the disc of model errors,
    and one for each multiplier."""

    a: Float[np.ndarray, "x x"]
    b: Float[np.ndarray, "x g"]
    model: QuadraticForm
    input: QuadraticForm
    centred: dict[float, QuadraticForm]
    multipliers: Float[np.ndarray, "A N N"]
    names: tuple[tuple[str, int], ...]

    @classmethod
    def from_context(
        cls, theorem: type[MeasuredDiscs], context: VerificationContext, centres: Sequence[float]
    ) -> "LoopForms":
        """Compute the quadratic forms of a closed loop from the model and its gains."""
        of, counts = loop_without_filters(theorem, context)
        rows = theorem.signal_matrices(of)
        order = len(rows.xi)
        names = []
        for name, count in counts.items():
            names += [(name, i) for i in range(count)]
        centred = {}
        for c in centres:
            deviation = rows.e - c * rows.m
            centred[c] = deviation.T @ deviation
        multipliers = [_multiplier_form(theorem, of, counts, *name) for name in names]
        a = rows.step[:, :order]
        b = rows.step[:, order:]
        model = rows.m.T @ rows.m
        return cls(
            a=a,
            b=b,
            model=model,
            input=rows.u.T @ rows.u,
            centred=centred,
            multipliers=np.stack(multipliers),
            names=tuple(names),
        )

    def at_angles(self, angles: Angles) -> "FormsAtAngles":
        """Quadratic forms of a closed loop at each frequency, as functions of the free signals
        alone."""
        order, free_signals = self.b.shape
        count = len(angles)
        z = np.exp(1j * angles)[:, None, None]
        shifted = z * np.eye(order) - self.a
        inputs = np.broadcast_to(self.b, (count, order, free_signals))
        to_state = np.linalg.solve(shifted, inputs)
        free = np.broadcast_to(np.eye(free_signals), (count, free_signals, free_signals))
        signals = np.concatenate([to_state, free], axis=1)
        adjoint = np.conj(signals.transpose(0, 2, 1))
        model = adjoint @ self.model @ signals
        forms_at_angles_input = adjoint @ self.input @ signals
        centred = {c: adjoint @ form @ signals for c, form in self.centred.items()}
        multipliers = adjoint @ self.multipliers[:, None] @ signals
        return FormsAtAngles(
            angles=angles,
            model=model,
            input=forms_at_angles_input,
            centred=centred,
            multipliers=multipliers,
        )

    @property
    def frequency_grid(self) -> Angles:
        """Frequency grid that is fine near the resonances of the closed loop."""
        modes = np.linalg.eigvals(self.a)
        own = np.abs(np.angle(modes))
        width = np.maximum(1 - np.abs(modes), 1e-4)
        shares = np.array([-1.0, -0.3, 0.0, 0.3, 1.0])
        around = own + width * shares[:, None]
        on_circle = np.clip(around, 0.0, np.pi)
        return np.union1d(GRID, on_circle)


@dataclass(frozen=True, kw_only=True)
class FormsAtAngles:
    """Quadratic forms of a closed loop in its free signals, such as the model error, as Hermitian
    matrices at several frequencies."""

    angles: Angles
    model: FormsOverAngles
    input: FormsOverAngles
    centred: dict[float, FormsOverAngles]
    multipliers: Forms

    def combine_with(self, other: "FormsAtAngles") -> "FormsAtAngles":
        """Join the quadratic forms of a closed loop at two sets of frequencies."""
        angles = np.concatenate([self.angles, other.angles])
        model = np.concatenate([self.model, other.model])
        forms_at_angles_input = np.concatenate([self.input, other.input])
        centred = {}
        for centre, form in self.centred.items():
            centred[centre] = np.concatenate([form, other.centred[centre]])
        multipliers = np.concatenate([self.multipliers, other.multipliers], axis=1)
        return FormsAtAngles(
            angles=angles,
            model=model,
            input=forms_at_angles_input,
            centred=centred,
            multipliers=multipliers,
        )


def loop_without_filters(
    theorem: type[MeasuredDiscs], context: VerificationContext
) -> tuple[Any, dict[str, int]]:
    """Closed-loop matrices and names with counts of the multipliers for the theorem on bounded
    model errors, with all weighting filters set to zero."""
    loop = theorem.loop_matrices(context)
    lambda_out = 3 if loop["beta_out"] > 0 else 0
    counts = {"lambda_p": 1, "lambda_out": lambda_out}
    if "e" in loop:
        neurons = loop["g"].shape[0]
        counts["lambda_"] = 3 * neurons
    ball = context.balls.input
    slopes = {"alpha": ball.alpha, "beta": ball.beta}
    no_weight = np.zeros((1, 1))
    weights = {"weight_output": no_weight, "weight_input": no_weight}
    multipliers = {name: np.zeros((1, count)) for name, count in counts.items()}
    fields_of_theorem = SimpleNamespace(**loop, **slopes, **weights, **multipliers)
    return fields_of_theorem, counts


def _multiplier_form(
    theorem: type[MeasuredDiscs], loop_fields: Any, counts: dict[str, int], name: str, index: int
) -> QuadraticForm:
    """Quadratic form of the closed loop's signals that belongs to one multiplier."""
    unit = np.zeros((1, counts[name]))
    unit[0, index] = 1.0
    alone = SimpleNamespace(**{**vars(loop_fields), name: unit})
    signals = theorem.signal_matrices(alone)
    pairs = theorem.static_map_constraints(alone, signals)
    forms = [multiplier * form for multiplier, form in pairs]
    return np.asarray(np.sum(forms, axis=0))


@dataclass(kw_only=True)
class ConeProgram:
    """Linear program with semidefinite constraints, solved by the library Clarabel."""

    unknowns: int
    rows: list[ConstraintRows] = field(default_factory=list)
    bounds: list[Bounds] = field(default_factory=list)
    blocks: list[tuple[Any, Any]] = field(default_factory=list)

    def add_rows(self, rows: ConstraintRows, bounds: Bounds) -> None:
        """Append linear constraints `rows x >= bounds` to the program."""
        self.rows.append(np.atleast_2d(rows))
        self.bounds.append(np.atleast_1d(bounds))

    def add_semidefinite(
        self, constant: Complex[np.ndarray, "G G"], linear: HermitianForms
    ) -> None:
        """Append the constraint that a Hermitian matrix, affine in the unknowns, is positive
        semidefinite."""
        constant_triangle = _real_upper_triangles(constant[None])[0]
        linear_triangles = _real_upper_triangles(linear)
        self.blocks.append((constant_triangle, linear_triangles))

    def minimise(self, cost: Unknowns, accuracy: float = 1e-8) -> Unknowns:
        """Minimise a linear cost under the constraints of the program. Raises `NoSolution` with the
        solver's status if there is no solution."""
        import clarabel  # slow to load

        rows = [-row for row in self.rows]
        right = [-bound for bound in self.bounds]
        linear_constraints = sum(map(len, self.bounds))
        cones: list[Any] = [clarabel.NonnegativeConeT(linear_constraints)]
        for constant, linear in self.blocks:
            rows.append(-linear.T)
            right.append(constant)
            entries = len(constant)  # of a triangle with a diagonal of `side`
            side = round((float(np.sqrt(8 * entries + 1)) - 1) / 2)
            cones.append(clarabel.PSDTriangleConeT(side))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = 120
        settings.tol_gap_rel = accuracy
        settings.tol_gap_abs = accuracy
        settings.tol_feas = accuracy
        no_quadratic = scipy.sparse.csc_matrix((self.unknowns, self.unknowns))
        linear_cost = np.asarray(cost, dtype=float)
        dense_matrix = np.concatenate(rows)
        matrix = scipy.sparse.csc_matrix(dense_matrix)
        bound = np.concatenate(right)
        solver = clarabel.DefaultSolver(no_quadratic, linear_cost, matrix, bound, cones, settings)
        solution = solver.solve()
        status = str(solution.status)
        if status not in ("Solved", "AlmostSolved"):
            raise NoSolution(f"Clarabel: {status}")
        return np.array(solution.x)


def _real_upper_triangles(hermitian: HermitianForms) -> Float[np.ndarray, "n t"]:
    """Upper triangles of the real symmetric forms of Hermitian matrices, in the order that the
    solver Clarabel requires."""
    real = hermitian.real
    imaginary = hermitian.imag
    top = np.concatenate([real, -imaginary], axis=2)
    bottom = np.concatenate([imaginary, real], axis=2)
    whole = np.concatenate([top, bottom], axis=1)
    size = whole.shape[1]
    columns, lines = np.tril_indices(size)  # (column, row) with row <= column: column by column
    scale = np.where(columns == lines, 1.0, np.sqrt(2))
    triangles = whole[:, lines, columns]
    return np.asarray(triangles * scale)


@dataclass(frozen=True, kw_only=True)
class FrequencyProgram:
    """Linear program with matrix constraints that must hold at every frequency of a grid."""

    constant: FormsOverAngles
    linear: Complex[np.ndarray, "n F G G"]
    rows: ConstraintRows
    bounds: Bounds

    def smallest_eigenvalues(self, unknowns: Unknowns) -> Angles:
        """Smallest eigenvalue of the constrained matrix at each frequency, for given values of the
        unknowns."""
        whole = self.constant + np.tensordot(unknowns, self.linear, axes=1)
        eigenvalues = np.linalg.eigvalsh(whole)
        return np.asarray(eigenvalues[:, 0])

    def maximise(
        self,
        goal: Unknowns,
        accuracy: float = VIOLATED,
        first_angles: Sequence[int] = (),
        least_goal: float = -np.inf,
    ) -> tuple[Unknowns, list[int]]:
        """Maximise a linear goal under matrix constraints at all frequencies by cutting planes, and
        return the frequencies that decide the solution. Raises `NoSolution`.

        The `first_angles`, by default spread evenly, are solved first. Angles that are far from
        deciding leave again. Fewer angles give an upper bound of the goal: once it is below
        `least_goal`, it is returned in place of the optimum.
        """
        x, chosen, _ = self.maximise_with_duals(goal, accuracy, first_angles, least_goal)
        return x, chosen

    def maximise_with_duals(
        self,
        goal: Unknowns,
        accuracy: float = VIOLATED,
        first_angles: Sequence[int] = (),
        least_goal: float = -np.inf,
    ) -> tuple[Unknowns, list[int], Duals | None]:
        """Optimum of `maximise` and its dual matrices at the frequencies that decide it, where the
        solver gives them."""
        count = len(self.constant)
        fresh = list(first_angles) or _evenly_spread_indices(count, FIRST)
        solver_accuracy = SOLVED if accuracy > SOLVED else VIOLATED
        deciding = list[int]()
        for _ in range(ROUNDS):
            chosen = deciding + fresh
            x, duals = self._maximise_at(chosen, goal, solver_accuracy)
            if goal @ x < least_goal:
                break
            lowest = self.smallest_eigenvalues(x)
            violated = _local_minima(lowest, -accuracy)
            fresh = [k for k in violated if k not in chosen][:MORE]
            if not fresh:
                break
            deciding = [k for k in chosen if lowest[k] < IDLE]
        return x, chosen, duals

    def _maximise_at(
        self, chosen: Sequence[int], goal: Unknowns, accuracy: float
    ) -> tuple[Unknowns, Duals | None]:
        """Maximise a linear goal under the matrix constraints at some frequencies, with their dual
        matrices where the solver gives them. Raises `NoSolution`."""
        constant = self.constant[chosen]
        linear = self.linear[:, chosen]
        if constant.shape[-1] > SMALL:
            program = HermitianProgram(
                goal=goal, constant=constant, linear=linear, rows=self.rows, bounds=self.bounds
            )
            with suppress(NoSolution):  # else Clarabel, which takes longer
                return program.maximise(accuracy)
        cones = ConeProgram(unknowns=len(goal))
        cones.add_rows(self.rows, self.bounds)
        for k in range(len(chosen)):
            cones.add_semidefinite(constant[k], linear[:, k])
        return cones.minimise(-goal, accuracy), None


def _evenly_spread_indices(item_count: int, chosen_count: int) -> list[int]:
    """Indices of a given number of list items that are spread evenly over the list."""
    places = np.linspace(0, item_count - 1, chosen_count).round()
    return [int(place) for place in np.unique(places)]


def _local_minima(values: Angles, threshold: float) -> list[int]:
    """Indices of those local minima of a sequence that lie below a threshold, in ascending order of
    value."""
    padded = np.concatenate([[np.inf], values, [np.inf]])
    no_larger_than_left = values <= padded[:-2]
    no_larger_than_right = values <= padded[2:]
    is_minimum = no_larger_than_left & no_larger_than_right & (values < threshold)
    minima = np.flatnonzero(is_minimum)
    smallest_first = np.argsort(values[minima])
    return [int(k) for k in minima[smallest_first]]


def form_norms(forms: Complex[np.ndarray, "A F G G"]) -> Float[np.ndarray, "A"]:
    """Norm of each quadratic form, by which the form's multiplier is scaled."""
    largest_entries = np.abs(forms).max(axis=(1, 2, 3))
    return np.asarray(np.maximum(largest_entries, np.finfo(float).tiny))
