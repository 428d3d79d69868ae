"""The form of theorems: every file answers the same questions, its example is right, and one file
is all it takes."""

import ast
import copy
import doctest
import importlib
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from ssm_study.certificates.certificate import Design, StateFeedback, certificate_digest
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.theorem import find_theorem
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis.design import DesignAttempt, failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

FOLDER = Path(__file__).resolve().parents[2] / "ssm_study" / "certificates" / "theorems"
FILES = sorted(path for path in FOLDER.glob("*.py") if path.name != "__init__.py")
QUESTIONS = (
    "Problem.",
    "Hypotheses.",
    "Statement.",
    "When not to use it.",
    "Reference.",
    "Example.",
)


def unanswered(text: str) -> list[str]:
    """Headings of the form that a module's docstring lacks, or that stand in another order."""
    docstring = ast.get_docstring(ast.parse(text))
    said = docstring or ""
    paragraphs = said.split("\n\n")
    starts = [paragraph.split(". ")[0].strip() + "." for paragraph in paragraphs]
    found = [start for start in starts if start in QUESTIONS]
    return [question for question in QUESTIONS if question not in found] or (
        [] if tuple(found) == QUESTIONS else ["order"]
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_theorem_answers_every_question_in_order(path: Path) -> None:
    text = path.read_text()
    assert unanswered(text) == []


def test_a_missing_or_misplaced_answer_is_found() -> None:
    text = (FOLDER / "state_feedback.py").read_text()
    assert unanswered(text.replace("When not to use it.", "Otherwise.")) == ["When not to use it."]
    assert unanswered(
        text.replace("Problem.", "Hypotheses.", 1).replace("\nHypotheses. E", "\nProblem. E")
    ) == ["order"]


@pytest.mark.parametrize(
    "path", [path for path in FILES if path.stem != "_template"], ids=lambda path: path.stem
)
def test_a_reference_names_its_equation_or_theorem(path: Path) -> None:
    text = path.read_text()
    docstring = ast.get_docstring(ast.parse(text))
    said = docstring or ""
    parts = said.split("\n\n")
    (reference,) = (part for part in parts if part.startswith("Reference."))
    assert re.search(r"eq\. \(\d+\)|Theorem \d|Lemma \d|section \d", reference)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_example_prints_what_it_says(path: Path) -> None:
    found = doctest.testmod(importlib.import_module(f"ssm_study.certificates.theorems.{path.stem}"))
    assert found.attempted > 0
    assert found.failed == 0


@pytest.mark.parametrize(
    "path", [path for path in FILES if path.stem != "_template"], ids=lambda path: path.stem
)
def test_an_example_that_is_wrong_is_found(path: Path) -> None:
    """Negative control: the last line that is printed, altered."""
    text = path.read_text()
    docstring = ast.get_docstring(ast.parse(text))
    said = docstring or ""
    doc_test_parser = doctest.DocTestParser()
    examples = doc_test_parser.get_examples(said)
    example = examples[-1]
    module = importlib.import_module(f"ssm_study.certificates.theorems.{path.stem}")
    assert example.want
    lines = example.want.rstrip().splitlines()
    wrong = said.replace(lines[-1], "something else")
    doc_test_parser = doctest.DocTestParser()
    test = doc_test_parser.get_doctest(wrong, vars(module).copy(), path.stem, None, None)
    doc_test_runner = doctest.DocTestRunner(verbose=False)
    failed = doc_test_runner.run(test, out=lambda _: None).failed
    assert failed > 0


def test_a_class_that_leaves_a_question_open_is_refused() -> None:
    names = "certificate_numbers, conditions, largest_provable_rate, model_data"
    questions = f"does not answer: {names}$"  # by the names of today alone
    with pytest.raises(TypeError, match=questions):

        class Incomplete(StateFeedback):
            pass


class Answered(StateFeedback, abstract=True):
    """Every question answered, for classes with one fault each."""

    @staticmethod
    def conditions(of):
        return {"one input": [[2 - of.b.shape[1]]], "inequality": [[of.p]]}

    def model_data(self, context):
        return {"a": context.controlled.a}

    @classmethod
    def largest_provable_rate(cls, context):  # noqa: ARG003
        return None

    @staticmethod
    def certificate_numbers(problem, found):  # noqa: ARG004
        return {}


@pytest.mark.parametrize("factors", [("k", "p"), ("k", "undeclared")])
def test_a_product_of_undeclared_fields_is_refused_when_the_class_is_defined(factors) -> None:
    message = "Undeclared: the product .* is no field; declare it in the class"
    with pytest.raises(TypeError, match=message):

        class Undeclared(Answered):
            products: ClassVar[dict[str, tuple[str, str]]] = {"x": factors}


def test_a_theorem_without_conditions_certifies_nothing() -> None:
    class Unconditional(Answered):
        @staticmethod
        def conditions(of):  # noqa: ARG004
            return {}

    with pytest.raises(TypeError, match="Unconditional has no conditions"):
        Unconditional.holds(p=np.eye(2))


@pytest.mark.parametrize(("inputs", "holds"), [(1, True), (2, False)])
def test_a_hypothesis_on_a_number_is_a_condition_too(inputs: int, holds: bool) -> None:
    class OfOneInput(Answered):
        pass

    numbers = {"p": np.eye(2), "b": np.ones((2, inputs))}
    assert OfOneInput.holds(**numbers) is holds
    in_floats = OfOneInput.float_conditions(**numbers)
    assert in_floats["one input"].shape == (1, 1)


@dataclass(frozen=True, kw_only=True)
class GivenGain(Answered):
    """A certificate whose numbers are given, as the theorem template says."""


@pytest.mark.parametrize(("limit", "is_stored"), [(1.0, True), (float("nan"), False)])
def test_a_certificate_of_given_numbers_is_stored(
    limit: float, is_stored: bool, tmp_path: Path
) -> None:
    """The template recommends one where no limit is known: JSON has no number for none."""
    one = np.eye(1)
    numbers = {"a": one, "b": one, "p": one, "k": one, "alpha": 1.0, "beta": 0.0, "rate": 0.5}
    made = GivenGain.from_numbers(numbers, status="given", method="given", rate_limit=limit)
    assert made.certified
    system = StateSpace(a=0.5 * one, b=one, c=one, d=0 * one)
    by_riccati = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    observer = by_riccati.observer(system, JacobianBall(alpha=1.0, beta=0.0))
    design = Design(state_feedback=made, observer=observer)
    file = tmp_path / "certificate.json"
    if is_stored:
        design.save(file)
        stored = json.loads(file.read_text())
        assert stored["state_feedback"]["theorem"] == GivenGain.name()
    else:
        with pytest.raises(ValueError, match="JSON compliant"):
            design.save(file)
    assert "rate_limit=1.0" in (FOLDER / "_template.py").read_text()


def test_only_the_paper_theorems_are_refused_beyond_the_papers_frontier() -> None:
    """The theorem of another package may reach further than any gain under Theorem 1."""

    class OfAnotherPackage(Answered):
        pass

    matrix = np.array([[1.0]])
    system = StateSpace(a=0.9 * matrix, b=matrix, c=matrix, d=0 * matrix)
    ball = JacobianBall(alpha=1.0, beta=0.2)
    frontier = controller_frontier(system, ball)
    request = {"rate": 0.99, "ball": ball, "frontier": frontier, "method": "own", "started": 0.0}
    assert frontier.rate_limit < 0.99
    of_the_paper = DesignAttempt(theorem=StateFeedbackOfBall, **request)
    refused = of_the_paper.infeasible_beyond_limit()
    assert refused is not None
    assert "only rates below" in refused.reason
    of_another_package = DesignAttempt(theorem=OfAnotherPackage, **request)
    assert of_another_package.infeasible_beyond_limit() is None


def test_a_theorem_written_with_the_names_of_version_0_1_answers_by_those_of_today() -> None:
    with pytest.warns(FutureWarning, match="given is now .*model_data"):

        class WithOldName(StateFeedback):
            @staticmethod
            def conditions(of):
                inequality = [[of.p]]
                return {"inequality": inequality}

            def given(self, known):
                return {"a": known}

            @classmethod
            def largest_provable_rate(cls, known):
                return known

            @staticmethod
            def certificate_numbers(problem, found):
                return {"a": problem, "p": found}

    with_old_name = WithOldName.model_data(None, 1.0)
    assert with_old_name == {"a": 1.0}


def test_a_name_that_is_no_theorem_is_refused() -> None:
    for name in ("certificate", "_template", "os", "../lmi", ""):
        with pytest.raises(ValueError, match="not a theorem"):
            find_theorem(name)


# One file with matrices of its own: `|M^{1/2} (A + J B K) v| <= r |M^{1/2} v|` for every `J` of the
# ball of one input, from its two ends: convex in J. Two metrics-to-be stand for two matrices that
# no other theorem has.
BOTH_ENDS = '''
"""A state feedback for one input, from both ends of its slopes.

Problem. As in `state_feedback`, for one input.

Hypotheses. Slopes of `S_u` in `[alpha - beta, alpha + beta]`.

Statement. `[r^2 P, (A + s B K) P; *, P] > 0` for both slopes s, with `Y_i = K P` and room
`E_1, E_2 > 0` proves rate `1 - r^2`: the inequality is affine in s.

When not to use it. With several inputs.

Reference. Boyd et al. 1994, section 5.1.

Example. Nothing to compute.

>>> print("none")
none
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import StateFeedback
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.minimum_energy import minimum_energy_solution


@dataclass(frozen=True, kw_only=True)
class BothEnds(StateFeedback):
    """`room` is taken off the diagonals; `lambda` shows how a reserved name is stored."""

    room: Float[np.ndarray, "n n"]
    lambda_: Float[np.ndarray, "q"]

    products = {"x": ("k", "p")}
    x: Float[np.ndarray, "m n"]

    @staticmethod
    def conditions(of: Any) -> dict[str, Any]:
        def at(slope: Any) -> Any:
            return [[(1 - of.rate) * of.p - of.room, of.a @ of.p + slope * (of.b @ of.x)], [of.p]]

        lower = at(of.alpha - of.beta)
        upper = at(of.alpha + of.beta)
        return {"lower": lower, "upper": upper, "room": [[of.room]]}

    def model_data(self, known: Any) -> dict[str, Any]:
        return {"a": known.controlled.a, "b": known.controlled.b}

    @classmethod
    def largest_provable_rate(cls, known: Any) -> None:
        return None

    @staticmethod
    def certificate_numbers(problem: Any, found: Any) -> dict[str, Any]:
        asked = {"alpha": problem.ball.alpha, "beta": problem.ball.beta, "rate": problem.rate}
        room = 1e-9 * np.eye(len(found.p))
        asked |= {"a": problem.a, "b": problem.b, "p": found.p, "k": found.k}
        return asked | {"room": room, "lambda_": np.ones(2)}


@dataclass(frozen=True, kw_only=True)
class BothEndsSynthesis(Synthesis):
    method: ClassVar[str] = "both_ends"
    feedback_theorem = BothEnds

    def solve(self, problem: Any) -> Any:
        return minimum_energy_solution(problem)
'''
BALLS = JacobianBalls(
    input=JacobianBall.from_slopes(0.5, 1.0), output=JacobianBall.from_slopes(0.8, 1.2)
)
PLANT = StateSpace(
    a=np.array([[0.95, 0.1], [-0.1, 0.9]]),
    b=np.array([[0.0], [1.0]]),
    c=np.array([[1.0, 0.5]]),
    d=np.zeros((1, 1)),
)


class Model:
    linear = PLANT


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """`certificate.json` of a design by a theorem that is one file in a scratch folder, loaded as a
    plug-in."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "both_ends.py").write_text(BOTH_ENDS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        module = importlib.import_module("both_ends")
    synthesis = module.BothEndsSynthesis(rate_controller=0.3, rate_observer=0.3)
    design = synthesis.design(Model(), BALLS)
    assert design.certified
    text = json.dumps(design.to_json())
    return json.loads(text)


def test_one_file_is_stored_read_back_and_verified(stored: dict) -> None:
    assert stored["state_feedback"]["theorem"] == "both_ends"
    expected = [1.0, 1.0]
    assert stored["state_feedback"]["lambda"] == expected
    assert failed_checks(stored, PLANT, BALLS) == []
    design = Design.from_json(stored)
    text = json.dumps(design.to_json())
    again = json.loads(text)
    assert again == stored
    both_ends = sys.modules["both_ends"]
    state_feedback = Design.from_json(stored).state_feedback
    expected = type(state_feedback)
    assert both_ends.BothEnds is expected


@pytest.mark.parametrize(
    ("name", "altered", "found"),
    [
        ("rate", 0.9, "in exact arithmetic the inequality fails (lower"),
        ("certified", False, "in exact arithmetic the inequality holds"),
        ("room", [[1e-9, 0.0], [0.0, -1e-9]], "fails (room)"),
        ("x", [[0.0, 0.0]], "state_feedback.x: differs"),
        ("a", [[0.5, 0.0], [0.0, 0.5]], "state_feedback.a: differs"),
        ("beta", 0.1, "alpha, beta"),
        ("lambda", [[1.0, 1.0]], "not a finite matrix"),
        ("theorem", "observer", "is the theorem of another part"),
        ("theorem", "os", "not a theorem"),
    ],
)
def test_tampering_with_it_is_found_though_no_code_elsewhere_knows_it(
    stored: dict, name: str, altered: object, found: str
) -> None:
    content = copy.deepcopy(stored)
    content["state_feedback"][name] = altered
    claims = failed_checks(content, PLANT, BALLS)
    assert any("digest" in claim or "certificate." in claim for claim in claims)
    content["state_feedback"]["certified_rate"] = content["state_feedback"]["rate"]
    content["state_feedback"]["digest"] = certificate_digest(content["state_feedback"])
    assert any(found in claim for claim in failed_checks(content, PLANT, BALLS))
