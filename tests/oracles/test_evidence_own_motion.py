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
from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT, EvidenceCase
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
    first_row = [cosine, -sine]
    second_row = [sine, cosine]
    rotation = np.array([first_row, second_row])
    turn = radius * rotation
    column = [[0.0], [0.1]]
    b = np.array(column)
    row = [1.0, 0.0]
    c = np.array([row])
    d = np.zeros((1, 1))
    return StateSpace(a=turn, b=b, c=c, d=d)


def integrating(pole: float) -> StateSpace:
    unit = np.ones((1, 1))
    return StateSpace(a=pole * unit, b=0.1 * unit, c=unit, d=0 * unit)


def case(y: np.ndarray, system: StateSpace, cut=split_by_time, log: int = 1) -> EvidenceCase:
    u = U[:, None]
    outputs = y[:, None]
    record = Trajectory(u=u, y=outputs, step_s=0.1, log=log)
    is_in_blocks = cut is split_into_blocks
    parts = split_into_blocks(record) if is_in_blocks else split_by_time(record, 0.2, 0.2)
    channels = tuple((Channel(name=name, unit=""),) for name in "uy")
    input_equilibrium = np.zeros(1)
    output_equilibrium = np.zeros(1)
    rest = (input_equilibrium, output_equilibrium)
    data = assemble_dataset(parts, rest, channels, SKIP)
    model = replace(linear_model(0), linear=system)
    names = ("validation", "test")
    free = {}
    for name in names:
        free[name] = Simulation.simulate_records(model, getattr(data, name), SKIP)
    return EvidenceCase(data=data, model=model, **free)


def measured(system: StateSpace, noise: float, start: np.ndarray) -> np.ndarray:
    inputs = U[:, None]
    response = system.simulate(inputs, start)
    y = response[0][:, 0]
    standard_deviation = np.std(y)
    white_noise = RNG.standard_normal(SAMPLES)
    return y + noise * standard_deviation * white_noise


def drifting_phase(noise: float) -> np.ndarray:
    """A swing of constant size whose phase walks: no input says where it is."""
    white_noise = RNG.standard_normal(SAMPLES)
    running_sum = np.cumsum(0.08 * white_noise)
    samples = np.arange(SAMPLES)
    steady_phase = ANGLE * samples
    phase = steady_phase + running_sum
    cosine = np.cos(phase)
    white_noise = RNG.standard_normal(SAMPLES)
    return cosine + noise * white_noise


CUTS = [split_by_time, split_into_blocks]
NOISES = [0.0, 0.1]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("noise", NOISES)
def test_a_swing_that_goes_on_by_itself_cannot_be_judged(cut, noise):
    log = case(drifting_phase(noise), swinging(0.9995), cut)
    (finding,) = own_motion.judge_autonomous_motion(log)
    assert finding.level == "cannot judge"
    assert "it moves by itself" in finding.sentence


@pytest.mark.parametrize("cut", CUTS)
def test_a_steady_swing_is_not_taken_for_the_inputs_because_the_model_carries_its_phase(cut):
    """An undamped model predicts it from the state in which the log begins."""
    samples = np.arange(SAMPLES)
    phase = ANGLE * samples
    y = np.cos(phase)
    log = case(y, swinging(0.99995), cut)
    (finding,) = own_motion.judge_autonomous_motion(log)
    assert finding.level == "cannot judge"
    assert "it moves by itself" in finding.sentence


MORE_NOISES = [0.0, 0.1, 1.5]
RADII = [0.9, 0.99, 0.9995]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("noise", MORE_NOISES)
@pytest.mark.parametrize("radius", RADII)
def test_a_resonance_that_the_input_moves_is_judged_however_noisy(radius, noise, cut):
    system = swinging(radius)
    offset = np.array([3.0, 0.0])
    noisy = measured(system, noise, offset)
    judged = case(noisy, system, cut)
    assert own_motion.judge_autonomous_motion(judged) == []
    findings = feedback.judge_feedback(judged)
    levels = [finding.level for finding in findings]
    assert "cannot judge" not in levels


POLES = [0.999, 1.0]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("pole", POLES)
def test_what_integrates_keeps_an_offset_and_is_judged(pole, cut):
    offset = np.array([10.0])
    y = measured(integrating(pole), 0.02, offset)
    judged = case(y, integrating(0.9995), cut)
    assert own_motion.judge_autonomous_motion(judged) == []
    findings = feedback.judge_feedback(judged)
    levels = [finding.level for finding in findings]
    assert "cannot judge" not in levels


def test_the_walk_of_an_integrator_is_taken_for_growth_once_in_a_hundred():
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        white_noise = rng.standard_normal(SAMPLES)
        steps = 0.1 * U + white_noise
        walk = np.cumsum(steps)
        walking_case = case(walk, integrating(0.999))
        data = walking_case.data
        findings = feedback.judge_instability(data, is_closed_loop=False)
        refusals = [finding for finding in findings if finding.level == "cannot judge"]
        refused += len(refusals)
    assert refused <= 3


GROWING = [(1.002, True), (1.004, True), (1.0005, False)]


@pytest.mark.parametrize(("pole", "refused"), GROWING)
def test_what_grows_is_refused_once_the_log_is_long_enough_to_show_it(pole, refused):
    start = np.zeros(1)
    y = measured(integrating(pole), 0.01, start)
    log = case(y, integrating(0.999), split_into_blocks)
    findings = feedback.judge_feedback(log)
    sentences = [finding.sentence for finding in findings]
    runs_away = any("runs away by itself (a mode at 1.00" in sentence for sentence in sentences)
    assert runs_away == refused


SHARES = [(0.0, 1.0), (0.5, 0.8)]


@pytest.mark.parametrize(("noise", "share"), SHARES)
def test_of_a_plant_that_the_input_moves_both_runs_predict_all_but_the_noise(noise, share):
    system = swinging(0.9)
    start = np.zeros(2)
    noisy = measured(system, noise, start)
    log = case(noisy, system)
    shares = own_motion.predicted_power_shares(log)
    expected = (share, share)
    tolerance = 0.1 if noise else 1e-4
    expected_shares = pytest.approx(expected, abs=tolerance)
    assert shares == expected_shares


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
