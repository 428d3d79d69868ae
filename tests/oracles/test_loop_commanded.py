"""The law that undoes the input map: the model with the identity in its place is its other
route."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loop_cases import motor_model, motor_record
from structured_cases import model as with_neurons

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.export.portable import convert_controller
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant, Loop
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.deployed import add_gain_certificates
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.input_inversion import mismatch_of_mapped_input, model_without_input_map
from ssm_study.synthesis.integrated_error import relative_response_areas

ASKED = RiccatiSynthesis(
    rate_controller=0.4, rate_observer=0.2, input_weight=0.1, output_noise=0.1, invert_input=True
)
MODELS = {"one layer": motor_model, "neurons": with_neurons}


@pytest.fixture(scope="module", params=[*MODELS, "integral"])
def made(request: pytest.FixtureRequest) -> tuple:
    stand = MODELS.get(request.param, with_neurons)()
    internal_model = ["step"] if request.param == "integral" else []
    asked = replace(ASKED, internal_model=internal_model)
    balls = certified_balls(stand)
    limits = (np.array([-4.0]), np.array([4.0]))
    design = add_gain_certificates(asked.design(stand, balls), stand, balls, limits)
    return (stand, balls, design)


def test_it_is_certified_beyond_what_the_slopes_allow_and_verified_from_the_file(
    made: tuple,
) -> None:
    stand, balls, design = made
    assert design.certified
    assert design.inverts_input_map
    plain = replace(ASKED, invert_input=False).design(stand, balls).state_feedback
    assert design.state_feedback.rate_limit > plain.rate_limit
    text = json.dumps(design.to_json())
    content = json.loads(text)
    controlled = controlled_system(stand, design.state_feedback)
    assert failed_checks(content, stand.system, balls, controlled) == []
    assert Design.from_json(content).inverts_input_map
    theorem = content["state_feedback"]["theorem"]
    content["state_feedback"]["theorem"] = theorem.replace("inverted_input", "state_feedback")
    content["state_feedback"]["digest"] = certificate_digest(content["state_feedback"])
    claims = failed_checks(content, stand.system, balls, controlled)
    assert any("the model's Jacobians fill the ball" in claim for claim in claims)


def test_a_map_that_may_turn_gives_no_claim(made: tuple) -> None:
    """A ball that holds zero: the same file beside such a model."""
    stand, balls, design = made
    alpha = balls.input.alpha
    beta = 1.1 * abs(alpha)
    wide = replace(balls, input=replace(balls.input, beta=beta))
    text = json.dumps(design.to_json())
    content = json.loads(text)
    system = controlled_system(stand, design.state_feedback)
    claims = failed_checks(content, stand.system, wide, system)
    assert any("alpha, beta" in claim for claim in claims)


def test_the_loop_is_that_of_the_model_without_the_map(made: tuple) -> None:
    """Sample by sample, from the same states: the same estimates and outputs."""
    stand, _, design = made
    law = ObserverFeedback.from_design(stand, design)
    other = ObserverFeedback(model=model_without_input_map(stand), gains=design.pair)
    horizon_s = 60 * stand.step_s
    asked = Loop(initial_conditions=3, horizon_s=horizon_s, measurement_noise_variance=0.0)
    runs = []
    for controller in (law, other):
        plant = IdentifiedPlant.from_model(controller.model)
        y0, noise = asked.draw_starts_and_noise(plant, 0)
        initial_range = (-1.0, 1.0)
        changed_plant = replace(plant, initial_range=initial_range)
        response = asked.simulate(changed_plant, controller, y0, noise)
        runs.append(response)
    actual = runs[0].y
    expected = runs[1].y
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    actual = runs[0].estimate
    expected = runs[1].estimate
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    runs_u = runs[0].u
    largest = np.abs(runs_u).max()
    assert largest > 0


def test_limits_keep_their_order_behind_a_falling_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """`u` in [-0.4, 0.1] is `v = -u` in [-0.1, 0.4]: what the responses are scored within."""
    scored = []

    def noted(*asked: Any) -> np.ndarray:
        scored.append(asked[-1])
        return relative_response_areas(*asked)

    monkeypatch.setattr("ssm_study.synthesis.expected_response.relative_response_areas", noted)
    gain = -np.eye(1)
    scaffold_in = LinearScaffold(gain=gain)
    falling = replace(motor_model(), scaffold_in=scaffold_in)
    b = -falling.linear.b
    linear = replace(falling.linear, b=b)
    falling = falling.with_linear_part(linear)
    asked = Auto(stretch_shares=(0.3,), observer_rates=(0.3,), invert_input=True)
    lower = np.array([-0.4])
    upper = np.array([0.1])
    asked = asked.with_input_limits(lower, upper)
    assert asked.design(falling, certified_balls(falling), (motor_record(),)).certified
    expected = [[[-0.1], [0.4]]]
    np.testing.assert_array_equal(scored, expected)


def test_what_the_records_show_is_relative_to_the_command() -> None:
    stand = motor_model()
    rng = np.random.default_rng(0)
    u = stand.scale.physical_input(rng.uniform(-1, 1, (10, 1)).repeat(40, axis=0))
    from ssm_study.signals import Trajectory

    response = stand.simulate(u)
    white_noise = rng.standard_normal((400, 1))
    y = response + 0.05 * white_noise
    record = Trajectory(u=u, y=y, step_s=stand.step_s)
    norm = np.linalg.norm(stand.scale.scaled_input(u))
    size = norm / np.linalg.norm(stand.map_input(u))
    mismatch = mismatch_of_mapped_input(stand, (record,), 0, ())
    gain = mismatch.gain
    mismatch = measure_mismatch(stand, (record,))
    expected = mismatch.gain * size
    assert gain == pytest.approx(expected, rel=1e-9)


def test_a_flat_map_and_an_export_are_refused_in_a_sentence(made: tuple) -> None:
    stand, _, design = made
    with pytest.raises(BadRequest, match="undoes the input map, which the exported code cannot do"):
        convert_controller(stand, design)
    breakpoints = np.array([[-0.2, 0.2]])
    slopes = np.array([[1.0, 0.0, 0.9]])
    flat_map = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    model = replace(stand, scaffold_in=flat_map)
    with pytest.raises(BadRequest, match="not strictly monotone in each channel"):
        model_without_input_map(model)
