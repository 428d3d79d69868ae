"""Integral action: the same theorem and frontier on the augmented model, and no steady error on the
true motor."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS, INPUT_BALL, motor, motor_model, motor_record, random_model
from recorded import assert_as_recorded
from synthesis_ratio import ratio_limit

from ssm_study.bounds.frequency import largest_gains
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.certificates.theorems.integral_action import append_internal_model, controlled_system
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.loop.certified_bound import relative_bound_excess
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.loop.trajectory import scaled_equilibrium
from ssm_study.plants.disturbance import RampDisturbance, StepDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sensitivity import error_to_input_response, gain_peaks_on_grid
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains

LOADED = LoopExperiment(
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
    with_weight = replace(integral(), integral_weight=1e-3)
    return with_weight.design(motor_model(), BALLS)


def test_the_augmented_pair_is_the_equations_written_out():
    model = random_model(1, inputs=2, outputs=2)
    system = append_internal_model(model)
    rng = np.random.default_rng(0)
    x = rng.standard_normal(4)
    z = rng.standard_normal(2)
    v = rng.standard_normal(2)
    augmented = np.concatenate([x, z])
    after = system.a @ augmented + system.b @ v
    actual = after[:4]
    linear_a = model.linear.a
    linear_b = model.linear.b
    expected = linear_a @ x + linear_b @ v
    np.testing.assert_allclose(actual, expected)
    actual = after[4:]
    scaled = model.scaled_output_at(x, v)
    expected = z + scaled
    np.testing.assert_allclose(actual, expected)


def test_the_certificate_is_the_theorem_on_the_augmented_pair(design):
    part = design.state_feedback
    system = controlled_system(motor_model(), design.state_feedback)
    expected = motor_model().order + 1
    assert system.order == expected
    np.testing.assert_array_equal(part.a, system.a)
    ball = {"alpha": INPUT_BALL.alpha, "beta": INPUT_BALL.beta}
    names = ("rate", "p", "y", "k", "sigma")
    numbers = {name: getattr(part, name) for name in names}
    assert part.certified
    assert StateFeedbackOfBall.holds(a=system.a, b=system.b, **ball, **numbers)


def test_an_integrator_costs_rate_as_the_frontier_says():
    """The integrator is one more mode to move: the product over the modes faster than r gains a
    factor r / 1."""
    model = motor_model()
    r = 0.97
    a = model.linear.a
    b = model.linear.b
    alone = ratio_limit(a, b, r)
    with_it = ratio_limit(*_pair(model), r)
    expected = alone * r / 1.0
    assert with_it == pytest.approx(expected, rel=1e-6)
    state_feedback = integral().design(model, BALLS).state_feedback
    limit = state_feedback.rate_limit
    riccati_synthesis = integral(limit * 1.001)
    beyond = riccati_synthesis.design(model, BALLS).state_feedback
    riccati_synthesis = integral(limit * 0.98)
    within = riccati_synthesis.design(model, BALLS).state_feedback
    assert isinstance(beyond, Infeasible)
    assert beyond.proved
    assert within.certified


def _pair(model):
    system = append_internal_model(model)
    return system.a, system.b


def test_no_steady_error_under_a_constant_load_on_the_true_motor(design):
    loop = LOADED.run_design(motor(), motor_model(), design, seed=0)
    columns = behaviour_columns(loop)
    assert columns["stable_count"] == 10
    assert columns["final_error_worst"] < 1e-3


def test_without_integral_action_the_load_leaves_an_error():
    plain = inner().design(motor_model(), BALLS)
    loop = LOADED.run_design(motor(), motor_model(), plain, seed=0)
    columns = behaviour_columns(loop)
    assert columns["final_error_worst"] > 0.2


def test_the_certified_bound_holds_with_integrators(design):
    result = LOADED.run_design(motor(), motor_model(), design, seed=1)
    columns = certified_bound_columns(result, design)
    assert columns["certified_bound_violations"] == 0
    rate = design.observer.rate
    lower_limit = rate * (1 - 1e-9)
    assert columns["estimate_decay_rate"] >= lower_limit
    x_hat = result.on_model.estimate
    states = result.on_model.states
    x0 = states[:, 0]
    assert relative_bound_excess(x_hat, x0, *design.controller_and_observer()) == 0.0
    assert (
        columns["certified_bound_excess_plant"] is None
    )  # the plant follows a reference, the model none
    estimate = result.on_model.estimate
    expected = motor_model().order + 1
    assert estimate.shape[2] == expected


def test_limits_do_not_wind_the_integrator_up(design):
    """Away from the limits again, the loop is where the one without limits is: nothing was stored
    meanwhile."""
    rising = RampDisturbance(slope_per_s=2.0, from_s=1.0, until_s=4.0)
    free = LoopExperiment(
        initial_conditions=3, horizon_s=6.0, measurement_noise_variance=0.0, reference=rising
    )
    limited = replace(free, input_lower=-0.8, input_upper=1.6)
    loops = (limited, free)
    run, other = (
        loop.run_design(motor(), motor_model(), design, seed=0).controlled for loop in loops
    )
    smallest = run.u.min()
    assert smallest == -0.8
    smallest = other.u.min()
    assert smallest < -1.0
    difference = np.abs(run.y - other.y)
    largest = difference[:, -50:].max()
    assert largest < 0.05


def test_a_step_that_needs_the_limit_for_a_while_is_followed(design):
    """Its value is held from within the limits, its plan is not: the input waits at the limit, and
    nothing winds up."""
    step = StepReference(before=0.0, after=8.0, at_s=1.0)
    free = LoopExperiment(
        initial_conditions=3, horizon_s=5.0, measurement_noise_variance=0.0, reference=step
    )
    y = np.array([8.0])
    rest_input = scaled_equilibrium(motor_model(), y)[1][0]
    held = float(rest_input) * motor_model().scale.input_scale[0]
    limited = replace(free, input_lower=-1.2 * held, input_upper=1.2 * held)
    loops = (limited, free)
    run, other = (
        loop.run_design(motor(), motor_model(), design, seed=0).controlled for loop in loops
    )
    largest = other.u.max()
    assert largest > 1.3 * held
    at_the_limit = run.u[:, 100:] == 1.2 * held
    assert (at_the_limit).sum() > 3
    largest = run.u.max()
    assert largest == 1.2 * held
    difference = np.abs(run.y - run.reference)
    largest = difference[:, -50:].max()
    assert largest < 1e-3
    largest = run.y.max()
    assert largest < 1.1 * 8.0
    changed_limited = replace(limited, input_upper=0.9 * held)
    with pytest.raises(
        BadRequest, match=r"holding the reference takes inputs from .* widen the limits by"
    ):
        changed_limited.run_design(motor(), motor_model(), design, seed=0)


def test_the_margin_with_integrators_by_two_routes(design):
    model = motor_model()
    k = design.state_feedback.k
    gain = design.observer.l
    angles = np.geomspace(1e-3, np.pi, 200)
    by_space = max(
        largest_gains(
            error_to_input_response(model.linear, Gains(k=k, l=gain), i, 1.0), angles
        ).max()
        for i in (INPUT_BALL.lower, INPUT_BALL.alpha, INPUT_BALL.upper)
    )
    peaks = gain_peaks_on_grid(model.linear, k[None], gain[None], BALLS, angles)
    by_factors = peaks[0, 0]
    assert by_factors == pytest.approx(by_space, rel=1e-9)


def test_auto_chooses_with_integral_action():
    stretch_shares = (0.3, 0.8)
    observer_rates = (0.05, 0.3)
    input_weights = (0.01, 0.1, 1.0, 10.0)
    output_noises = (0.01, 0.1, 1.0)
    integral_weights = (1e-4, 1e-3)
    auto = Auto(
        stretch_shares=stretch_shares,
        observer_rates=observer_rates,
        input_weights=input_weights,
        output_noises=output_noises,
        integral_weights=integral_weights,
    )
    chosen = auto.design(motor_model(), BALLS, (motor_record(),))
    assert chosen.certified
    state_feedback_k = chosen.state_feedback.k
    assert state_feedback_k.shape == (1, 3)
    shown = measure_model_error(motor_model(), (motor_record(),))
    prediction = predict_margins(motor_model(), chosen.gain_pair, BALLS, shown)
    assert prediction.predicts_stability()
    loop = LOADED.run_design(motor(), motor_model(), chosen, seed=0)
    columns = behaviour_columns(loop)
    assert columns["final_error_worst"] < 1e-2


def test_more_outputs_than_inputs_are_refused():
    model = random_model(0, inputs=1, outputs=2)
    with pytest.raises(BadRequest, match="an input is needed for every controlled output"):
        append_internal_model(model)


def test_a_gain_of_the_wrong_width_is_refused():
    k = np.zeros((1, 4))
    no_injection = np.zeros((2, 1))
    observer_feedback_gains = Gains(k=k, l=no_injection)
    with pytest.raises(BadRequest, match="k = "):
        ObserverFeedback(model=motor_model(), gains=observer_feedback_gains)


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
    system = append_internal_model(model, weight=0.09)
    augmented = np.concatenate([x, z])
    cost = (system.c @ augmented) ** 2
    ubar = np.zeros(2)
    scaled = model.scaled_output_at(x, ubar)
    of_output = (scaled**2).sum()
    of_integrators = 0.09 * (z**2).sum()
    expected = of_output + of_integrators
    assert cost.sum() == pytest.approx(expected)
    integral_weight = inner().integral_weight
    weights = (1e-5, integral_weight, 1e-1)
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


def test_the_design_has_the_recorded_numbers(design: Design) -> None:
    assert_as_recorded("loop_integral", design, 1e-3)
