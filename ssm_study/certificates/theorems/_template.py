"""Empty theorem to copy: replace this line by the statement in one sentence that a control engineer
would say.

Problem. The system with its shapes, and what is sought.

Hypotheses. What must be true of the system for the statement to hold, and who checks it.

Statement. The inequality, then what it proves: which gain, in which metric, at which rate.

When not to use it. Where it is useless, too cautious, or says nothing.

Reference. [Z26], or authors, journal, year; number of theorem and equation; what differs from it
here.

Example. A case that can be done by hand, one that holds and one that does not; a test compares what
is printed.

>>> print("one line that holds, one that does not")
one line that holds, one that does not

How to use this file. Copy it into a package of your own that registers an entry point of the group
`ssm_study` (docs/howto_plant.md), or to `theorems/` here, as `<name>.py`: the file's name is the
theorem's. Take out `abstract=True`: the base class says what is not answered. The fields are what
`certificate.json` stores and reads back; `conditions` is what exact arithmetic decides and `verify`
derives again; `model_data` and `products` are what a tampered file is held against. Where gains are
searched, add a `Synthesis`, with `feedback_theorem` (`observer_theorem`) set to the class, whose
`solve` returns what `certificate_numbers` stores, and one yaml in `conf/synthesis/` with its
`_target_`; for gains that are given, call `NameOfTheTheorem.from_numbers({...}, status="given",
method="given", rate_limit=1.0)`. A hypothesis that is no matrix inequality is a condition on a
number: `"one input": [[2 - of.b.shape[1]]]` holds for one input alone, and a certificate for two is
false. A field that Python reserves is written with an underscore (`lambda_`) and stored without. A
multiplier that must stay diagonal is a vector, `Float[np.ndarray, "q"]`, and enters as
`theorem.multiplier_matrix(of.lambda_)`. A theorem for models with neurons has their matrix `e` as a
field: without it `verify` takes it for one that knows none.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

# or Observer, or Theorem where there is neither gain
from ssm_study.certificates.certificate import StateFeedback
from ssm_study.certificates.theorem import Blocks, VerificationContext


@dataclass(frozen=True, kw_only=True)
class NameOfTheTheorem(StateFeedback, abstract=True):
    """Equation of the theorem in one line. State here the shapes of its own fields (`y:
    Float[np.ndarray, "n n"]`), beside `a, b, alpha, beta, rate, p, k` of the base."""

    # {"x": ("k", "y")}: x = k y, exactly, is `proof.x` below; declare x and y as fields, too
    products: ClassVar[Mapping[str, tuple[str, str]]] = {}

    @staticmethod
    def conditions(proof: Any) -> dict[str, Blocks]:
        """Upper triangles of symmetric block matrices, all of which must be positive definite.

        On the diagonal a plain number is a block of size one; beside it 0 is a block of zeros.
        """
        return {
            "inequality": [[proof.p]],
            "rate above 0": [[proof.rate]],
            "rate below 1": [[1 - proof.rate]],
        }

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of the certificate that are matrices of the model."""
        return {"a": context.controlled.a, "b": context.controlled.b}

    @classmethod
    def largest_provable_rate(cls, context: VerificationContext) -> float | None:  # noqa: ARG003
        """Largest contraction rate that the theorem can prove for a model by the best gain; None
        where no formula is known."""
        return None

    @staticmethod
    def certificate_numbers(problem: Any, solution: Any) -> dict[str, Any]:
        """Collect from a synthesis problem and its solution every number that `conditions` uses."""
        ball = {"alpha": problem.ball.alpha, "beta": problem.ball.beta}
        model_matrices = {"a": problem.a, "b": problem.b}
        solved_matrices = {"p": solution.p, "k": solution.k}
        return ball | {"rate": problem.rate} | model_matrices | solved_matrices
