"""Laws of `auto`: its choice is certified, holds the margin, keeps what it is given, and never sees
the plant."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from loop_cases import BALLS, INPUT_BALL, motor, motor_model, motor_record
from recorded import assert_as_recorded
from structured_cases import model

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.theorems.integral_action import append_internal_model
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.models.structured import StructuredSSM
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import Prediction, predict_margins
from ssm_study.signals import Trajectory
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.candidate_grid import OWN_SHARE
from ssm_study.synthesis.expected_response import LOSS, expected_response_area
from ssm_study.synthesis.integrated_error import relative_response_areas
from ssm_study.synthesis.structured_lmi import StructuredLmi
from ssm_study.systems import Gains, JacobianBall, JacobianBalls

SMALL = Auto(
    stretch_shares=(0.1, 0.6),
    observer_rates=(0.05, 0.3),
    input_weights=(0.01, 0.1, 1.0),
    output_noises=(0.01, 0.1, 1.0),
)


def predicted(design: Design, record: Trajectory) -> Prediction:
    return predict_margins(
        motor_model(), design.gain_pair, BALLS, measure_model_error(motor_model(), (record,))
    )


@pytest.fixture(scope="module")
def chosen() -> Design:
    return SMALL.design(motor_model(), BALLS, (motor_record(),))


def test_the_choice_is_certified_and_predicted_to_keep_the_plant(chosen):
    assert chosen.certified
    method = chosen.state_feedback.method
    assert method == chosen.observer.method == "auto"
    prediction = predicted(chosen, motor_record())
    assert prediction.predicts_stability()
    rate = chosen.state_feedback.rate
    assert rate < chosen.state_feedback.rate_limit


FEW = {
    "stretch_shares": (0.6,),
    "observer_rates": (0.3,),
    "input_weights": (0.1,),
    "output_noises": (0.1,),
}


def with_neurons() -> tuple[StructuredSSM, JacobianBalls, Trajectory]:
    """A model with neurons, and a record that misses it by noise."""
    stand = model()
    rng = np.random.default_rng(0)
    u = 0.5 + 2.0 * np.repeat(rng.uniform(-1, 1, size=(80, 1)), 5, axis=0)
    response = stand.simulate(u)
    white_noise = rng.standard_normal(u.shape)
    y = response + 4.0 * white_noise
    trajectory = Trajectory(u=u, y=y, step_s=0.01)
    return stand, certified_balls(stand), trajectory


@pytest.mark.parametrize(
    "case", [lambda: (motor_model(), BALLS, motor_record()), with_neurons], ids=["motor", "neurons"]
)
def test_no_candidate_that_is_predicted_to_keep_the_plant_has_a_better_expected_response(case):
    """The search looks at few; here is every pair, each predicted by itself on the fine grid."""
    given, balls, record = case()
    auto = replace(SMALL, **FEW) if isinstance(given, StructuredSSM) else SMALL
    candidates = auto.compute_candidates(given, balls)
    shown = measure_model_error(given, (record,))
    pairs = np.array([(i, j) for i in range(len(candidates.ks)) for j in range(len(candidates.ls))])
    gains = candidates.gains(pairs)
    areas = relative_response_areas(given, gains, (record,))
    found = [predict_margins(given, candidates.gains(pair), balls, shown) for pair in pairs]
    keeps = np.array([prediction.predicts_stability() for prediction in found])
    assert 0 < keeps.sum() < len(keeps)
    expected = np.array(
        [
            expected_response_area(a, 1 / p.resolved_margin, shown.spread)
            for a, p in zip(areas, found, strict=True)
        ]
    )
    own = auto.design(given, balls, (record,), shown).gain_pair
    k = own.k[None]
    l_z = None if own.l_z is None else own.l_z[None]
    one = replace(own, k=k, l=own.l[None], l_z=l_z)
    margin = predict_margins(given, own, balls, shown).resolved_margin
    area = expected_response_area(
        relative_response_areas(given, one, (record,))[0], 1 / margin, shown.spread
    )
    smallest = expected[keeps].min()
    assert area == pytest.approx(smallest, rel=0.01)


def test_gains_at_frozen_slopes_are_taken_where_they_are_proved_for_every_slope():
    """Gains at frozen slopes are those of one layer for the model at rest or half way; a faster
    rate than they have refuses them."""
    stand, balls, _ = with_neurons()
    candidates = replace(SMALL, **FEW).compute_candidates(stand, balls)
    frozen = [i for i, made in enumerate(candidates.feedback) if made.near[False].logs is None]
    assert frozen
    design = candidates.synthesis_settings(np.array([frozen[0], 0])).design(stand, balls)
    assert design.certified
    actual = design.state_feedback.k
    expected = candidates.ks[frozen[0]]
    np.testing.assert_array_equal(actual, expected)
    problem = candidates.feedback[frozen[0]].problem(stand.system, balls.input).at_rate(0.999)
    structured_lmi = StructuredLmi.for_fixed_gains(problem)
    with pytest.raises(NoSolution):
        structured_lmi.prove_rate(candidates.ks[frozen[0]])


def test_an_uncertain_mismatch_moves_the_choice_away_from_the_edge():
    """At the edge half of the samples of g fail on the plant; far from it the expected area is the
    area."""
    expected = (0.3 + LOSS) / 2
    assert expected_response_area(0.3, 1.0, 0.2) == pytest.approx(expected)
    assert expected_response_area(0.3, 0.1, 0.2) == pytest.approx(0.3)
    assert expected_response_area(0.3, 0.7, 0.6) > expected_response_area(0.4, 0.3, 0.6)
    assert expected_response_area(0.3, 0.7, 0.1) < expected_response_area(0.4, 0.3, 0.1)


def test_the_choice_settles_the_true_motor_faster_than_none(chosen):
    loop = LoopExperiment(horizon_s=1.5, measurement_noise_variance=0.02)
    result = loop.run_design(motor(), motor_model(), chosen, seed=0)
    columns = behaviour_columns(result) | certified_bound_columns(result, chosen)
    assert columns["stable_count"] == 10
    upper_limit = 0.6 * columns["settling_time_open_loop_s"]
    assert columns["settling_time_mean_s"] < upper_limit
    assert columns["certified_bound_violations"] == 0


def test_more_mismatch_makes_it_slower(chosen):
    rng = np.random.default_rng(0)
    record = motor_record()
    white_noise = rng.standard_normal(record.y.shape)
    y = record.y + 2.0 * white_noise
    worse = replace(record, y=y)
    careful = SMALL.design(motor_model(), BALLS, (worse,))
    areas = [
        relative_response_areas(
            motor_model(), Gains(k=d.state_feedback.k[None], l=d.observer.l[None]), (record,)
        )[0]
        for d in (chosen, careful)
    ]
    assert areas[1] > areas[0]


def test_without_any_margin_the_largest_is_taken_and_said():
    record = motor_record()
    y = record.y + 1e4
    useless = replace(record, y=y)
    design = SMALL.design(motor_model(), BALLS, (useless,))
    assert design.certified
    prediction = predicted(design, useless)
    assert not prediction.predicts_stability()
    assert "largest margin" in design.state_feedback.solver_status


def test_a_caution_without_any_mismatch_takes_the_largest_margin():
    """Infinite times zero is no number."""
    record = motor_record()
    y = motor_model().simulate(record.u)
    exact = replace(record, y=y)
    design = SMALL.with_largest_margin().design(motor_model(), BALLS, (exact,))
    assert design.certified
    assert "no judgement" in design.state_feedback.solver_status


def test_the_search_goes_on_where_the_first_found_are_refused_as_designs(monkeypatch):
    """Not the largest margin, and with it hardly any control, while slower candidates pass."""
    refused = 12
    judged = []

    def hard_to_please(*asked: Any) -> Prediction:
        judged.append(found := predict_margins(*asked))
        return found if len(judged) > refused else replace(found, resolved_margin=0.999)

    monkeypatch.setattr("ssm_study.synthesis.auto.predict_margins", hard_to_please)
    design = SMALL.design(motor_model(), BALLS, (motor_record(),))
    assert len(judged) == refused + 1
    assert "best expected response" in design.state_feedback.solver_status
    prediction = predicted(design, motor_record())
    assert prediction.predicts_stability()


def test_a_given_rate_is_kept():
    kept = replace(SMALL, rate_controller=0.02, rate_observer=0.15)
    design = kept.design(motor_model(), BALLS, (motor_record(),))
    assert design.state_feedback.rate == 0.02
    assert design.observer.rate == 0.15


def test_one_rate_stands_for_both_sides_that_are_left_to_auto():
    both = replace(SMALL, rate=0.02).design(motor_model(), BALLS, (motor_record(),))
    assert both.state_feedback.rate == 0.02
    assert both.observer.rate == 0.02
    one = replace(SMALL, rate=0.02, rate_observer=0.15)
    design = one.design(motor_model(), BALLS, (motor_record(),))
    assert design.state_feedback.rate == 0.02
    assert design.observer.rate == 0.15


@pytest.mark.parametrize("group", ["auto", "auto_integral"])
def test_rate_is_a_key_of_the_configuration(group):
    with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
        number = [f"synthesis={group}", "synthesis.rate=auto", "study=s"]
        dict_config = compose("study", number)
        asked = dict_config.synthesis
        number = [f"synthesis={group}", "synthesis.rate=0.1", "study=s"]
        dict_config = compose("study", number)
        given = dict_config.synthesis
    assert instantiate(asked).rate == "auto"
    assert instantiate(given).rate == 0.1


def test_a_rate_beyond_the_frontier_is_infeasible_and_says_how_far():
    design = replace(SMALL, rate_controller=0.9).design(motor_model(), BALLS, (motor_record(),))
    assert isinstance(design.state_feedback, Infeasible)
    assert design.state_feedback.proved
    assert design.state_feedback.rate_limit < 0.9


def test_slopes_that_hold_zero_are_infeasible():
    design = SMALL.design(
        motor_model(), replace(BALLS, input=JacobianBall.from_slopes(-0.1, 1.0)), (motor_record(),)
    )
    assert isinstance(design.state_feedback, Infeasible)


def test_a_record_without_excitation_is_refused():
    u = np.zeros((50, 1))
    y = np.zeros((50, 1))
    still = Trajectory(u=u, y=y, step_s=0.01)
    with pytest.raises(BadRequest, match="validation"):
        SMALL.design(motor_model(), BALLS, (still,))


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"rate": "fast"}, r"synthesis\.rate "),
        ({"rate_controller": "fast"}, "rate_controller"),
        ({"rate_observer": 1.0}, "rate_observer"),
        ({"margin": 0.0}, "margin"),
        ({"observer_rates": ()}, "observer_rates"),
        ({"observer_rates": (0.1, 1.0)}, "observer_rates"),
        ({"stretch_shares": (0.0,)}, "stretch_shares"),
        ({"input_weights": (0.0,)}, "input_weights"),
        ({"input_weights": ()}, "input_weights"),
        ({"output_noises": (1.0, np.inf)}, "output_noises"),
        ({"integral_weights": (-1.0,)}, "integral_weights"),
        ({"rate": 0.0}, r"synthesis\.rate "),
    ],
)
def test_values_out_of_range(values, names):
    with pytest.raises(BadRequest, match=names):
        Auto(**values)


def test_the_default_grids_are_those_of_the_documentation():
    """Docs: from half the model's own rate up to 0.9 of the way to the frontier, weights from 1e-3
    to 100; no gaps."""
    auto = Auto()
    assert OWN_SHARE == 0.5
    assert max(auto.stretch_shares) == 0.9
    for weights in (auto.input_weights, auto.output_noises):
        assert min(weights) == 1e-3
        assert max(weights) == 100.0
        steps = np.diff(np.log10(weights))
        assert steps.min() > 0
        assert steps.max() <= 1 + 1e-9
    for shares in (auto.stretch_shares, auto.observer_rates):
        steps = np.diff([0.0, *shares])
        assert steps.min() > 0
        assert steps.max() <= 0.3 + 1e-9
    assert auto.integral_weights == ()
    assert auto.margin == 1.0


def test_each_candidate_is_the_gain_of_its_specification():
    integral_weights = (1e-3, 1e-2)
    auto = replace(SMALL, integral_weights=integral_weights)
    candidates = auto.compute_candidates(motor_model(), BALLS)
    integral_weights = {made.integral_weight for made in candidates.feedback}
    assert integral_weights == {1e-3, 1e-2}
    last = np.array([len(candidates.ks) - 1, len(candidates.ls) - 1])
    for pair in (np.array([0, 0]), last // 2, last):
        asked = candidates.synthesis_settings(pair)
        design = asked.design(motor_model(), BALLS)
        actual = design.state_feedback.k
        expected = candidates.ks[pair[0]]
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
        actual = design.observer.l
        expected = candidates.ls[pair[1]]
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
        expected = candidates.feedback[pair[0]].integral_weight
        assert asked.integral_weight == expected
        assert asked.state_weight == 1e-6
        assert asked.state_noise == 1e-4


def test_the_grid_of_rates_runs_from_the_models_own_to_the_frontier():
    """Half the model's own rate, then shares of the stretch from there to the limit; absolute ones
    for the observer."""
    model = motor_model()
    candidates = SMALL.compute_candidates(model, BALLS)
    own = 1 - model.linear.spectral_radius**2
    frontier = controller_frontier(model.linear, INPUT_BALL)
    limit = frontier.rate_limit
    rate_controllers = {specification.rate_controller for specification in candidates.feedback}
    rates = sorted(rate_controllers)
    expected = [own / 2, own + 0.1 * (limit - own), own + 0.6 * (limit - own)]
    np.testing.assert_allclose(rates, expected)
    rate_observers = {specification.rate_observer for specification in candidates.observing}
    observed = sorted(rate_observers)
    expected = sorted([own / 2, 0.05, 0.3])
    np.testing.assert_allclose(observed, expected)
    input_weights = {specification.input_weight for specification in candidates.feedback}
    assert input_weights == set(SMALL.input_weights)
    output_noises = {specification.output_noise for specification in candidates.observing}
    assert output_noises == set(SMALL.output_noises)


def test_an_unstable_model_has_no_cautious_rate():
    model = motor_model()
    a = model.linear.a * 1.05
    linear = replace(model.linear, a=a)
    unstable = model.with_linear_part(linear)
    candidates = SMALL.compute_candidates(unstable, BALLS)
    frontier = controller_frontier(unstable.linear, INPUT_BALL)
    limit = frontier.rate_limit
    rate_controllers = {specification.rate_controller for specification in candidates.feedback}
    rates = sorted(rate_controllers)
    expected = [0.1 * limit, 0.6 * limit]
    np.testing.assert_allclose(rates, expected)


def test_a_larger_margin_is_kept_or_said_to_be_out_of_reach(chosen):
    prediction = predicted(chosen, motor_record())
    reached = prediction.resolved_margin
    careful = replace(SMALL, margin=1.5 * reached).design(motor_model(), BALLS, (motor_record(),))
    prediction = predicted(careful, motor_record())
    resolved_margin = prediction.resolved_margin
    assert resolved_margin > 1.5 * reached
    solver_status = careful.state_feedback.solver_status
    assert solver_status.startswith("best expected response of those predicted to be stable; tau")
    none = replace(SMALL, margin=1e9).design(motor_model(), BALLS, (motor_record(),))
    solver_status = none.observer.solver_status
    assert solver_status.startswith(
        "no stable controller with margin above 1e+09; largest margin taken"
    )
    prediction = predicted(none, motor_record())
    resolved_margin = prediction.resolved_margin
    prediction = predicted(careful, motor_record())
    lower_limit = prediction.resolved_margin
    assert resolved_margin >= lower_limit


def test_with_integral_action_an_impossible_request_says_why():
    asked = replace(SMALL, rate_controller=0.9, integral_weights=(1e-3,))
    design = asked.design(motor_model(), BALLS, (motor_record(),))
    assert design.state_feedback.proved
    assert design.state_feedback.rate == 0.9
    system = append_internal_model(motor_model())
    frontier = controller_frontier(system, INPUT_BALL)
    limit = frontier.rate_limit
    rate_limit = design.state_feedback.rate_limit
    assert rate_limit == limit < controller_frontier(motor_model().linear, INPUT_BALL).rate_limit
    assert design.observer.certified  # the easiest request is made of the side that was left open
    solver_status = design.state_feedback.solver_status
    assert solver_status.startswith("nothing on the grid is feasible")


def test_the_choice_has_the_recorded_numbers(chosen):
    assert_as_recorded("auto_choice", chosen, 1e-3)
