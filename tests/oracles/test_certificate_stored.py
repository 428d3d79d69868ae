"""Stored certificates: verified from the file, and refused when tampered with."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS as MOTOR_BALLS
from loop_cases import INPUT_BALL, OUTPUT_BALL, motor_model

from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.synthesis.deployed import add_gain_certificates
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Balls, JacobianBall, StateSpace


@pytest.fixture(scope="module")
def stored() -> tuple[dict, StateSpace]:
    model = motor_model()
    synthesis = RiccatiSynthesis(
        rate_controller=0.03, rate_observer=0.2, input_weight=0.1, output_noise=0.1
    )
    lower = np.array([-4.0])
    upper = np.array([6.0])
    limits = lower, upper
    design = synthesis.design(model, MOTOR_BALLS)
    whole = add_gain_certificates(design, model, MOTOR_BALLS, limits)
    expected = {"state_feedback_deployed", "observer_deployed", "tolerance"}
    assert set(whole.extra_certificates) == {
        *expected,
        "state_feedback_limited",
        "state_feedback_unlimited",
    }
    text = json.dumps(whole.to_json())
    content = json.loads(text)
    return content, model.linear


def test_what_is_stored_is_verified_from_the_file(stored: tuple[dict, StateSpace]) -> None:
    content, linear = stored
    assert failed_checks(content, linear, MOTOR_BALLS) == []
    certified_rate = content["state_feedback"]["certified_rate"]
    assert certified_rate == content["state_feedback_deployed"]["rate"]


TAMPERED = [
    (
        "tolerance",
        "kappa",
        lambda kappa: 1.01 * kappa,
        "tolerance.certified = True: in exact arithmetic the inequality fails",
    ),
    ("tolerance", "kappa", lambda kappa: -kappa, "fails (kappa)"),
    ("tolerance", "kappa", lambda kappa: 0.5 * kappa, None),  # less than is proved is proved
    ("tolerance", "lambda_p", lambda value: -value, "fails (inequality, lambda_p)"),
    ("tolerance", "p", lambda p: [[-value for value in row] for row in p], "fails"),
    (
        "tolerance",
        "k",
        lambda k: [[0.5 * value for value in row] for row in k],
        "tolerance.k: differs",
    ),
    ("tolerance", "alpha_out", lambda value: 0.5 * value, "tolerance.alpha_out: differs"),
    ("tolerance", "beta", lambda value: 0.5 * value, "tolerance.alpha, beta"),
    ("tolerance", "weight_input", lambda w: [[10 * w[0][0]]], "fails (inequality)"),
    ("state_feedback_deployed", "rate", lambda rate: rate * 1.01, "fails (inequality)"),
    ("state_feedback_deployed", "theorem", lambda _: "observer", "is of another part"),
    (
        "observer_deployed",
        "l",
        lambda gain: [[0.99 * v for v in row] for row in gain],
        "not the one that is deployed",
    ),
    ("state_feedback_limited", "rate", lambda rate: rate * 1.01, "fails (inequality)"),
    (
        "state_feedback_limited",
        "beta",
        lambda beta: 0.99 * beta,
        "state_feedback_limited.alpha, beta",
    ),
    ("state_feedback_limited", "theorem", lambda _: "state_feedback", "is of another part"),
    (
        "state_feedback_unlimited",
        "starts",
        lambda x: [[1.01 * v for v in row] for row in x],
        "fails (start 0)",
    ),
    ("state_feedback_unlimited", "level", lambda level: 1.01 * level, "limit 0 is not reached"),
    (
        "state_feedback_unlimited",
        "limits",
        lambda ends: [[-ends[0][0], ends[0][1]]],
        "fails (lower limit 0",
    ),
    (
        "state_feedback_unlimited",
        "k",
        lambda k: [[0.5 * v for v in row] for row in k],
        "not the one that is deployed",
    ),
    ("state_feedback", "certified_rate", lambda rate: rate * 1.01, "state_feedback.certified_rate"),
    ("tolerance", "rate", lambda _: 0.1, "is not part of a certificate"),
]


@pytest.mark.parametrize(("part", "name", "change", "found"), TAMPERED)
def test_tampering_is_found(
    stored: tuple[dict, StateSpace], part: str, name: str, change, found: str | None
) -> None:
    """The digest is written anew: the claim itself has to be found."""
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    original = content[part].get(name)
    content[part][name] = change(original)
    content[part]["digest"] = certificate_digest(content[part])
    broken = failed_checks(content, linear, MOTOR_BALLS)
    if found is None:
        assert broken == []
    else:
        assert any(found in claim for claim in broken), broken


def test_a_withdrawn_part_of_an_older_file_is_kept_and_not_checked(
    stored: tuple[dict, StateSpace],
) -> None:
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    for label in ("noise", "tolerance_by_frequency"):
        theorem = "noise_gain" if label == "noise" else "tolerance"
        content[label] = {"theorem": theorem, "s": "no number", "digest": ""}
    design = Design.from_json(content)
    expected = {"noise", "tolerance_by_frequency"}
    assert set(design.withdrawn) == expected
    assert not set(design.withdrawn) & set(design.certificates_by_name)
    assert design.to_json() == content
    assert failed_checks(content, linear, MOTOR_BALLS) == []
    content["tolerance"]["kappa"] *= 1.01  # what is still claimed is still checked beside it
    assert failed_checks(content, linear, MOTOR_BALLS) != []


@pytest.mark.parametrize("theorem", ["tolerance", "structured_tolerance", None])
def test_a_tolerance_of_an_older_theorem_is_withdrawn(
    stored: tuple[dict, StateSpace], theorem: str | None
) -> None:
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    named = {} if theorem is None else {"theorem": theorem}
    older = {"s": 0.1, "weight": [[1.0]]}
    content["tolerance"] = older | named
    design = Design.from_json(content)
    assert set(design.withdrawn) == {"tolerance"}
    assert failed_checks(content, linear, MOTOR_BALLS) == []
    content["observer"]["theorem"] = "tolerance"  # a side is never withdrawn
    assert failed_checks(content, linear, MOTOR_BALLS) != []


def test_a_smaller_weight_states_no_larger_gain(stored: tuple[dict, StateSpace]) -> None:
    """A tenth of the weight proves ten times the kappa, and the same gain."""
    design = Design.from_json(stored[0])
    part = design.extra_certificates["tolerance"]
    assert isinstance(part, MeasuredDiscs)
    smaller = replace(part, weight_input=0.1 * part.weight_input)
    assert smaller.tolerated_gain == pytest.approx(0.1 * part.tolerated_gain)
    elsewhere = replace(part, centre=-0.25)
    assert elsewhere.tolerated_gain is None


def test_a_part_under_a_name_that_is_none_is_refused(stored: tuple[dict, StateSpace]) -> None:
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    content["extra"] = content["tolerance"]
    claims = failed_checks(content, linear, MOTOR_BALLS)
    assert any("certificate.extra" in claim for claim in claims)


def test_a_file_claims_no_tolerance_of_a_nonlinear_output_map(
    stored: tuple[dict, StateSpace],
) -> None:
    content, motor = stored
    output = JacobianBall(alpha=OUTPUT_BALL.alpha, beta=0.01)
    wider = Balls(input=INPUT_BALL, output=output)
    claims = failed_checks(content, motor, wider)
    assert any("tolerance.beta_out" in claim for claim in claims)
