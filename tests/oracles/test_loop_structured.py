"""The loop around a model with neurons: rest points, plans and the observer, each by another
route."""

from dataclasses import replace

import numpy as np
import pytest
from structured_cases import model

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.trajectory import feedback_trajectory, scaled_equilibrium
from ssm_study.models.structured import StructuredSSM
from ssm_study.plants.disturbance import NoDisturbance, StepDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains


@pytest.mark.parametrize("y", [0.4, 1.0, 1.9])
def test_the_rest_point_is_where_a_constant_input_takes_the_model(y: float) -> None:
    stand = model()
    output = np.array([y])
    x, u = scaled_equilibrium(stand, output)
    physical_input = stand.scale.physical_input(u)
    constant_input = np.tile(physical_input, (400, 1))
    response = stand.simulate(constant_input)
    assert response[-1, 0] == pytest.approx(y, abs=1e-8)
    drive = stand.scaffold_in(u[None])[0]
    next_x = stand.next_state(x, drive)
    difference = np.abs(next_x - x)
    largest_difference = difference.max()
    assert largest_difference < 1e-9


def test_an_output_that_saturation_forbids_is_refused() -> None:
    stand = model(("saturation",))
    b = np.zeros((3, 1))
    g = np.ones((1, 1))
    bias = np.zeros(1)
    fields = vars(stand) | {"b": b, "g": g, "bias": bias}
    structured_ssm = StructuredSSM(**fields)
    y = np.array([500.0])
    with pytest.raises(BadRequest, match="no constant input"):
        scaled_equilibrium(structured_ssm, y)


def test_a_plan_is_the_models_own_trajectory_and_ends_at_the_set_point() -> None:
    stand = model()
    k = 0.1 * np.ones((1, 3))
    levels = [[1.0], [1.8], [0.7]]
    reference = np.repeat(levels, 200, axis=0)
    plan = feedback_trajectory(stand, k, reference)
    planned_u = plan[:, 3:]
    planned_input = stand.scale.physical_input(planned_u)
    replayed = stand.simulate(planned_input)
    planned_drive = stand.scaffold_in(planned_u)
    planned = stand.output_at(plan[:, :3], planned_drive)
    np.testing.assert_allclose(replayed, planned, atol=1e-10)
    before_the_last_step = planned[399, 0]
    assert before_the_last_step == pytest.approx(1.8, abs=1e-6)
    resting_reference = np.ones((5, 1))
    resting_plan = feedback_trajectory(stand, k, resting_reference)
    assert not resting_plan.any()


LOAD = StepDisturbance(size=0.1, at_s=0.5)
STEP = StepReference(before=0.0, after=0.6, at_s=1.0)
LOADED_LOOP = LoopExperiment(
    initial_conditions=2,
    horizon_s=6.0,
    measurement_noise_variance=0.0,
    reference=STEP,
    disturbance=LOAD,
)


def design_integrator(stand: StructuredSSM) -> Design:
    """A certified design with an integrator."""
    rates = {"rate_controller": 0.05, "rate_observer": 0.3}
    synthesis = RiccatiSynthesis(input_weight=0.1, **rates)
    integrating = replace(synthesis, internal_model=["step"], integral_weight=0.1)
    balls = certified_balls(stand)
    return integrating.design(stand, balls)


def test_set_points_are_reached_without_error_under_a_constant_load() -> None:
    """Certified with an integrator, on the model itself with a load that the model does not know
    of."""
    stand = model()
    design = design_integrator(stand)
    assert design.certified
    plant = IdentifiedPlant.from_model(stand)
    runs = LOADED_LOOP.run_design(plant, stand, design, 0)
    controlled_y = runs.controlled.y
    last_outputs = controlled_y[:, -1, 0]
    assert last_outputs == pytest.approx(1.6, abs=1e-4)
    unloaded_loop = replace(LOADED_LOOP, disturbance=NoDisturbance())
    identified_plant = IdentifiedPlant.from_model(stand)
    without = unloaded_loop.run_design(identified_plant, stand, design, 0)
    last_inputs_without = without.controlled.u[:, -1]
    last_inputs = runs.controlled.u[:, -1]
    difference = np.abs(last_inputs_without - last_inputs)
    largest_difference = difference.max()
    assert largest_difference > 0.1, "the load asks for an input"


@pytest.mark.parametrize("injects", [True, False])
def test_the_observer_injects_inside_the_neurons(injects: bool) -> None:
    """One step by hand, from the letters of the theorem."""
    stand = model()
    rng = np.random.default_rng(3)
    l_ = rng.normal(size=(3, 1))
    l_z = None
    if injects:
        l_z = rng.normal(size=(2, 1))
    k = np.zeros((1, 3))
    gains = Gains(k=k, l=l_, l_z=l_z)
    law = ObserverFeedback(model=stand, gains=gains)
    x_hat = rng.normal(size=(1, 3))
    u = np.array([[0.9]])
    y = np.array([[1.3]])
    scaled_u = (u - 0.5) / 2.0
    scaled_y = (y - 1.0) / 3.0
    v = stand.scaffold_in(scaled_u)
    error = x_hat @ stand.c.T - scaled_y
    injected = error @ l_z.T if injects else 0.0
    driven = v @ stand.g.T + stand.bias
    z = x_hat @ stand.f.T + driven + injected
    of_tanh = np.tanh(z[:, 0])
    of_softplus = np.logaddexp(0, z[:, 1])
    w = np.stack([of_tanh, of_softplus], axis=1)
    tanh_at_rest = np.tanh(stand.bias[0])
    softplus_at_rest = np.logaddexp(0, stand.bias[1])
    w -= np.array([tanh_at_rest, softplus_at_rest])
    linear_part = x_hat @ stand.a.T + v @ stand.b.T
    without_correction = linear_part + w @ stand.e.T
    expected = without_correction + error @ l_.T
    no_memory = np.zeros(5)
    actual = law.next_memory(x_hat, u, y, no_memory)
    np.testing.assert_allclose(actual, expected, atol=1e-12)
