"""A stored certificate of a model with neurons, and an injection that is not the deployed one."""

import json
from dataclasses import replace

import pytest
from structured_cases import model

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
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
