"""Stored certificates: verified from the file, and refused when tampered with."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS as MOTOR_BALLS
from loop_cases import INPUT_BALL, OUTPUT_BALL, motor_model

from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.deployed import add_gain_certificates
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace


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
    names = set(whole.extra_certificates)
    all_expected = {*expected, "state_feedback_limited", "state_feedback_unlimited"}
    assert names == all_expected
    document = whole.to_json()
    text = json.dumps(document)
    content = json.loads(text)
    return content, model.linear


def test_what_is_stored_is_verified_from_the_file(stored: tuple[dict, StateSpace]) -> None:
    content, linear = stored
    broken = failed_checks(content, linear, MOTOR_BALLS)
    assert broken == []
    certified_rate = content["state_feedback"]["certified_rate"]
    assert certified_rate == content["state_feedback_deployed"]["rate"]


def scale_by(factor: float) -> Callable[[float], float]:
    return lambda number: factor * number


def scale_entries_by(factor: float) -> Callable[[list[list[float]]], list[list[float]]]:
    return lambda rows: [[factor * value for value in row] for row in rows]


def replace_by(value: object) -> Callable[[object], object]:
    return lambda _: value


NOT_DEPLOYED = "not the one that is deployed"
FAILS_EXACTLY = "certified = True: in exact arithmetic the inequality fails"
# One fault of each kind: what each number means is the matter of test_theorem_conditions.
TAMPERED = [
    ("tolerance", "kappa", scale_by(1.01), f"tolerance.{FAILS_EXACTLY}"),
    ("tolerance", "kappa", scale_by(0.5), None),  # less than is proved is proved
    ("tolerance", "beta", scale_by(0.5), "tolerance.alpha, beta"),
    ("tolerance", "rate", replace_by(0.1), "is not part of a certificate"),
    ("state_feedback_deployed", "rate", scale_by(1.01), FAILS_EXACTLY),
    ("state_feedback_deployed", "theorem", replace_by("observer"), "theorem of another part"),
    ("observer_deployed", "l", scale_entries_by(0.99), NOT_DEPLOYED),
    ("state_feedback_limited", "beta", scale_by(0.99), "state_feedback_limited.alpha, beta"),
    ("state_feedback_unlimited", "k", scale_entries_by(0.5), NOT_DEPLOYED),
    ("state_feedback", "certified_rate", scale_by(1.01), "state_feedback.certified_rate"),
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
        is_found = any(found in claim for claim in broken)
        assert is_found, broken


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
    withdrawn = set(design.withdrawn)
    claimed = set(design.certificates_by_name)
    assert not withdrawn & claimed
    assert design.to_json() == content
    broken = failed_checks(content, linear, MOTOR_BALLS)
    assert broken == []
    content["tolerance"]["kappa"] *= 1.01  # what is still claimed is still checked beside it
    broken = failed_checks(content, linear, MOTOR_BALLS)
    assert broken != []


@pytest.mark.parametrize("theorem", ["inverted_input", "structured_inverted_input"])
def test_a_design_by_a_withdrawn_theorem_is_refused_in_a_sentence(
    stored: tuple[dict, StateSpace], theorem: str
) -> None:
    content = copy.deepcopy(stored[0])
    content["state_feedback"]["theorem"] = theorem
    with pytest.raises(BadRequest, match=r"was withdrawn in 0\.2; run again without synthesis"):
        Design.from_json(content)
    broken = failed_checks(content, stored[1], MOTOR_BALLS)
    assert len(broken) == 1


THEOREMS = ["tolerance", "structured_tolerance", None]


@pytest.mark.parametrize("theorem", THEOREMS)
def test_a_tolerance_of_an_older_theorem_is_withdrawn(
    stored: tuple[dict, StateSpace], theorem: str | None
) -> None:
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    named = {} if theorem is None else {"theorem": theorem}
    one_by_one = [[1.0]]
    older = {"s": 0.1, "weight": one_by_one}
    content["tolerance"] = older | named
    design = Design.from_json(content)
    withdrawn = set(design.withdrawn)
    assert withdrawn == {"tolerance"}
    broken = failed_checks(content, linear, MOTOR_BALLS)
    assert broken == []
    content["observer"]["theorem"] = "tolerance"  # a side is never withdrawn
    broken = failed_checks(content, linear, MOTOR_BALLS)
    assert broken != []


def test_a_smaller_weight_states_no_larger_gain(stored: tuple[dict, StateSpace]) -> None:
    """A tenth of the weight proves ten times the kappa, and the same gain."""
    design = Design.from_json(stored[0])
    part = design.extra_certificates["tolerance"]
    assert isinstance(part, MeasuredDiscs)
    weight_input = 0.1 * part.weight_input
    smaller = replace(part, weight_input=weight_input)
    tenth = 0.1 * part.tolerated_gain
    expected = pytest.approx(tenth)
    assert smaller.tolerated_gain == expected
    elsewhere = replace(part, centre=-0.25)
    assert elsewhere.tolerated_gain is None


def test_a_part_under_a_name_that_is_none_is_refused(stored: tuple[dict, StateSpace]) -> None:
    content = copy.deepcopy(stored[0])
    linear = stored[1]
    content["extra"] = content["tolerance"]
    claims = failed_checks(content, linear, MOTOR_BALLS)
    is_found = any("certificate.extra" in claim for claim in claims)
    assert is_found


def test_a_file_claims_no_tolerance_of_a_nonlinear_output_map(
    stored: tuple[dict, StateSpace],
) -> None:
    content, motor = stored
    output = JacobianBall(alpha=OUTPUT_BALL.alpha, beta=0.01)
    wider = JacobianBalls(input=INPUT_BALL, output=output)
    claims = failed_checks(content, motor, wider)
    is_found = any("tolerance.beta_out" in claim for claim in claims)
    assert is_found
