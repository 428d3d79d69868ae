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
from structured_cases import model

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.theorems.integral_action import with_modes
from ssm_study.loop.metrics import behaviour_columns, certificate_columns
from ssm_study.loop.regulation import Loop
from ssm_study.models.structured import StructuredSSM
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.robustness.prediction import Prediction, predict
from ssm_study.signals import Trajectory
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.candidate_grid import OWN_SHARE
from ssm_study.synthesis.expected_response import LOSS, expected_area
from ssm_study.synthesis.integrated_error import relative_areas
from ssm_study.synthesis.structured_lmi import StructuredLmi
from ssm_study.systems import Balls, Gains, JacobianBall

SMALL = Auto(
    stretch_shares=(0.1, 0.6),
    observer_rates=(0.05, 0.3),
    input_weights=(0.01, 0.1, 1.0),
    output_noises=(0.01, 0.1, 1.0),
)


def predicted(design: Design, record: Trajectory) -> Prediction:
    return predict(motor_model(), design.pair, BALLS, measure_mismatch(motor_model(), (record,)))


@pytest.fixture(scope="module")
def chosen() -> Design:
    return SMALL.design(motor_model(), BALLS, (motor_record(),))


def test_the_choice_is_certified_and_predicted_to_keep_the_plant(chosen):
    assert chosen.certified
    assert chosen.state_feedback.method == chosen.observer.method == "auto"
    assert predicted(chosen, motor_record()).predicts_stability()
    assert chosen.state_feedback.rate < chosen.state_feedback.rate_limit


FEW = {
    "stretch_shares": (0.6,),
    "observer_rates": (0.3,),
    "input_weights": (0.1,),
    "output_noises": (0.1,),
}


def with_neurons() -> tuple[StructuredSSM, Balls, Trajectory]:
    """A model with neurons, and a record that misses it by noise."""
    stand = model()
    rng = np.random.default_rng(0)
    u = 0.5 + 2.0 * np.repeat(rng.uniform(-1, 1, size=(80, 1)), 5, axis=0)
    y = stand.simulate(u) + 4.0 * rng.standard_normal(u.shape)
    return stand, certified_balls(stand), Trajectory(u=u, y=y, step_s=0.01)


@pytest.mark.parametrize(
    "case", [lambda: (motor_model(), BALLS, motor_record()), with_neurons], ids=["motor", "neurons"]
)
def test_no_candidate_that_is_predicted_to_keep_the_plant_has_a_better_expected_response(case):
    """The search looks at few; here is every pair, each predicted by itself on the fine grid."""
    given, balls, record = case()
    auto = replace(SMALL, **FEW) if isinstance(given, StructuredSSM) else SMALL
    candidates = auto.candidates(given, balls)
    shown = measure_mismatch(given, (record,))
    pairs = np.array([(i, j) for i in range(len(candidates.ks)) for j in range(len(candidates.ls))])
    areas = relative_areas(given, candidates.gains(pairs), (record,))
    found = [predict(given, candidates.gains(pair), balls, shown) for pair in pairs]
    keeps = np.array([prediction.predicts_stability() for prediction in found])
    assert 0 < keeps.sum() < len(keeps)
    expected = np.array(
        [
            expected_area(a, 1 / p.resolved_margin, shown.spread)
            for a, p in zip(areas, found, strict=True)
        ]
    )
    own = auto.design(given, balls, (record,), shown).pair
    one = replace(own, k=own.k[None], l=own.l[None], l_z=None if own.l_z is None else own.l_z[None])
    margin = predict(given, own, balls, shown).resolved_margin
    area = expected_area(relative_areas(given, one, (record,))[0], 1 / margin, shown.spread)
    assert area == pytest.approx(expected[keeps].min(), rel=0.01)


def test_gains_at_frozen_slopes_are_taken_where_they_are_proved_for_every_slope():
    """Gains at frozen slopes are those of one layer for the model at rest or half way; a faster
    rate than they have refuses them."""
    stand, balls, _ = with_neurons()
    candidates = replace(SMALL, **FEW).candidates(stand, balls)
    frozen = [i for i, made in enumerate(candidates.feedback) if made.near[False].logs is None]
    assert frozen
    design = candidates.specification(np.array([frozen[0], 0])).design(stand, balls)
    assert design.certified
    np.testing.assert_array_equal(design.state_feedback.k, candidates.ks[frozen[0]])
    problem = candidates.feedback[frozen[0]].problem(stand.system, balls.input).at(0.999)
    with pytest.raises(NoSolution):
        StructuredLmi.of_gains(problem).proved(candidates.ks[frozen[0]])


def test_an_uncertain_mismatch_moves_the_choice_away_from_the_edge():
    """At the edge half of the samples of g fail on the plant; far from it the expected area is the
    area."""
    assert expected_area(0.3, 1.0, 0.2) == pytest.approx((0.3 + LOSS) / 2)
    assert expected_area(0.3, 0.1, 0.2) == pytest.approx(0.3)
    assert expected_area(0.3, 0.7, 0.6) > expected_area(0.4, 0.3, 0.6)
    assert expected_area(0.3, 0.7, 0.1) < expected_area(0.4, 0.3, 0.1)


def test_the_choice_settles_the_true_motor_faster_than_none(chosen):
    result = Loop(horizon_s=1.5, measurement_noise_variance=0.02).run(
        motor(), motor_model(), chosen, seed=0
    )
    columns = behaviour_columns(result) | certificate_columns(result, chosen)
    assert columns["stable_count"] == 10
    assert columns["settling_time_mean_s"] < 0.6 * columns["settling_time_open_loop_s"]
    assert columns["certified_bound_violations"] == 0


def test_more_mismatch_makes_it_slower(chosen):
    rng = np.random.default_rng(0)
    record = motor_record()
    worse = replace(record, y=record.y + 2.0 * rng.standard_normal(record.y.shape))
    careful = SMALL.design(motor_model(), BALLS, (worse,))
    areas = [
        relative_areas(
            motor_model(), Gains(k=d.state_feedback.k[None], l=d.observer.l[None]), (record,)
        )[0]
        for d in (chosen, careful)
    ]
    assert areas[1] > areas[0]


def test_without_any_margin_the_largest_is_taken_and_said():
    record = motor_record()
    useless = replace(record, y=record.y + 1e4)
    design = SMALL.design(motor_model(), BALLS, (useless,))
    assert design.certified
    assert not predicted(design, useless).predicts_stability()
    assert "largest margin" in design.state_feedback.solver_status


def test_a_caution_without_any_mismatch_takes_the_largest_margin():
    """Infinite times zero is no number."""
    record = motor_record()
    exact = replace(record, y=motor_model().simulate(record.u))
    design = SMALL.with_largest_margin().design(motor_model(), BALLS, (exact,))
    assert design.certified
    assert "no judgement" in design.state_feedback.solver_status


def test_the_search_goes_on_where_the_first_found_are_refused_as_designs(monkeypatch):
    """Not the largest margin, and with it hardly any control, while slower candidates pass."""
    refused = 12
    judged = []

    def hard_to_please(*asked: Any) -> Prediction:
        judged.append(found := predict(*asked))
        return found if len(judged) > refused else replace(found, resolved_margin=0.999)

    monkeypatch.setattr("ssm_study.synthesis.auto.predict", hard_to_please)
    design = SMALL.design(motor_model(), BALLS, (motor_record(),))
    assert len(judged) == refused + 1
    assert "best expected response" in design.state_feedback.solver_status
    assert predicted(design, motor_record()).predicts_stability()


def test_a_given_rate_is_kept():
    kept = replace(SMALL, rate_controller=0.02, rate_observer=0.15)
    design = kept.design(motor_model(), BALLS, (motor_record(),))
    assert design.state_feedback.rate == 0.02
    assert design.observer.rate == 0.15


def test_one_rate_stands_for_both_sides_that_are_left_to_auto():
    both = replace(SMALL, rate=0.02).design(motor_model(), BALLS, (motor_record(),))
    assert (both.state_feedback.rate, both.observer.rate) == (0.02, 0.02)
    one = replace(SMALL, rate=0.02, rate_observer=0.15)
    design = one.design(motor_model(), BALLS, (motor_record(),))
    assert (design.state_feedback.rate, design.observer.rate) == (0.02, 0.15)


@pytest.mark.parametrize("group", ["auto", "auto_integral"])
def test_rate_is_a_key_of_the_configuration(group):
    with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
        asked = compose("study", [f"synthesis={group}", "synthesis.rate=auto", "study=s"]).synthesis
        given = compose("study", [f"synthesis={group}", "synthesis.rate=0.1", "study=s"]).synthesis
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
    still = Trajectory(u=np.zeros((50, 1)), y=np.zeros((50, 1)), step_s=0.01)
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
        assert (min(weights), max(weights)) == (1e-3, 100.0)
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
    auto = replace(SMALL, integral_weights=(1e-3, 1e-2))
    candidates = auto.candidates(motor_model(), BALLS)
    assert {made.integral_weight for made in candidates.feedback} == {1e-3, 1e-2}
    last = np.array([len(candidates.ks) - 1, len(candidates.ls) - 1])
    for pair in (np.array([0, 0]), last // 2, last):
        asked = candidates.specification(pair)
        design = asked.design(motor_model(), BALLS)
        np.testing.assert_allclose(design.state_feedback.k, candidates.ks[pair[0]], rtol=1e-9)
        np.testing.assert_allclose(design.observer.l, candidates.ls[pair[1]], rtol=1e-9)
        assert asked.integral_weight == candidates.feedback[pair[0]].integral_weight
        assert (asked.state_weight, asked.state_noise) == (1e-6, 1e-4)


def test_the_grid_of_rates_runs_from_the_models_own_to_the_frontier():
    """Half the model's own rate, then shares of the stretch from there to the limit; absolute ones
    for the observer."""
    model = motor_model()
    candidates = SMALL.candidates(model, BALLS)
    own = 1 - model.linear.spectral_radius**2
    limit = controller_frontier(model.linear, INPUT_BALL).rate_limit
    rates = sorted({specification.rate_controller for specification in candidates.feedback})
    np.testing.assert_allclose(
        rates, [own / 2, own + 0.1 * (limit - own), own + 0.6 * (limit - own)]
    )
    observed = sorted({specification.rate_observer for specification in candidates.observing})
    np.testing.assert_allclose(observed, sorted([own / 2, 0.05, 0.3]))
    assert {specification.input_weight for specification in candidates.feedback} == set(
        SMALL.input_weights
    )
    assert {specification.output_noise for specification in candidates.observing} == set(
        SMALL.output_noises
    )


def test_an_unstable_model_has_no_cautious_rate():
    model = motor_model()
    unstable = model.with_linear(replace(model.linear, a=model.linear.a * 1.05))
    candidates = SMALL.candidates(unstable, BALLS)
    limit = controller_frontier(unstable.linear, INPUT_BALL).rate_limit
    rates = sorted({specification.rate_controller for specification in candidates.feedback})
    np.testing.assert_allclose(rates, [0.1 * limit, 0.6 * limit])


def test_a_larger_margin_is_kept_or_said_to_be_out_of_reach(chosen):
    reached = predicted(chosen, motor_record()).resolved_margin
    careful = replace(SMALL, margin=1.5 * reached).design(motor_model(), BALLS, (motor_record(),))
    assert predicted(careful, motor_record()).resolved_margin > 1.5 * reached
    assert careful.state_feedback.solver_status.startswith(
        "best expected response of those predicted to be stable; tau"
    )
    none = replace(SMALL, margin=1e9).design(motor_model(), BALLS, (motor_record(),))
    assert none.observer.solver_status.startswith(
        "no stable controller with margin above 1e+09; largest margin taken"
    )
    assert (
        predicted(none, motor_record()).resolved_margin
        >= predicted(careful, motor_record()).resolved_margin
    )


def test_with_integral_action_an_impossible_request_says_why():
    asked = replace(SMALL, rate_controller=0.9, integral_weights=(1e-3,))
    design = asked.design(motor_model(), BALLS, (motor_record(),))
    assert design.state_feedback.proved
    assert design.state_feedback.rate == 0.9
    limit = controller_frontier(with_modes(motor_model()), INPUT_BALL).rate_limit
    assert (
        design.state_feedback.rate_limit
        == limit
        < controller_frontier(motor_model().linear, INPUT_BALL).rate_limit
    )
    assert design.observer.certified  # the easiest request is made of the side that was left open
    assert design.state_feedback.solver_status.startswith("nothing on the grid is feasible")
