"""The peers are what their textbooks say, and the tables have every row they promise."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from loop_cases import BALLS, motor, motor_design, motor_model, motor_record, random_model
from recorded import assert_as_recorded
from structured_cases import model as with_neurons

from ssm_study.loop.comparison import SITUATIONS, ControllerComparison
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.design_grid import RandomDesignTable
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.loop.peers.lqg import lqg_controller
from ssm_study.loop.peers.peer import IdentificationResult, build_compared_controller
from ssm_study.loop.peers.pi import tyreus_luyben_pi, ultimate_gain
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.plants.disturbance import StepDisturbance
from ssm_study.plants.wrapper import PlantWrapper
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains

KNOWN = IdentificationResult(model=motor_model(), balls=BALLS, validation=(motor_record(),))
SHORT = LoopExperiment(horizon_s=0.4, measurement_noise_variance=0.02, initial_conditions=3)
WEIGHTS = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
SMALL = Auto(
    stretch_shares=(0.3,),
    observer_rates=(0.1, 0.3),
    input_weights=(1e-4, 0.1),
    output_noises=(1e-4, 0.1),
)


def test_the_ultimate_gain_is_where_the_loop_just_oscillates():
    model = motor_model()
    limit = ultimate_gain(motor_model())
    weights = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    observer_feedback = lqg_controller(model, weights)
    plain = observer_feedback.model
    linear_b = plain.linear.b
    b = linear_b @ plain.scaffold_in.jacobian(np.zeros(1))
    output_scale = model.scale.output_scale
    input_scale = model.scale.input_scale
    scaled = limit.gain * output_scale[0] / input_scale[0]
    for factor, stable in ((0.999, True), (1.001, False)):
        linear_a = model.linear.a
        linear_c = model.linear.c
        difference = linear_a - factor * scaled * b @ linear_c
        poles = np.linalg.eigvals(difference)
        largest = np.abs(poles).max()
        assert (largest < 1) == stable
    rule = tyreus_luyben_pi(model)
    expected = limit.gain / 3.2
    assert rule.gain == pytest.approx(expected)
    expected = 2.2 * limit.period_s
    assert rule.integral_s == pytest.approx(expected)


def test_pi_leaves_no_error_under_a_load():
    identified_plant = IdentifiedPlant.from_model(motor_model())
    initial_range = (-4.0, 4.0)
    plant = replace(identified_plant, initial_range=initial_range)
    reference = StepReference(before=0.0, after=8.0, at_s=0.0)
    disturbance = StepDisturbance(size=-0.2, at_s=2.0)
    loop = LoopExperiment(
        horizon_s=6.0, measurement_noise_variance=0.0, reference=reference, disturbance=disturbance
    )
    controller = tyreus_luyben_pi(motor_model())
    loop_runs = loop.run_on_plant(plant, controller, seed=0)
    columns = behaviour_columns(loop_runs)
    final_error_worst = columns["final_error_worst"]
    assert final_error_worst < 1e-3


def test_a_textbooks_design_knows_neurons_by_their_slopes_at_rest():
    """Differences are the second route; the gains are those of that linear system, and not of A and
    B alone."""
    model = with_neurons()
    validation = (motor_record(),)
    known = IdentificationResult(model=model, balls=BALLS, validation=validation)
    n = model.order
    m = model.b.shape[1]
    points = 1e-6 * np.eye(n + m)
    ahead = model.next_state(points[:, :n], points[:, n:])
    behind = model.next_state(-points[:, :n], -points[:, n:])
    difference = ahead - behind
    moved = difference.T / 2e-6
    seen = known.linear_model.linear
    linearised = np.hstack([seen.a, seen.b])
    assert linearised == pytest.approx(moved, abs=1e-8)
    built, _ = build_compared_controller("lqg", motor(), known)
    without_neurons = IdentificationResult(
        model=known.linear_model, balls=BALLS, validation=(motor_record(),)
    )
    without = build_compared_controller("lqg", motor(), without_neurons)
    gains_k = built.gains.k
    expected = without[0].gains.k
    assert gains_k == pytest.approx(expected)
    plain = replace(known.linear_model, linear=model.linear)
    plain_identified = IdentificationResult(model=plain, balls=BALLS, validation=(motor_record(),))
    blind = build_compared_controller("lqg", motor(), plain_identified)
    gains_k = built.gains.k
    expected = blind[0].gains.k
    assert gains_k != pytest.approx(expected, rel=1e-3)


def test_lqg_is_optimal_for_the_linear_part():
    """Policy iteration as the second route: the gain's own cost cannot be improved by one greedy
    step."""
    model = random_model(1)
    weights = replace(WEIGHTS, input_weight=0.3)
    law = lqg_controller(model, weights)
    a = law.model.linear.a
    linear_b = law.model.linear.b
    scaffold_in = law.model.scaffold_in
    b = linear_b @ scaffold_in.jacobian(np.zeros(1))
    linear_c = model.linear.c
    state_weight = weights.state_weight * np.eye(4)
    q = linear_c.T @ linear_c + state_weight
    gains_k = law.gains.k
    closed_loop = a + b @ gains_k
    stage_cost = q + 0.3 * gains_k.T @ gains_k
    cost = scipy.linalg.solve_discrete_lyapunov(closed_loop.T, stage_cost)
    input_cost = 0.3 * np.eye(1) + b.T @ cost @ b
    greedy = -np.linalg.solve(input_cost, b.T @ cost @ a)
    actual = law.gains.k
    np.testing.assert_allclose(actual, greedy, rtol=1e-8)


def test_a_grid_of_gains_is_its_designs_one_by_one():
    design = motor_design()
    model = motor_model()
    k = design.gain_pair.k
    l_ = design.gain_pair.l
    ks = np.stack([k, 0.5 * k])
    ls = np.stack([l_, 0.7 * l_])
    gains = Gains(k=ks, l=ls)
    y0, noise = SHORT.draw_starts_and_noise(motor(), seed=2)
    observer_feedback_gains = gains.select_pairs(np.repeat([0, 1], 3))
    grid = ObserverFeedback(model=model, gains=observer_feedback_gains)
    repeated_starts = np.tile(y0, (2, 1))
    repeated_noise = np.tile(noise, (2, 1, 1))
    together = SHORT.simulate(motor(), grid, repeated_starts, repeated_noise)
    for i in range(2):
        observer_feedback_gains = Gains(k=gains.k[i], l=gains.l[i])
        observer_feedback = ObserverFeedback(model=model, gains=observer_feedback_gains)
        alone = SHORT.simulate(motor(), observer_feedback, y0, noise)
        actual = together.y[3 * i : 3 * i + 3]
        np.testing.assert_allclose(actual, alone.y, rtol=1e-9, atol=1e-12)


def test_the_design_grid_reports_each_designs_own_margin(monkeypatch):
    # whose choice the first row is, every choice of `auto` being alike: the small one
    monkeypatch.setattr("ssm_study.loop.design_grid.Auto", lambda: SMALL)
    design_grid = RandomDesignTable(designs=6, auto=SMALL)
    rows = design_grid.rows(motor(), KNOWN, SHORT, seed=0)
    assert_as_recorded("design_grid", rows, 1e-3)
    assert len(rows) == 7
    initial_conditions = {row["initial_conditions"] for row in rows}
    assert initial_conditions == {3}
    candidates = SMALL.compute_candidates(motor_model(), BALLS)
    shown = measure_model_error(motor_model(), (motor_record(),))
    margins = [
        predict_margins(motor_model(), Gains(k=k, l=l_), BALLS, shown).mismatch_margin
        for k in candidates.ks
        for l_ in candidates.ls
    ]
    for row in rows[1:]:
        is_own_margin = np.isclose(margins, row["mismatch_margin"], rtol=1e-6)
        assert is_own_margin.any()
        assert all(isinstance(value, str | None) or np.isfinite(value) for value in row.values())


def test_a_design_grid_without_a_choice_of_auto_has_the_designs_alone(monkeypatch):
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.99, rate_observer=0.3)
    infeasible = riccati_synthesis.design(motor_model(), BALLS)
    assert not infeasible.feasible
    monkeypatch.setattr(Auto, "design", lambda *_: infeasible)
    design_grid = RandomDesignTable(designs=6, auto=SMALL)
    rows = design_grid.rows(motor(), KNOWN, SHORT, seed=0)
    designs = [row["design"] for row in rows]
    expected = [1, 2, 3, 4, 5, 6]
    assert designs == expected


def test_every_controller_has_a_row_in_every_situation():
    names = ("uncontrolled", "pi", "lqg", "guaranteed_cost")
    table = ControllerComparison(
        controllers=names, situations=SITUATIONS, spread_fields=("resistance_ohm",), spread_plants=2
    )
    rows = table.rows(motor(), KNOWN, SHORT, seed=0)
    assert_as_recorded("peers", rows, 1e-3)
    expected = [(n, s) for s in SITUATIONS for n in names]
    cases = [(r["controller"], r["situation"]) for r in rows]
    assert cases == expected
    spread = [r for r in rows if r["situation"] == "spread"]
    initial_conditions = {r["initial_conditions"] for r in spread}
    assert initial_conditions == {6}
    assert not any(
        isinstance(value, float) and np.isnan(value) for row in rows for value in row.values()
    )


def test_the_spread_fills_its_range():
    spread_fields = ("resistance_ohm", "coulomb_torque_nm")
    table = ControllerComparison(spread_fields=spread_fields, spread_plants=10)
    plants = table.perturbed_plants(motor(), seed=0)
    for name in table.spread_fields:
        drawn_values = np.array([getattr(p, name) for p in plants])
        nominal = getattr(motor(), name)
        factors = drawn_values / nominal
        expected = np.arange(10)
        tenths = np.floor((np.sort(factors) - 0.8) / 0.04)
        assert (tenths == expected).all()  # one in each tenth


def test_the_plants_own_pi_is_a_row_of_its_own():
    """Given the numbers of the rule, it is the rule's controller; at another gain it is not."""
    rule = tyreus_luyben_pi(KNOWN.model)
    plant = motor()
    same, other = (
        ControllerComparison(controllers=("pi",), own_pi=(times * rule.gain, rule.integral_s)).rows(
            plant, KNOWN, SHORT, seed=0
        )
        for times in (1, 0.5)
    )
    controllers = [row["controller"] for row in same]
    assert controllers == ["pi", "own_pi"]
    expected = same[1] | {"controller": ""}
    assert same[0] | {"controller": ""} == expected
    assert other[0] == same[0]
    assert other[1]["integral_squared_error"] != same[1]["integral_squared_error"]


class Undisturbed(PlantWrapper):
    """A plant that nothing acts on but its input."""

    disturbances = ()

    def next_states(self, x, u, d):  # noqa: ARG002
        no_disturbance = np.zeros((len(x), 1))
        return self.plant.next_states(x, u, no_disturbance)


def test_a_plant_without_disturbance_has_no_load_rows():
    plant = Undisturbed(plant=motor())
    situations = ("nominal", "load_step", "load_periodic", "spread")
    table = ControllerComparison(controllers=("lqg",), situations=situations)
    rows = table.rows(plant, KNOWN, SHORT, seed=0)
    situations = [row["situation"] for row in rows]
    assert situations == ["nominal"]


def test_what_cannot_be_built_says_why():
    model = random_model(0, inputs=2, outputs=1)
    validation = (motor_record(),)
    known = IdentificationResult(model=model, balls=BALLS, validation=validation)
    controller, said = build_compared_controller("pi", motor(), known)
    assert controller is None
    assert "tuning rule needs one input and one output" in said["reason"]


REFUSED_COMPARISONS = [
    ({"controllers": ("best",)}, "controllers"),
    ({"situations": ("rain",)}, "situations"),
    ({"rate": 1.0}, "rate"),
    ({"spread_share": 1.0}, "spread_share"),
    ({"spread_plants": 0}, "spread_plants"),
    ({"own_pi": (0.5, 0.0)}, "own_pi"),
    ({"own_pi": (0.5,)}, "own_pi"),
]


@pytest.mark.parametrize(("values", "names"), REFUSED_COMPARISONS)
def test_values_out_of_range(values, names):
    with pytest.raises(BadRequest, match=names):
        ControllerComparison(**values)


def test_a_field_the_plant_does_not_have():
    comparison = ControllerComparison(spread_fields=("colour",))
    with pytest.raises(BadRequest, match="spread_fields"):
        comparison.perturbed_plants(motor(), seed=0)
