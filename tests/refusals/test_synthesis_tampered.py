"""Tampering with a stored certificate that verification must find."""

import copy
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_synthesis_refuses import BALLS, OUTPUT_BALL, PLANT, RATES

from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls


class Model:
    linear = PLANT


@pytest.fixture(scope="module")
def stored() -> dict:
    synthesis = RiccatiSynthesis(**RATES)
    design = synthesis.design(Model(), BALLS)
    document = design.to_json()
    return json.loads(json.dumps(document))


def test_an_untouched_certificate_has_no_broken_claim(stored: dict) -> None:
    broken_claims = failed_checks(stored, PLANT, BALLS)
    assert broken_claims == []


MATRICES_OF_STATE_FEEDBACK = [("state_feedback", name) for name in "abpyxk"]
MATRICES_OF_OBSERVER = [("observer", name) for name in "acquvl"]
MATRICES = MATRICES_OF_STATE_FEEDBACK + MATRICES_OF_OBSERVER
SHARES = [1e-15, -1e-9, 1e-3, 2.0]


MATRIX = st.sampled_from(MATRICES)
SHARE = st.sampled_from(SHARES)


ENTRIES = st.integers(0, 99)


@given(MATRIX, ENTRIES, SHARE)
def test_any_tampering_with_any_matrix_is_found(
    stored: dict, where: tuple[str, str], entry: int, share: float
) -> None:
    side, name = where
    content = copy.deepcopy(stored)
    rows = content[side][name]
    columns = len(rows[0])
    entries = len(rows) * columns
    i, j = divmod(entry % entries, columns)
    original = rows[i][j]
    rows[i][j] = original * (1 + share) if original else share

    claims = failed_checks(content, PLANT, BALLS)

    is_found = any(claim.startswith(side) for claim in claims)
    assert is_found


def test_the_digest_covers_every_field(stored: dict) -> None:
    for side, part in stored.items():
        assert part["digest"] == certificate_digest(part)
        claimed = part.keys()
        for name in claimed - {"digest"}:
            altered = part | {name: "altered"}
            digest_of_altered = certificate_digest(altered)
            assert digest_of_altered != part["digest"], f"{side}.{name}"


NUMBERS = ["alpha", "beta", "rate", "sigma", "rate_limit"]


@pytest.mark.parametrize("name", NUMBERS)
def test_any_tampering_with_a_number_is_found(stored: dict, name: str) -> None:
    content = copy.deepcopy(stored)
    content["state_feedback"][name] *= 1 + 1e-6
    assert failed_checks(content, PLANT, BALLS)


def test_a_ball_smaller_than_the_models_is_found(stored: dict) -> None:
    wider_ball = JacobianBall.from_slopes(0.29, 1.0)
    wider = JacobianBalls(input=wider_ball, output=OUTPUT_BALL)
    claims = failed_checks(stored, PLANT, wider)
    is_found = any("alpha, beta" in claim for claim in claims)
    assert is_found


Q_WITH_A_TEXT = [[1.0, "x"], [0.0, 1.0]]
RAGGED_Q = [[1.0], [0.0, 1.0]]
MALFORMED = [
    (lambda c: c.pop("observer"), "observer"),
    (lambda c: c["observer"].pop("q"), "q"),
    (lambda c: c["observer"].update(q=Q_WITH_A_TEXT), "q"),
    (lambda c: c["observer"].update(q=RAGGED_Q), "q"),
    (lambda c: c["observer"].update(eta=float("nan")), "eta"),
    (lambda c: c["observer"]["l"].pop(), r"observer\.l \(shape\)"),
    (lambda c: c["observer"].update(extra=1.0), "extra"),
]


@pytest.mark.parametrize(("change", "field"), MALFORMED)
def test_a_malformed_certificate_is_one_sentence(stored: dict, change, field: str) -> None:
    content = copy.deepcopy(stored)
    change(content)
    with pytest.raises(BadRequest, match=field):
        Design.from_json(content)
    claims = failed_checks(content, PLANT, BALLS)
    assert len(claims) == 1
