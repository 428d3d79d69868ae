"""A stored certificate of a model with neurons: altered numbers are named, and r lowered to 0.8 of
it is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from structured_cases import model

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.synthesis.deployed import certificate_at_largest_rate
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis


@pytest.fixture(scope="module")
def stored() -> dict:
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.5)
    balls = certified_balls(model())
    design = riccati_synthesis.design(model(), balls)
    assert design.certified
    document = design.to_json()
    text = json.dumps(document)
    return json.loads(text)


def altered(stored: dict, side: str, name: str, value: object) -> list[str]:
    """The claims that break, the digest and the stated rate made to fit as a careful forger
    would."""
    text = json.dumps(stored)
    content = json.loads(text)
    content[side][name] = value
    content[side]["certified_rate"] = content[side]["rate"]
    content[side]["digest"] = certificate_digest(content[side])
    system = model().system
    balls = certified_balls(model())
    return failed_checks(content, system, balls)


def test_what_was_written_holds(stored: dict) -> None:
    system = model().system
    balls = certified_balls(model())
    broken = failed_checks(stored, system, balls)
    assert broken == []
    of_feedback = set(stored["state_feedback"])
    neuron_matrices = {"e", "f", "g", "lambda"}
    assert neuron_matrices <= of_feedback
    of_observer = set(stored["observer"])
    neuron_matrices_of_observer = {"e", "f", "h", "l_z", "lambda"}
    assert neuron_matrices_of_observer <= of_observer


FAILS = "the inequality fails"
ALTERED_FEEDBACK = [
    ("e", 0.5, "state_feedback.e: differs"),
    ("f", 0.5, "state_feedback.f: differs"),
    ("g", 0.5, "state_feedback.g: differs"),
    ("lambda", -1.0, FAILS),
    ("k", 100.0, FAILS),
]
ALTERED_OBSERVER = [
    ("h", np.nan, "observer.h"),
    ("e", 0.5, "observer.e: differs"),
    ("eta", -1.0, FAILS),
    ("l_z", 100.0, FAILS),
    ("lambda", 1e-3, FAILS),
]
ALTERED = [("state_feedback", *row) for row in ALTERED_FEEDBACK]
ALTERED += [("observer", *row) for row in ALTERED_OBSERVER]


@pytest.mark.parametrize(("side", "name", "factor", "found"), ALTERED)
def test_an_altered_number_is_named(
    stored: dict, side: str, name: str, factor: float, found: str
) -> None:
    original = stored[side][name]
    number = np.array(original)
    value = (number * factor).tolist() if np.isfinite(factor) else [[1.0, 1.0]]
    claims = altered(stored, side, name, value)
    is_named = any(found in claim for claim in claims)
    assert is_named


SIDES = ["state_feedback", "observer"]


@pytest.mark.parametrize("side", SIDES)
def test_a_rate_that_the_matrices_do_not_prove_is_refused(stored: dict, side: str) -> None:
    slower = 0.64 * (1 - 0.97)
    faster = 1 - slower
    claims = altered(stored, side, "rate", faster)
    is_refused = any("the inequality fails" in claim for claim in claims)
    assert is_refused


@pytest.mark.parametrize("side", SIDES)
def test_a_theorem_without_neurons_proves_nothing_of_a_model_with_them_and_the_reverse(
    stored: dict, side: str
) -> None:
    """Every matrix that the file shares with the model is the model's, and each inequality holds:
    of another loop."""
    stand = model()
    no_columns = {name: getattr(stand, name)[:, :0] for name in "eh"}
    no_rows = {name: getattr(stand, name)[:0] for name in "fg"}
    none = no_columns | no_rows
    bias = stand.bias[:0]
    alone = replace(stand, neurons=(), bias=bias, **none)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    plain = riccati_synthesis.design(alone, certified_balls(alone))
    document = plain.to_json()
    text = json.dumps(document)
    other = json.loads(text)
    plain_part = other[side]
    stored_part = stored[side]
    limits = {"plain": plain_part["rate_limit"], "stored": stored_part["rate_limit"]}
    cases = ((plain_part, "stored", stored), (stored_part, "plain", other))
    for part, limit, beside in cases:
        other_limit = {"rate_limit": limits[limit]}
        forged = part | other_limit
        digest = certificate_digest(forged)
        own_digest = {"digest": digest}
        signed = forged | own_digest
        content = beside | {side: signed}
        carrier = stand if beside is stored else alone
        system = carrier.system
        claims = failed_checks(content, system, certified_balls(stand))
        assert f"{side}: the matrices do not fit the model" in claims


def test_another_injection_than_the_deployed_one_proves_nothing_of_it(stored: dict) -> None:
    """`L` with less injected into the neurons is another observer, whatever it is certified for."""
    design = Design.from_json(stored)
    observer = design.observer
    l_z = 0.9 * observer.l_z
    changed_observer = replace(observer, l_z=l_z, rate=1e-3)
    other = certificate_at_largest_rate(changed_observer)
    assert other is not None
    assert other.certified
    extra_certificates = {"observer_deployed": other}
    changed_design = replace(design, extra_certificates=extra_certificates)
    document = changed_design.to_json()
    text = json.dumps(document)
    forged = json.loads(text)
    system = model().system
    balls = certified_balls(model())
    claims = failed_checks(forged, system, balls)
    assert "observer_deployed: the gain is not the one that is deployed" in claims
