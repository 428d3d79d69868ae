"""Base classes of theorems: how certificates are stored, decided in exact arithmetic, read back and
verified.

A theorem is one file in `theorems/` with one final class: its fields are what `certificate.json`
stores, its `conditions` block matrices, stated once with `+, -, *, @, .T`; the caller chooses the
numbers (floats, exact ones, a solver's expressions). How floats are decided: docs/theory.md, "The
verdict".
"""

import importlib
import importlib.util
import inspect
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.exact import ExactMatrix, is_positive_definite
from ssm_study.extensions import import_trusted_modules
from ssm_study.refusal import require
from ssm_study.systems import JacobianBall, JacobianBalls, StructuredSystem

FOLDER = "ssm_study.certificates.theorems"
AGAIN = "synthesise again"
UNFIT = "the matrices do not fit the model"

# Fields that stand beside the proof: no condition may use them.
INFORMATION = (
    "certified",
    "margin",
    "condition",
    "rate_limit",
    "method",
    "solver_status",
    "seconds",
)

Symmetric = Float[np.ndarray, "s s"]

# Upper triangle of a symmetric block matrix: row `i` holds the blocks `i, i + 1, ...`; `0` is a
# block of zeros.
Blocks = list[list[Any]]


def symmetric_from_upper(upper_blocks: Blocks) -> Blocks:
    """Full symmetric block matrix, as rows of blocks, from the blocks of its upper triangle. Blocks
    of zeros become arrays of their size."""
    upper_blocks = [[_as_block(row[0]), *row[1:]] for row in upper_blocks]
    sizes = [row[0].shape[0] for row in upper_blocks]

    def block(i: int, j: int) -> Any:
        """Block at one place of a symmetric block matrix, transposed where only its mirror image is
        stored."""
        stored_block = upper_blocks[min(i, j)][abs(i - j)]
        if isinstance(stored_block, int):
            return np.zeros((sizes[i], sizes[j]))
        return stored_block if i <= j else stored_block.T

    return [[block(i, j) for j in range(len(sizes))] for i in range(len(sizes))]


def _as_block(diagonal_block: Any) -> Any:
    """Convert a plain number on the diagonal of a block matrix to a block of size one."""
    if isinstance(diagonal_block, int | float):
        return np.array([[float(diagonal_block)]])
    return diagonal_block


def assemble_blocks(rows: Blocks) -> Any:
    """Assemble a matrix from rows of blocks, in exact numbers if one of the blocks is exact,
    otherwise in floats."""
    blocks = [block for row in rows for block in row]
    if any(isinstance(block, ExactMatrix) for block in blocks):
        return ExactMatrix.block(rows)
    return np.block(rows)


def multiplier_matrix(multipliers: Any) -> Any:
    """Diagonal matrix with a vector of multipliers, floats or exact numbers, on its diagonal."""
    if isinstance(multipliers, ExactMatrix):
        return multipliers.diagonal_matrix()
    return np.diagflat(multipliers)


def scale_to_unit_diagonal(matrix: Symmetric) -> Symmetric:
    """Scale a symmetric matrix from both sides so that its diagonal is one. `D M D` with `D =
    diag(|M_ii|)^(-1/2)`, by which definiteness and conditioning do not depend on units."""
    sizes = np.abs(np.diagonal(matrix))
    positive_sizes = np.maximum(sizes, np.finfo(float).tiny)
    scale = 1 / np.sqrt(positive_sizes)
    scaled = scale[:, None] * matrix * scale
    return (scaled + scaled.T) / 2


def smallest_eigenvalue(matrix: Symmetric) -> float:
    """Smallest eigenvalue of a symmetric matrix."""
    ascending = np.linalg.eigvalsh(matrix)
    return float(ascending[0])


def scaled_condition_number(matrix: Float[np.ndarray, "n n"]) -> float:
    """Condition number of a symmetric matrix after it is scaled to a unit diagonal."""
    return float(np.linalg.cond(scale_to_unit_diagonal(matrix)))


@dataclass(frozen=True, kw_only=True)
class VerificationContext:
    """Data that a verifier computes from the model file, to compare them with a stored certificate.

    `system` is the model's recurrence. `controlled` is the system on which the state feedback acts;
    with integral action it is larger than the model. `gains` are the gain matrices of the other
    parts of the file, by their letter.
    """

    system: Any
    controlled: Any
    balls: JacobianBalls
    gains: Mapping[str, Float[np.ndarray, "r c"]]


@dataclass(frozen=True, kw_only=True)
class Theorem(ABC):
    """Base class of a certificate: stored matrices, and the matrix inequalities that they must
    satisfy.

    `certified` is the verdict of exact arithmetic on the stored floats; `margin` the smallest
    eigenvalue of the first condition scaled to a unit diagonal, `condition` the condition number of
    the metric's matrix scaled likewise. A class that is not declared `abstract=True` and leaves a
    question open is refused with a `TypeError` that names it, when it is defined.
    """

    alpha: float
    beta: float
    certified: bool
    margin: float
    condition: float
    method: str
    solver_status: str
    seconds: float

    final: ClassVar[bool] = False
    part: ClassVar[str]  # where it stands in `certificate.json`
    # The field that holds the metric or its inverse: its condition number is told, and it fixes the
    # order.
    metric_matrix: ClassVar[str]
    # Fields that are exact products of two others, rounded once: `{"x": ("k", "y")}`.
    products: ClassVar[Mapping[str, tuple[str, str]]] = {}

    def __init_subclass__(cls, *, abstract: bool = False, **options: Any) -> None:
        super().__init_subclass__(**options)
        unanswered = [name for name in ("metric_matrix", "part") if not hasattr(cls, name)]
        for name in dir(cls):
            member = getattr(cls, name, None)
            is_old_name = getattr(member, "__name__", name) != name
            if getattr(member, "__isabstractmethod__", False) and not is_old_name:
                unanswered.append(name)
        cls.final = not abstract
        if unanswered and cls.final:
            raise TypeError(f"theorem {cls.__name__} does not answer: {', '.join(unanswered)}")
        cls._refuse_undeclared_products()

    @classmethod
    def _refuse_undeclared_products(cls) -> None:
        """Raise `TypeError` for a theorem class that declares a product of matrices which are not
        fields of the class."""
        declared = {name for kind in cls.__mro__ for name in inspect.get_annotations(kind)}
        for product, factors in cls.products.items():
            for name in (product, *factors):
                if name not in declared:
                    equation = f"{product} = {' '.join(factors)}"
                    problem = f"the product {equation} uses {name}, which is no field"
                    raise TypeError(f"theorem {cls.__name__}: {problem}; declare it in the class")

    @staticmethod
    @abstractmethod
    def conditions(proof: Any) -> dict[str, Blocks]:
        """Matrices that must be positive definite for a theorem to hold, each keyed by a label.
        They are upper triangles of blocks; `proof` has every field and product."""

    @abstractmethod
    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of a certificate that are data of the model, recomputed from the model file."""

    @staticmethod
    @abstractmethod
    def required_ball(context: VerificationContext) -> JacobianBall:
        """Ball of Jacobians of the stored model, which the ball in a certificate must contain."""

    @classmethod
    @abstractmethod
    def largest_provable_rate(cls, context: VerificationContext) -> float | None:
        """Largest contraction rate that a theorem can prove for a model by the best gain; None
        where no formula is known."""

    @classmethod
    def name(cls) -> str:
        """Name of the file that defines a theorem, by which stored certificates refer to it."""
        return cls.__module__.rpartition(".")[2]

    @classmethod
    def _evaluate_conditions(
        cls, convert_number: Callable[[Any], Any], numbers: Mapping[str, Any]
    ) -> dict[str, Blocks]:
        """Block matrices of a theorem's conditions, computed from given numbers in floats or in
        exact arithmetic."""
        matrices = {label: convert_number(value) for label, value in numbers.items()}
        for label, (left, right) in cls.products.items():
            matrices[label] = matrices[left] @ matrices[right]
        conditions = cls.conditions(SimpleNamespace(**matrices))
        if not conditions:
            raise TypeError(f"theorem {cls.__name__} has no conditions, so it would always hold")
        return {label: symmetric_from_upper(upper) for label, upper in conditions.items()}

    @classmethod
    def float_conditions(cls, **numbers: Any) -> dict[str, Symmetric]:
        """Matrices of a theorem's conditions in floats, each scaled to a unit diagonal."""
        scaled = {}
        for label, blocks in cls._evaluate_conditions(np.atleast_2d, numbers).items():
            scaled[label] = scale_to_unit_diagonal(np.block(blocks))
        return scaled

    @classmethod
    def exact_conditions(cls, **numbers: Any) -> dict[str, ExactMatrix]:
        """Matrices of a theorem's conditions in exact rational arithmetic. Raises `ValueError`
        where the shapes do not fit."""
        blocks_by_label = cls._evaluate_conditions(ExactMatrix.from_floats, numbers)
        return {label: ExactMatrix.block(blocks) for label, blocks in blocks_by_label.items()}

    @classmethod
    def holds(cls, **numbers: Any) -> bool:
        """Whether all matrices of a theorem's conditions are positive definite, decided in exact
        arithmetic."""
        matrices = cls.exact_conditions(**numbers).values()
        return all(is_positive_definite(matrix) for matrix in matrices)

    @classmethod
    def from_numbers(
        cls,
        numbers: Mapping[str, Any],
        *,
        status: str,
        started: float | None = None,
        **information: Any,
    ) -> Any:
        """Construct a certificate from its numbers and decide in exact arithmetic whether the
        theorem's conditions hold.

        `numbers` are what `conditions` uses; products are computed exactly and rounded to floats.
        `status` says where the numbers come from (a solver's word, or "given"). `information` are
        the fields beside the proof: `method`, and `rate_limit` where the class has it (if no limit
        is known, 1.0, which no rate reaches). The seconds since `started`, a time of
        `time.perf_counter`, are stored.
        """
        started = time.perf_counter() if started is None else started
        certified = cls.holds(**numbers)
        first_condition, *_ = cls.float_conditions(**numbers).values()
        metric_matrix = numbers[cls.metric_matrix]
        information |= {
            "certified": certified,
            "margin": smallest_eigenvalue(first_condition),
            "condition": scaled_condition_number(metric_matrix),
            "solver_status": status,
            "seconds": time.perf_counter() - started,
        }
        products = cls._rounded_products(numbers)
        return cls(**(dict(numbers) | products | information))

    @classmethod
    def _rounded_products(cls, numbers: Mapping[str, Any]) -> dict[str, Float[np.ndarray, "r c"]]:
        """Matrix products that a certificate stores beside their factors, computed exactly and
        rounded to floats."""
        products = {}
        for name, (left, right) in cls.products.items():
            product = ExactMatrix.from_floats(numbers[left]) @ numbers[right]
            products[name] = product.to_floats()
        return products

    @property
    def variables(self) -> dict[str, Any]:
        """Stored numbers from which the conditions of a certificate are computed, without its
        products and without facts on the solution."""
        others = {*INFORMATION, *self.products}
        return {name: value for name, value in vars(self).items() if name not in others}

    def failed_checks(self, context: VerificationContext) -> list[str]:
        """One sentence for each claim of a certificate that does not hold for the model.

        A theorem that knows no neurons (a matrix `e`) proves nothing of a model with them, nor the
        reverse.
        """
        if isinstance(context.system, StructuredSystem) != hasattr(self, "e"):
            return [f": {UNFIT}"]
        model_matrices = self.model_data(context)
        stored = vars(self)
        try:
            conditions = self.exact_conditions(**self.variables)
        except ValueError:
            return [f": {UNFIT}"]
        for name, value in model_matrices.items():
            if np.shape(stored[name]) != np.shape(value):
                return [f": {UNFIT}"]
        messages = []
        derived = model_matrices | self._rounded_products(stored)
        for name, value in derived.items():
            if not np.array_equal(stored[name], value):
                messages.append(f".{name}: differs from what the model and the other matrices give")
        failing = [name for name, matrix in conditions.items() if not is_positive_definite(matrix)]
        holds = not failing
        if holds != self.certified:
            verdict = "holds" if holds else f"fails ({', '.join(failing)})"
            claim = f".certified = {self.certified}"
            messages.append(f"{claim}: in exact arithmetic the inequality {verdict}")
        return messages


def find_theorem(name: str) -> type[Theorem]:
    """Class of the theorem that a file of a given name defines, in `theorems/` or in an extension
    package."""
    module = f"{FOLDER}.{name}"
    may_be_a_file = name.isidentifier() and not name.startswith("_")
    if may_be_a_file and importlib.util.find_spec(module) is not None:
        importlib.import_module(module)
    elif may_be_a_file:
        import_trusted_modules(name)
    kinds: list[Any] = [Theorem]
    for kind in kinds:  # grows while it is read: subclasses of subclasses
        kinds += kind.__subclasses__()
    named_theorems = [kind for kind in kinds if kind.final and kind.name() == name]
    problem = "is not a theorem that this installation has"
    require(bool(named_theorems), "certificate.theorem", name, problem, AGAIN)
    return named_theorems[-1]
