"""An output that moves by itself against one that the input moves, each judged beside a model that
fits its pieces."""

from dataclasses import replace

import numpy as np
import pytest
from test_loop_prediction import linear_model

from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.splits import split_by_time, split_into_blocks
from ssm_study.evidence import autonomous_motion as own_motion
from ssm_study.evidence import feedback
from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT, Case
from ssm_study.evidence.metrics import NO_JUDGEMENT, withhold_predictions
from ssm_study.models.metrics import Simulation
from ssm_study.signals import Channel, Trajectory
from ssm_study.systems import StateSpace

SAMPLES = 1500
SKIP = 20
ANGLE = 0.1
RNG = np.random.default_rng(0)
LEVELS = RNG.uniform(-1, 1, 300)
U = LEVELS.repeat(5)


def swinging(radius: float) -> StateSpace:
    """A resonance at `ANGLE` a sample whose swing keeps `radius` of itself."""
    cosine = np.cos(ANGLE)
    sine = np.sin(ANGLE)
    second_row = [np.sin(ANGLE), np.cos(ANGLE)]
    turn = radius * np.array([[cosine, -sine], second_row])
    b = np.array([[0.0], [0.1]])
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    return StateSpace(a=turn, b=b, c=c, d=d)


def integrating(pole: float) -> StateSpace:
    one = np.ones((1, 1))
    return StateSpace(a=pole * one, b=0.1 * one, c=one, d=0 * one)


def case(y: np.ndarray, system: StateSpace, cut=split_by_time, log: int = 1) -> Case:
    u = U[:, None]
    record = Trajectory(u=u, y=y[:, None], step_s=0.1, log=log)
    parts = (
        split_into_blocks(record) if cut is split_into_blocks else split_by_time(record, 0.2, 0.2)
    )
    channels = tuple((Channel(name=name, unit=""),) for name in "uy")
    rest = (np.zeros(1), np.zeros(1))
    data = assemble_dataset(parts, rest, channels, SKIP)
    model = replace(linear_model(0), linear=system)
    names = ("validation", "test")
    free = {name: Simulation.simulate_records(model, getattr(data, name), SKIP) for name in names}
    return Case(data=data, model=model, **free)


def measured(system: StateSpace, noise: float, start: np.ndarray) -> np.ndarray:
    response = system.simulate(U[:, None], start)
    y = response[0][:, 0]
    standard_deviation = np.std(y)
    white_noise = RNG.standard_normal(SAMPLES)
    return y + noise * standard_deviation * white_noise


def drifting_phase(noise: float) -> np.ndarray:
    """A swing of constant size whose phase walks: no input says where it is."""
    white_noise = RNG.standard_normal(SAMPLES)
    running_sum = np.cumsum(0.08 * white_noise)
    phase = ANGLE * np.arange(SAMPLES) + running_sum
    cosine = np.cos(phase)
    white_noise = RNG.standard_normal(SAMPLES)
    return cosine + noise * white_noise


@pytest.mark.parametrize("cut", [split_by_time, split_into_blocks])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_swing_that_goes_on_by_itself_cannot_be_judged(cut, noise):
    log = case(drifting_phase(noise), swinging(0.9995), cut)
    (found,) = own_motion.judge_autonomous_motion(log)
    assert found.level == "cannot judge"
    assert "it moves by itself" in found.sentence


@pytest.mark.parametrize("cut", [split_by_time, split_into_blocks])
def test_a_steady_swing_is_not_taken_for_the_inputs_because_the_model_carries_its_phase(cut):
    """An undamped model predicts it from the state in which the log begins."""
    y = np.cos(ANGLE * np.arange(SAMPLES))
    log = case(y, swinging(0.99995), cut)
    (found,) = own_motion.judge_autonomous_motion(log)
    assert found.level == "cannot judge"
    assert "it moves by itself" in found.sentence


@pytest.mark.parametrize("cut", [split_by_time, split_into_blocks])
@pytest.mark.parametrize("noise", [0.0, 0.1, 1.5])
@pytest.mark.parametrize("radius", [0.9, 0.99, 0.9995])
def test_a_resonance_that_the_input_moves_is_judged_however_noisy(radius, noise, cut):
    system = swinging(radius)
    offset = np.array([3.0, 0.0])
    judged = case(measured(system, noise, offset), system, cut)
    assert own_motion.judge_autonomous_motion(judged) == []
    assert not [found for found in feedback.judge_feedback(judged) if found.level == "cannot judge"]


@pytest.mark.parametrize("cut", [split_by_time, split_into_blocks])
@pytest.mark.parametrize("pole", [0.999, 1.0])
def test_what_integrates_keeps_an_offset_and_is_judged(pole, cut):
    y = measured(integrating(pole), 0.02, np.array([10.0]))
    judged = case(y, integrating(0.9995), cut)
    assert own_motion.judge_autonomous_motion(judged) == []
    assert not [found for found in feedback.judge_feedback(judged) if found.level == "cannot judge"]


def test_the_walk_of_an_integrator_is_taken_for_growth_once_in_a_hundred():
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        white_noise = rng.standard_normal(SAMPLES)
        walk = np.cumsum(0.1 * U + white_noise)
        data = case(walk, integrating(0.999)).data
        found = feedback.judge_instability(data, is_closed_loop=False)
        refused += len([finding for finding in found if finding.level == "cannot judge"])
    assert refused <= 3


@pytest.mark.parametrize(("pole", "refused"), [(1.002, True), (1.004, True), (1.0005, False)])
def test_what_grows_is_refused_once_the_log_is_long_enough_to_show_it(pole, refused):
    y = measured(integrating(pole), 0.01, np.zeros(1))
    log = case(y, integrating(0.999), split_into_blocks)
    found = [one.sentence for one in feedback.judge_feedback(log)]
    assert any("runs away by itself (a mode at 1.00" in one for one in found) == refused


@pytest.mark.parametrize(("noise", "share"), [(0.0, 1.0), (0.5, 0.8)])
def test_of_a_plant_that_the_input_moves_both_runs_predict_all_but_the_noise(noise, share):
    system = swinging(0.9)
    log = case(measured(system, noise, np.zeros(2)), system)
    found = own_motion.predicted_power_shares(log)
    expected = (share, share)
    assert found == pytest.approx(expected, abs=0.1 if noise else 1e-4)


def test_pieces_of_no_common_log_say_nothing():
    judged = case(drifting_phase(0.0), swinging(0.9995), log=0)
    assert own_motion.predicted_power_shares(judged) is None
    assert own_motion.judge_autonomous_motion(judged) == []


def test_of_records_that_cannot_be_judged_no_coverage_is_claimed():
    facts = {"coverage": 1.66, "coverage_needed": 0.9, "predicted_stable": True}
    assert withhold_predictions(facts, DOUBT) == facts
    withheld = withhold_predictions(facts, CANNOT_JUDGE)
    assert withheld["coverage"] is None
    assert withheld["coverage_needed"] is None
    assert withheld["coverage_reason"] == NO_JUDGEMENT
    assert withheld["predicted_stable"] is None


def test_what_neither_run_predicts_may_be_moved_by_something_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Short pieces at rest: both runs miss more than there is."""
    judged = case(drifting_phase(0.0), swinging(0.9995))
    monkeypatch.setattr(own_motion, "predicted_power_shares", lambda _: (-0.2, -1.5))
    (found,) = own_motion.judge_autonomous_motion(judged)
    assert found.level == "cannot judge"
    assert found.sentence.startswith("Neither the input nor where each piece begins predicts")
