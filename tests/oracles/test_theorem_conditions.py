"""Conditions of every theorem: their names, and for each a forged number that it alone refuses, or
with others."""

import numpy as np
from test_measured_discs import BENT, WEIGHTS, context, one_layer

from ssm_study.certificates.theorems import (
    bilinear_contraction,
    bilinear_everywhere,
    bilinear_loop,
    state_feedback,
)
from ssm_study.certificates.theorems.unlimited_start import certify_unlimited_start
from ssm_study.exact import is_positive_definite
from ssm_study.synthesis.measured_discs_search import certify_largest_radius


class Forger:
    """Numbers of a proof that holds, to be forged one by one."""

    def __init__(self, theorem, numbers):
        self.theorem = theorem
        self.numbers = numbers
        conditions = self.conditions(numbers)
        assert all(conditions.values())
        self.names = set(conditions)
        self.violated = set[str]()

    def conditions(self, numbers) -> dict[str, bool]:
        """Whether each condition holds; of those at several nodes and segments, all."""
        held = {}
        matrices = self.theorem.exact_conditions(**numbers)
        for label, matrix in matrices.items():
            name = label.partition(" at node")[0]
            name = name.partition(" on segment")[0]
            before = held.get(name, True)
            held[name] = before and is_positive_definite(matrix)
        return held

    def refused_by(self, name, factor) -> set[str]:
        """Names of the conditions that fail once a number is multiplied by a factor."""
        forged = dict(self.numbers)
        forged[name] = factor * forged[name]
        conditions = self.conditions(forged)
        return {label for label, holds in conditions.items() if not holds}

    def __call__(self, name, factor, *expected) -> None:
        refused = self.refused_by(name, factor)
        assert refused == set(expected)
        self.violated |= refused


FEEDBACK = "state feedback"
OF_CONTROLLER = "factor above that of the controller"
OF_OBSERVER = "factor above that of the observer"
STATE_HIGH = "highest input by state"
STATE_LOW = "lowest input by state"
ERROR_HIGH = "highest input by error"
ERROR_LOW = "lowest input by error"


def forge_cascade(forge: Forger) -> None:
    """Forge the numbers that both bilinear loops have."""
    forge("factor_controller", -1, "factor_controller above 0")
    forge("factor_controller", 0.5, FEEDBACK)
    forge("factor_controller", 3, OF_CONTROLLER)
    forge("factor_observer", -1, "factor_observer above 0")
    forge("factor_observer", 3, OF_OBSERVER)
    forge("c", 0.5, "observer")
    forge("coupling", -1, "coupling above 0")
    forge("coupling", 0.5, "coupling")
    forge("coupling", 3, OF_OBSERVER)
    forge("factor", 3, "factor below 1")


def test_conditions_of_a_bilinear_loop():
    numbers = bilinear_loop.example_numbers(0.45)
    forge = Forger(bilinear_loop.BilinearLoop, numbers)
    forge_cascade(forge)
    forge("factor", 0.5, OF_CONTROLLER, OF_OBSERVER)
    forge("weight", -1, "weight above 0", OF_OBSERVER, ERROR_HIGH, ERROR_LOW)
    forge("gain_state", -1, "gain_state above 0")
    forge("gain_state", 0.5, "input by state")
    forge("gain_state", 1.5, STATE_HIGH, STATE_LOW)
    forge("gain_error", -1, "gain_error above 0")
    forge("gain_error", 0.5, "input by error")
    forge("gain_error", 1.5, ERROR_HIGH, ERROR_LOW)
    forge("radius", -1, "radius above 0")
    forge("radius", 1.5, STATE_HIGH, STATE_LOW, ERROR_HIGH, ERROR_LOW)
    forge("p", -1, "metric of the state", "input by state", FEEDBACK)
    forge("m", -1, "metric of the error", "input by error", "observer", "coupling")
    assert forge.violated == forge.names


def test_each_end_of_the_inputs_has_a_condition_of_its_own():
    numbers = bilinear_loop.example_numbers(0.45)
    forge = Forger(bilinear_loop.BilinearLoop, numbers)
    nearer = np.array([0.5, 1.0, 1.0])
    refused = forge.refused_by("nodes", nearer)
    assert {STATE_LOW, ERROR_LOW} <= refused
    assert not refused & {STATE_HIGH, ERROR_HIGH}


def test_every_node_and_segment_has_its_conditions():
    """Three nodes and the two segments between them."""
    numbers = bilinear_loop.example_numbers(0.45)
    labels = bilinear_loop.BilinearLoop.exact_conditions(**numbers)
    text = " ".join(labels)
    actual = text.count("state feedback at node")
    assert actual == 6
    assert text.count("observer at node") == 3
    assert text.count("coupling on segment") == 2


def test_conditions_of_a_bilinear_loop_from_everywhere():
    numbers = bilinear_everywhere.example_numbers(0.65)
    forge = Forger(bilinear_everywhere.BilinearEverywhere, numbers)
    forge_cascade(forge)
    without_control = "factor above that without control"
    forge("factor", 0.5, OF_CONTROLLER, OF_OBSERVER, without_control)
    forge("weight", -1, "weight above 0", OF_OBSERVER)
    forge("p", -1, "metric of the state", FEEDBACK, "without control")
    forge("m", -1, "metric of the error", "observer", "coupling")
    forge("factor_uncontrolled", -1, "factor_uncontrolled above 0")
    forge("factor_uncontrolled", 0.5, "without control")
    forge("factor_uncontrolled", 1.5, without_control)
    assert forge.violated == forge.names


def test_conditions_of_a_bilinear_contraction():
    numbers = bilinear_contraction.example_numbers(0.6)
    forge = Forger(bilinear_contraction.BilinearContraction, numbers)
    of_jacobian = "factor above that of the Jacobian"
    forge("factor", 0.5, of_jacobian)
    forge("factor", 3, "factor below 1")
    forge("factor_controller", -1, "factor_controller above 0")
    forge("factor_controller", 0.5, FEEDBACK)
    forge("gain_state", -1, "gain_state above 0")
    forge("gain_state", 0.5, "input by state")
    forge("gain_state", 1.5, "highest input", "lowest input")
    forge("radius", -1, "radius above 0")
    forge("radius", 3, "highest input", "lowest input", of_jacobian)
    forge("variation", -1, "variation above 0")
    forge("variation", 0.5, "variation")
    forge("variation", 3, of_jacobian)
    forge("p", -1, "metric", "input by state", FEEDBACK, "variation")
    assert forge.violated == forge.names


def test_conditions_of_measured_discs():
    known = context(one_layer(0), BENT)
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    forge = Forger(type(proof), proof.variables)
    forge("kappa", 1.5, "inequality")
    forge("kappa", -1, "kappa")
    forge("floor", -1, "floor")
    forge("floor", 0.01, "model inside the disc")
    forge("centre", 30, "model inside the disc", "inequality")
    forge("lambda_p", -1, "lambda_p", "inequality")
    forge("lambda_out", -1, "lambda_out", "inequality")
    forge("p", -1, "p", "inequality")
    assert forge.violated == forge.names


LOW = "lower limit 0"
HIGH = "upper limit 0"
LOW_FREE = f"{LOW} is not reached"
HIGH_FREE = f"{HIGH} is not reached"


ONE = np.ones((1, 1))
LIMITS = np.array([[-1.0, 1.0]])


def halving_feedback():
    """The certificate of `x+ = x + u`, `u = -0.5 x`."""
    numbers = {"a": ONE, "b": ONE, "p": ONE, "y": ONE}
    numbers["k"] = -0.5 * ONE
    numbers |= {"sigma": 0.1, "alpha": 1.0, "beta": 0.0, "rate": 0.5}
    theorem = state_feedback.StateFeedbackOfBall
    return theorem.from_numbers(numbers, rate_limit=1.0, method="", status="")


def test_conditions_of_a_state_feedback():
    part = halving_feedback()
    forge = Forger(type(part), part.variables)
    forge("rate", -1, "rate above 0")
    forge("rate", 3, "rate below 1", "inequality")
    forge("a", 1.5, "inequality")
    assert forge.violated == forge.names


def test_conditions_of_starts_that_reach_no_limit():
    """With limits of one no limit acts from within two."""
    part = halving_feedback()
    proof = certify_unlimited_start([part], ONE, LIMITS)
    forge = Forger(type(proof), proof.variables)
    forge("rate", -1, "rate above 0")
    forge("rate", 3, "rate below 1", "inequality")
    forge("level", 0.5, "start 0")
    forge("level", 1.5, LOW_FREE, HIGH_FREE)
    forge("starts", 1.5, "start 0")
    forge("k", 1.5, LOW_FREE, HIGH_FREE)
    forge("limits", -1, LOW, HIGH)
    lower_nearer = np.array([0.5, 1.0])
    forge("limits", lower_nearer, LOW_FREE)
    upper_nearer = np.array([1.0, 0.5])
    forge("limits", upper_nearer, HIGH_FREE)
    assert forge.violated == forge.names


def test_no_start_is_certified_without_room_or_corners():
    part = halving_feedback()
    no_corner = 0 * ONE
    assert certify_unlimited_start([part], no_corner, LIMITS) is None
    one_sided = np.array([[0.0, 1.0]])
    assert certify_unlimited_start([part], ONE, one_sided) is None
