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
    design = riccati_synthesis.design(model(), certified_balls(model()))
    assert design.certified
    text = json.dumps(design.to_json())
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
    assert failed_checks(stored, system, balls) == []
    of_feedback = set(stored["state_feedback"])
    assert {"e", "f", "g", "lambda"} <= of_feedback
    of_observer = set(stored["observer"])
    assert {"e", "f", "h", "l_z", "lambda"} <= of_observer


ALTERED = [
    ("state_feedback", "e", 0.5, "state_feedback.e: differs"),
    ("state_feedback", "f", 0.5, "state_feedback.f: differs"),
    ("state_feedback", "g", 0.5, "state_feedback.g: differs"),
    ("state_feedback", "lambda", -1.0, "the inequality fails"),
    ("state_feedback", "k", 100.0, "the inequality fails"),
    ("observer", "h", np.nan, "observer.h"),
    ("observer", "e", 0.5, "observer.e: differs"),
    ("observer", "eta", -1.0, "the inequality fails"),
    ("observer", "l_z", 100.0, "the inequality fails"),
    ("observer", "lambda", 1e-3, "the inequality fails"),
]


@pytest.mark.parametrize(("side", "name", "factor", "found"), ALTERED)
def test_an_altered_number_is_named(
    stored: dict, side: str, name: str, factor: float, found: str
) -> None:
    number = np.array(stored[side][name])
    value = (number * factor).tolist() if np.isfinite(factor) else [[1.0, 1.0]]
    claims = altered(stored, side, name, value)
    assert any(found in claim for claim in claims)


@pytest.mark.parametrize("side", ["state_feedback", "observer"])
def test_a_rate_that_the_matrices_do_not_prove_is_refused(stored: dict, side: str) -> None:
    faster = 1 - 0.64 * (1 - 0.97)
    claims = altered(stored, side, "rate", faster)
    assert any("the inequality fails" in claim for claim in claims)


@pytest.mark.parametrize("side", ["state_feedback", "observer"])
def test_a_theorem_without_neurons_proves_nothing_of_a_model_with_them_and_the_reverse(
    stored: dict, side: str
) -> None:
    """Every matrix that the file shares with the model is the model's, and each inequality holds:
    of another loop."""
    stand = model()
    none = {name: getattr(stand, name)[:, :0] for name in "eh"} | {
        name: getattr(stand, name)[:0] for name in "fg"
    }
    bias = stand.bias[:0]
    alone = replace(stand, neurons=(), bias=bias, **none)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    plain = riccati_synthesis.design(alone, certified_balls(alone))
    text = json.dumps(plain.to_json())
    other = json.loads(text)
    limits = {
        name: part["rate_limit"]
        for name, part in (("plain", other[side]), ("stored", stored[side]))
    }
    cases = ((other[side], "stored", stored), (stored[side], "plain", other))
    for part, limit, beside in cases:
        forged = part | {"rate_limit": limits[limit]}
        digest = certificate_digest(forged)
        content = beside | {side: forged | {"digest": digest}}
        system = (stand if beside is stored else alone).system
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
    text = json.dumps(changed_design.to_json())
    forged = json.loads(text)
    system = model().system
    balls = certified_balls(model())
    claims = failed_checks(forged, system, balls)
    assert "observer_deployed: the gain is not the one that is deployed" in claims
