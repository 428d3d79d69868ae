"""Integral action: the same theorem and frontier on the augmented model, and no steady error on the
true motor."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS, INPUT_BALL, motor, motor_model, motor_record, random_model
from synthesis_ratio import ratio_limit

from ssm_study.bounds.frequency import gains
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.certificates.theorems.integral_action import controlled_system, with_modes
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.loop.certified_bound import relative_bound_excess
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns, certificate_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import Loop
from ssm_study.loop.trajectory import scaled_equilibrium
from ssm_study.plants.disturbance import RampDisturbance, StepDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.robustness.prediction import predict
from ssm_study.robustness.sensitivity import peaks_on_grid, sensitivity
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains

LOADED = Loop(
    horizon_s=4.0,
    measurement_noise_variance=0.0,
    reference=StepReference(before=0.0, after=8.0, at_s=0.0),
    disturbance=StepDisturbance(size=0.01, at_s=1.5),
)


def inner(rate: float = 0.02) -> RiccatiSynthesis:
    return RiccatiSynthesis(
        rate_controller=rate, rate_observer=0.2, input_weight=0.1, output_noise=0.1
    )


def integral(rate: float = 0.02) -> RiccatiSynthesis:
    return replace(inner(rate), internal_model=["step"])


@pytest.fixture(scope="module")
def design() -> Design:
    return replace(integral(), integral_weight=1e-3).design(motor_model(), BALLS)


def test_the_augmented_pair_is_the_equations_written_out():
    model = random_model(1, inputs=2, outputs=2)
    system = with_modes(model)
    rng = np.random.default_rng(0)
    x = rng.standard_normal(4)
    z = rng.standard_normal(2)
    v = rng.standard_normal(2)
    after = system.a @ np.concatenate([x, z]) + system.b @ v
    np.testing.assert_allclose(after[:4], model.linear.a @ x + model.linear.b @ v)
    np.testing.assert_allclose(after[4:], z + model.read_scaled(x, v))


def test_the_certificate_is_the_theorem_on_the_augmented_pair(design):
    part = design.state_feedback
    system = controlled_system(motor_model(), design.state_feedback)
    assert system.order == motor_model().order + 1
    np.testing.assert_array_equal(part.a, system.a)
    ball = {"alpha": INPUT_BALL.alpha, "beta": INPUT_BALL.beta}
    numbers = {name: getattr(part, name) for name in ("rate", "p", "y", "k", "sigma")}
    assert part.certified
    assert StateFeedbackOfBall.holds(a=system.a, b=system.b, **ball, **numbers)


def test_an_integrator_costs_rate_as_the_frontier_says():
    """The integrator is one more mode to move: the product over the modes faster than r gains a
    factor r / 1."""
    model = motor_model()
    r = 0.97
    alone = ratio_limit(model.linear.a, model.linear.b, r)
    with_it = ratio_limit(*_pair(model), r)
    assert with_it == pytest.approx(alone * r / 1.0, rel=1e-6)
    limit = integral().design(model, BALLS).state_feedback.rate_limit
    beyond = integral(limit * 1.001).design(model, BALLS).state_feedback
    within = integral(limit * 0.98).design(model, BALLS).state_feedback
    assert isinstance(beyond, Infeasible)
    assert beyond.proved
    assert within.certified


def _pair(model):
    system = with_modes(model)
    return system.a, system.b


def test_no_steady_error_under_a_constant_load_on_the_true_motor(design):
    columns = behaviour_columns(LOADED.run(motor(), motor_model(), design, seed=0))
    assert columns["stable_count"] == 10
    assert columns["final_error_worst"] < 1e-3


def test_without_integral_action_the_load_leaves_an_error():
    plain = inner().design(motor_model(), BALLS)
    columns = behaviour_columns(LOADED.run(motor(), motor_model(), plain, seed=0))
    assert columns["final_error_worst"] > 0.2


def test_the_certified_bound_holds_with_integrators(design):
    result = LOADED.run(motor(), motor_model(), design, seed=1)
    columns = certificate_columns(result, design)
    assert columns["certified_bound_violations"] == 0
    assert columns["estimate_decay_rate"] >= design.observer.rate * (1 - 1e-9)
    assert (
        relative_bound_excess(
            result.on_model.estimate, result.on_model.states[:, 0], *design.parts()
        )
        == 0.0
    )
    assert (
        columns["certified_bound_excess_plant"] is None
    )  # the plant follows a reference, the model none
    assert result.on_model.estimate.shape[2] == motor_model().order + 1


def test_limits_do_not_wind_the_integrator_up(design):
    """Away from the limits again, the loop is where the one without limits is: nothing was stored
    meanwhile."""
    rising = RampDisturbance(slope_per_s=2.0, from_s=1.0, until_s=4.0)
    free = Loop(
        initial_conditions=3, horizon_s=6.0, measurement_noise_variance=0.0, reference=rising
    )
    limited = replace(free, input_lower=-0.8, input_upper=1.6)
    run, other = (
        loop.run_design(motor(), motor_model(), design, seed=0).controlled
        for loop in (limited, free)
    )
    assert run.u.min() == -0.8
    assert other.u.min() < -1.0
    assert np.abs(run.y - other.y)[:, -50:].max() < 0.05


def test_a_step_that_needs_the_limit_for_a_while_is_followed(design):
    """Its value is held from within the limits, its plan is not: the input waits at the limit, and
    nothing winds up."""
    step = StepReference(before=0.0, after=8.0, at_s=1.0)
    free = Loop(initial_conditions=3, horizon_s=5.0, measurement_noise_variance=0.0, reference=step)
    held = (
        float(scaled_equilibrium(motor_model(), np.array([8.0]))[1][0])
        * motor_model().scale.input_scale[0]
    )
    limited = replace(free, input_lower=-1.2 * held, input_upper=1.2 * held)
    run, other = (
        loop.run_design(motor(), motor_model(), design, seed=0).controlled
        for loop in (limited, free)
    )
    assert other.u.max() > 1.3 * held
    assert (run.u[:, 100:] == 1.2 * held).sum() > 3
    assert run.u.max() == 1.2 * held
    assert np.abs(run.y - run.reference)[:, -50:].max() < 1e-3
    assert run.y.max() < 1.1 * 8.0
    with pytest.raises(BadRequest, match=r"is held by inputs from .* widen the limits by"):
        replace(limited, input_upper=0.9 * held).run(motor(), motor_model(), design, seed=0)


def test_the_margin_with_integrators_by_two_routes(design):
    model = motor_model()
    k = design.state_feedback.k
    gain = design.observer.l
    angles = np.geomspace(1e-3, np.pi, 200)
    by_space = max(
        gains(sensitivity(model.linear, Gains(k=k, l=gain), i, 1.0), angles).max()
        for i in (INPUT_BALL.lower, INPUT_BALL.alpha, INPUT_BALL.upper)
    )
    by_factors = peaks_on_grid(model.linear, k[None], gain[None], BALLS, angles)[0, 0]
    assert by_factors == pytest.approx(by_space, rel=1e-9)


def test_auto_chooses_with_integral_action():
    auto = Auto(
        stretch_shares=(0.3, 0.8),
        observer_rates=(0.05, 0.3),
        input_weights=(0.01, 0.1, 1.0, 10.0),
        output_noises=(0.01, 0.1, 1.0),
        integral_weights=(1e-4, 1e-3),
    )
    chosen = auto.design(motor_model(), BALLS, (motor_record(),))
    assert chosen.certified
    assert chosen.state_feedback.k.shape == (1, 3)
    shown = measure_mismatch(motor_model(), (motor_record(),))
    assert predict(motor_model(), chosen.pair, BALLS, shown).predicts_stability()
    columns = behaviour_columns(LOADED.run(motor(), motor_model(), chosen, seed=0))
    assert columns["final_error_worst"] < 1e-2


def test_more_outputs_than_inputs_are_refused():
    with pytest.raises(BadRequest, match="an input is needed for every controlled output"):
        with_modes(random_model(0, inputs=1, outputs=2))


def test_a_gain_of_the_wrong_width_is_refused():
    with pytest.raises(BadRequest, match="k = "):
        ObserverFeedback(model=motor_model(), gains=Gains(k=np.zeros((1, 4)), l=np.zeros((2, 1))))


@pytest.mark.parametrize("weight", [0.0, -1.0, np.inf, np.nan])
def test_a_weight_that_is_no_weight_is_refused(weight):
    with pytest.raises(BadRequest, match="integral_weight"):
        replace(inner(), integral_weight=weight)


def test_the_weight_is_the_cost_of_the_integrators_beside_the_output():
    """`|C z|^2 = |G C x|^2 + weight |z|^2`, and a larger one removes an error sooner."""
    model = random_model(1, inputs=2, outputs=2)
    rng = np.random.default_rng(0)
    x = rng.standard_normal(4)
    z = rng.standard_normal(2)
    cost = (with_modes(model, weight=0.09).c @ np.concatenate([x, z])) ** 2
    assert cost.sum() == pytest.approx(
        (model.read_scaled(x, np.zeros(2)) ** 2).sum() + 0.09 * (z**2).sum()
    )
    weights = (1e-5, inner().integral_weight, 1e-1)
    gains_on_z = [
        np.abs(
            replace(integral(), integral_weight=weight)
            .design(motor_model(), BALLS)
            .state_feedback.k[0, -1]
        )
        for weight in weights
    ]
    assert gains_on_z == sorted(gains_on_z)
    assert weights == tuple(sorted(weights))
