"""One law over all theorems: a proof that holds, by hand where possible, and for each of its
conditions a forged number that it refuses, alone or with others.

A new theorem has two functions here: its proof, under its name, and its forged numbers, each with a
factor and the conditions that fail with it, separated by commas.
"""

from collections.abc import Callable, Iterator
from copy import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from structured_cases import drawn
from test_measured_discs import BENT, WEIGHTS, context, one_layer

from ssm_study.certificates import theorems
from ssm_study.certificates.theorem import Theorem, VerificationContext, find_theorem
from ssm_study.certificates.theorems import bilinear_contraction, bilinear_everywhere, bilinear_loop
from ssm_study.certificates.theorems.limited_input import certify_under_limits
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.certificates.theorems.unlimited_start import certify_unlimited_start
from ssm_study.exact import is_positive_definite
from ssm_study.synthesis.measured_discs_search import certify_largest_radius
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace, StructuredSystem

ONE = np.ones((1, 1))
ZERO = 0 * ONE
LIMITS = np.array([[-1.0, 1.0]])
IDENTITY = JacobianBall(alpha=1.0, beta=0.0)
BALLS = JacobianBalls(input=IDENTITY, output=IDENTITY)
PLAIN = StateSpace(a=ONE, b=ONE, c=ONE, d=ZERO)
HALF = StateSpace(a=0.5 * ONE, b=ONE, c=ONE, d=ZERO)
WITH_NEURON = StructuredSystem(
    a=0.5 * ONE, b=ONE, c=ONE, d=ZERO, e=0.4 * ONE, f=ONE, g=ZERO, h=ZERO
)
UNFIT = ": the matrices do not fit the model"
Proof = tuple[Theorem, VerificationContext]
Forgeries = Iterator[tuple[str, Any, str]]


def stand(system: Any) -> VerificationContext:
    return VerificationContext(system=system, controlled=system, balls=BALLS, gains={})


def proved(theorem: type[Theorem], **numbers: Any) -> Theorem:
    return theorem.from_numbers(numbers, rate_limit=1.0, method="", status="")


def halving_feedback() -> Theorem:
    """The certificate of `x+ = x + u`, `u = -0.5 x`."""
    numbers = {"sigma": 0.1, "alpha": 1.0, "beta": 0.0, "rate": 0.5}
    return proved(StateFeedbackOfBall, a=ONE, b=ONE, p=ONE, y=ONE, k=-0.5 * ONE, **numbers)


def state_feedback() -> Proof:
    return halving_feedback(), stand(PLAIN)


def observer() -> Proof:
    """`x+ = x`, `y = S_y(x)` with slopes in [0.8, 1.2], `L = -0.7`: 0.44 of an error is left."""
    numbers = {"alpha": 1.0, "beta": 0.2, "eta": 0.07, "rate": 0.75}
    return proved(ObserverOfBall, a=ONE, c=ONE, q=ONE, u=ONE, l=-0.7 * ONE, **numbers), stand(PLAIN)


def structured_state_feedback() -> Proof:
    """`x+ = 0.5 x + 0.4 phi(x) + S_u(u)`, `K = -0.7`, as in the theorem's example."""
    numbers = {"alpha": 0.9, "beta": 0.1, "p": ONE, "y": ONE, "k": -0.7 * ONE, "sigma": 4.0}
    numbers |= {"lambda_": np.full(1, 0.2), "rate": 0.75}
    matrices = {"a": 0.5 * ONE, "b": ONE, "e": 0.4 * ONE, "f": ONE, "g": ZERO}
    return proved(StructuredStateFeedback, **matrices, **numbers), stand(WITH_NEURON)


def structured_observer() -> Proof:
    """`x+ = 0.5 x + 0.4 phi(x)`, `y = S_y(x)` with slopes in [0.9, 1.1], `L = -0.5`."""
    numbers = {"alpha": 1.0, "beta": 0.1, "q": ONE, "u": ONE, "l": -0.5 * ONE, "l_z": -ONE}
    numbers |= {"eta": 0.03, "lambda_": np.full(1, 0.5), "rate": 0.75}
    matrices = {"a": 0.5 * ONE, "c": ONE, "e": 0.4 * ONE, "f": ONE, "h": ZERO}
    return proved(StructuredObserver, **matrices, **numbers), stand(WITH_NEURON)


def limited_input() -> Proof:
    """`x+ = 0.5 x + sat(-0.4 x)`: between 0.5 and 0.1 of a distance is left."""
    numbers = {"sigma": 0.5, "alpha": 1.0, "beta": 0.0, "rate": 0.1}
    gain = -0.4 * ONE
    matrices = {"a": 0.5 * ONE, "b": ONE, "k": gain, "p": ONE, "y": ONE}
    return certify_under_limits(proved(StateFeedbackOfBall, **matrices, **numbers)), stand(HALF)


def unlimited_start() -> Proof:
    """With limits of one no limit acts from within two."""
    return certify_unlimited_start([halving_feedback()], ONE, LIMITS), stand(PLAIN)


def measured_discs() -> Proof:
    known = context(one_layer(0), BENT)
    return certify_largest_radius(known, WEIGHTS, -0.1), known


def measured_discs_structured() -> Proof:
    known = context(drawn(0))
    return certify_largest_radius(known, WEIGHTS, -0.1), known


def bilinear(theorem: type[Theorem], numbers: dict[str, Any]) -> Proof:
    """A proof of the worked example, and its model: one state and three input levels."""
    a = numbers["a_nodes"].reshape(3, 1, 1)
    b = numbers["b_nodes"]
    model = SimpleNamespace(nodes=numbers["nodes"], a=a, b=b, c=ONE, order=1)
    numbers |= {"alpha": 1.0, "beta": 0.0}
    return theorem.from_numbers(numbers, method="", status=""), stand(model)


def bilinear_loop_() -> Proof:
    return bilinear(bilinear_loop.BilinearLoop, bilinear_loop.example_numbers(0.45))


def bilinear_everywhere_() -> Proof:
    numbers = bilinear_everywhere.example_numbers(0.65)
    return bilinear(bilinear_everywhere.BilinearEverywhere, numbers)


def bilinear_contraction_() -> Proof:
    numbers = bilinear_contraction.example_numbers(0.6)
    return bilinear(bilinear_contraction.BilinearContraction, numbers)


AT_LIMITS = "highest input by state, lowest input by state"
AT_LIMITS_OF_ERROR = "highest input by error, lowest input by error"
OF_CONTROLLER = "factor above that of the controller"
OF_OBSERVER = "factor above that of the observer"
WITHOUT_CONTROL = "factor above that without control"
OF_JACOBIAN = "factor above that of the Jacobian"
LIMITS_FREE = "lower limit 0 is not reached, upper limit 0 is not reached"


def forge_rate() -> Forgeries:
    yield "rate", -1, "rate above 0"
    yield "rate", 3, "rate below 1, inequality"


def forge_state_feedback() -> Forgeries:
    yield from forge_rate()
    yield "a", 1.5, "inequality"
    yield "sigma", 9, "inequality"


def forge_observer() -> Forgeries:
    yield from forge_rate()
    yield "a", 1.5, "inequality"
    yield "eta", -1, "inequality"
    yield "l", 2, "inequality"


def forge_structured_state_feedback() -> Forgeries:
    yield "rate", -1, "rate above 0"
    yield "rate", 2, "rate below 1, inequality"
    for factor in (-1, 0.3, 1.2):
        yield "lambda_", factor, "inequality"
    for name in ("a", "e", "f", "k", "p"):
        yield name, 1.2, "inequality"
    yield "sigma", -1, "inequality"
    yield "sigma", 0.8, "inequality"
    yield "beta", 5, "inequality"


def forge_structured_observer() -> Forgeries:
    yield "rate", -1, "rate above 0"
    yield "rate", 2, "rate below 1, inequality"
    for factor in (-1, 0.1, 20):
        yield "lambda_", factor, "inequality"
    for name in ("a", "f", "l", "l_z", "q", "beta"):
        yield name, 2, "inequality"
    for factor in (-1, 0.2, 10):
        yield "eta", factor, "inequality"
    yield "e", 3, "inequality"


def forge_limited_input() -> Forgeries:
    yield from forge_rate()
    yield "rate", 1.01, "inequality"
    yield "beta", 1.5, "inequality"


def forge_unlimited_start() -> Forgeries:
    yield from forge_rate()
    yield "level", 0.5, "start 0"
    yield "level", 1.5, LIMITS_FREE
    yield "starts", 1.5, "start 0"
    yield "k", 1.5, LIMITS_FREE
    yield "limits", -1, "lower limit 0, upper limit 0"
    lower_nearer = np.array([0.5, 1.0])
    yield "limits", lower_nearer, "lower limit 0 is not reached"
    upper_nearer = np.array([1.0, 0.5])
    yield "limits", upper_nearer, "upper limit 0 is not reached"


def forge_disc() -> Forgeries:
    yield "kappa", 1.5, "inequality"
    yield "kappa", -1, "kappa"
    yield "floor", -1, "floor"
    yield "floor", 0.01, "model inside the disc"
    yield "centre", 30, "model inside the disc, inequality"
    yield "lambda_p", -1, "lambda_p, inequality"
    yield "p", -1, "p, inequality"
    yield "k", 2, "inequality"
    yield "weight_input", 10, "inequality"


def forge_measured_discs() -> Forgeries:
    yield from forge_disc()
    yield "lambda_out", -1, "lambda_out, inequality"


def forge_measured_discs_structured() -> Forgeries:
    yield from forge_disc()
    yield "lambda_", -1, "lambda, inequality"


def forge_cascade() -> Forgeries:
    """Numbers that both bilinear loops have."""
    yield "factor_controller", -1, "factor_controller above 0"
    yield "factor_controller", 0.5, "state feedback"
    yield "factor_controller", 3, OF_CONTROLLER
    yield "factor_observer", -1, "factor_observer above 0"
    yield "factor_observer", 0.2, "observer"
    yield "factor_observer", 3, OF_OBSERVER
    yield "c", 0.5, "observer"
    yield "coupling", -1, "coupling above 0"
    yield "coupling", 0.5, "coupling"
    yield "coupling", 3, OF_OBSERVER
    yield "factor", 3, "factor below 1"


def forge_gain_state(at_limits: str) -> Forgeries:
    yield "gain_state", -1, "gain_state above 0"
    yield "gain_state", 0.5, "input by state"
    yield "gain_state", 1.5, at_limits


def forge_bilinear_loop() -> Forgeries:
    yield from forge_cascade()
    yield from forge_gain_state(AT_LIMITS)
    yield "factor", 0.5, f"{OF_CONTROLLER}, {OF_OBSERVER}"
    yield "weight", -1, f"weight above 0, {OF_OBSERVER}, {AT_LIMITS_OF_ERROR}"
    yield "gain_error", -1, "gain_error above 0"
    yield "gain_error", 0.5, "input by error"
    yield "gain_error", 1.5, AT_LIMITS_OF_ERROR
    yield "radius", -1, "radius above 0"
    yield "radius", 1.5, f"{AT_LIMITS}, {AT_LIMITS_OF_ERROR}"
    yield "p", -1, "metric of the state, input by state, state feedback"
    yield "m", -1, "metric of the error, input by error, observer, coupling"


def forge_bilinear_everywhere() -> Forgeries:
    yield from forge_cascade()
    yield "factor", 0.5, f"{OF_CONTROLLER}, {OF_OBSERVER}, {WITHOUT_CONTROL}"
    yield "weight", -1, f"weight above 0, {OF_OBSERVER}"
    yield "p", -1, "metric of the state, state feedback, without control"
    yield "m", -1, "metric of the error, observer, coupling"
    yield "factor_uncontrolled", -1, "factor_uncontrolled above 0"
    yield "factor_uncontrolled", 0.5, "without control"
    yield "factor_uncontrolled", 1.5, WITHOUT_CONTROL


def forge_bilinear_contraction() -> Forgeries:
    yield from forge_gain_state("highest input, lowest input")
    yield "factor", 0.5, OF_JACOBIAN
    yield "factor", 3, "factor below 1"
    yield "factor_controller", -1, "factor_controller above 0"
    yield "factor_controller", 0.5, "state feedback"
    yield "radius", -1, "radius above 0"
    yield "radius", 3, f"highest input, lowest input, {OF_JACOBIAN}"
    yield "variation", -1, "variation above 0"
    yield "variation", 0.5, "variation"
    yield "variation", 3, OF_JACOBIAN
    yield "p", -1, "metric, input by state, state feedback, variation"


FORGERIES = {
    state_feedback: forge_state_feedback,
    observer: forge_observer,
    structured_state_feedback: forge_structured_state_feedback,
    structured_observer: forge_structured_observer,
    limited_input: forge_limited_input,
    unlimited_start: forge_unlimited_start,
    measured_discs: forge_measured_discs,
    measured_discs_structured: forge_measured_discs_structured,
    bilinear_loop_: forge_bilinear_loop,
    bilinear_everywhere_: forge_bilinear_everywhere,
    bilinear_contraction_: forge_bilinear_contraction,
}
every_theorem = pytest.mark.parametrize(
    "prove", FORGERIES, ids=lambda prove: prove.__name__.rstrip("_")
)


def conditions(theorem: type[Theorem], numbers: dict[str, Any]) -> dict[str, bool]:
    """Whether each condition holds; of those at several nodes and segments, all."""
    held: dict[str, bool] = {}
    for label, matrix in theorem.exact_conditions(**numbers).items():
        name = label.partition(" at node")[0].partition(" on segment")[0]
        held[name] = held.get(name, True) and is_positive_definite(matrix)
    return held


def refused_by(part: Theorem, name: str, factor: Any) -> set[str]:
    """Names of the conditions that fail once a number is multiplied by a factor."""
    forged = part.variables | {name: factor * part.variables[name]}
    return {label for label, holds in conditions(type(part), forged).items() if not holds}


def test_every_theorem_has_its_forgeries() -> None:
    files = Path(theorems.__file__).parent.glob("[!_]*.py")
    without_class = {"deployed_rate", "integral_action"}  # ways to certificates of other theorems
    names = {path.stem for path in files} - without_class
    assert {prove.__name__.rstrip("_") for prove in FORGERIES} == names
    assert {find_theorem(name).name() for name in names} == names


@every_theorem
def test_each_condition_refuses_the_forged_numbers_that_it_is_about(
    prove: Callable[[], Proof],
) -> None:
    part, _ = prove()
    held = conditions(type(part), part.variables)
    assert all(held.values())
    violated = set[str]()
    for name, factor, expected in FORGERIES[prove]():
        refused = refused_by(part, name, factor)
        assert refused == set(expected.split(", ")), (name, factor)
        violated |= refused
    assert violated == set(held)


def forged(part: Theorem, name: str, value: Any) -> Theorem:
    """A certificate as a file may hold it, whose shapes only `failed_checks` looks at."""
    changed = copy(part)
    object.__setattr__(changed, name, value)
    return changed


@every_theorem
def test_a_file_is_compared_with_the_model_and_with_its_own_verdict(
    prove: Callable[[], Proof],
) -> None:
    part, known = prove()
    assert part.certified
    assert part.failed_checks(known) == []
    (claim,) = forged(part, "certified", False).failed_checks(known)
    assert "certified = False: in exact arithmetic the inequality holds" in claim
    of_model = part.model_data(known)
    stored = vars(part)
    assert stored.keys() & vars(known.system).keys() <= of_model.keys()
    changes = [(name, name) for name in of_model]
    for product, factors in type(part).products.items():
        changes += [(name, product) for name in (product, *factors)]
    for name, differing in changes:
        claims = forged(part, name, stored[name] + 1e-9).failed_checks(known)
        assert any(claim.startswith(f".{differing}: differs") for claim in claims), name
    other_kind = PLAIN if hasattr(part, "e") else WITH_NEURON
    assert part.failed_checks(stand(other_kind)) == [UNFIT]
    for name in part.variables:
        if np.ndim(stored[name]) == 2:
            assert UNFIT in forged(part, name, np.ones((7, 7))).failed_checks(known), name


def test_each_end_of_the_inputs_has_a_condition_of_its_own() -> None:
    part, _ = bilinear_loop_()
    refused = refused_by(part, "nodes", np.array([0.5, 1.0, 1.0]))
    assert {"lowest input by state", "lowest input by error"} <= refused
    assert not refused & {"highest input by state", "highest input by error"}


def test_every_node_and_segment_has_its_conditions() -> None:
    """Three nodes and the two segments between them."""
    part, _ = bilinear_loop_()
    text = " ".join(type(part).exact_conditions(**part.variables))
    counts = {"state feedback at node": 6, "observer at node": 3, "coupling on segment": 2}
    assert {label: text.count(label) for label in counts} == counts


def test_no_start_is_certified_without_room_or_corners() -> None:
    part = halving_feedback()
    assert certify_unlimited_start([part], ZERO, LIMITS) is None
    one_sided = np.array([[0.0, 1.0]])
    assert certify_unlimited_start([part], ONE, one_sided) is None
