"""Internal models: modes, certificate and frequency responses by two routes; loads and references
on the true motor."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS, INPUT_BALL, motor, motor_model, random_model

from ssm_study.bounds.frequency import frequency_response, largest_gains
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.integral_action import (
    append_internal_model,
    controlled_system,
    internal_model,
)
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.cli.request import quote_sines
from ssm_study.construction import construct_part
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import certified_bound_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.loop.rollout import Rollouts
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.robustness.sensitivity import error_to_input_response, gain_peaks_on_grid
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, StateSpace

HERTZ = 0.5
STEP_S = 0.01
SWINGING_LOAD = PeriodicDisturbance(amplitude=0.005, frequency_hz=HERTZ)
RISING_LOAD = RampDisturbance(slope_per_s=0.002, from_s=1.0, until_s=100.0)
LOADS = {("step", "sine(0.5Hz)"): SWINGING_LOAD, ("ramp",): RISING_LOAD}
STEP_UP = StepReference(before=0.0, after=8.0, at_s=0.0)
TURNING = {"reference": STEP_UP}
QUIET = {"initial_conditions": 1, "horizon_s": 8.0, "measurement_noise_variance": 0.0}


def made(*words: str) -> Design:
    inner = RiccatiSynthesis(
        rate_controller=0.03, rate_observer=0.2, input_weight=1.0, output_noise=0.1
    )
    changed_inner = replace(inner, integral_weight=1e-4, internal_model=words)
    return changed_inner.design(motor_model(), BALLS)


def simulated(loop: LoopExperiment, design: Design) -> Rollouts:
    law = ObserverFeedback.from_design(motor_model(), design)
    starts_and_noise = loop.draw_starts_and_noise(motor(), seed=0)
    return loop.simulate(motor(), law, *starts_and_noise)


def test_the_modes_are_those_of_the_signals():
    """Free, each copy makes the signals that it is for: `w[k+1] = A_z w[k]` annihilates nothing
    else."""
    words = ["sine(0.5Hz)", "ramp", "step"]
    modes = internal_model(words, STEP_S, outputs=2)
    k = np.arange(60)
    whole_turn = 2 * np.pi
    angle = whole_turn * HERTZ * STEP_S
    rotation = np.exp(1j * angle)
    opposite_rotation = np.exp(-1j * angle)
    roots = [1, 1, rotation, opposite_rotation]
    modes_of_one_output = modes[::2, ::2]
    actual = np.poly(modes_of_one_output)
    coefficients = np.poly(roots).real
    np.testing.assert_allclose(actual, coefficients, atol=1e-12)
    free_signals = []
    for i in k:
        power = np.linalg.matrix_power(modes, int(i))
        free_signals.append(power[::2, ::2].sum(axis=1))
    free = np.stack(free_signals)
    cosine = np.cos(angle * k)
    sine = np.sin(angle * k)
    constant = np.ones(60)
    columns = [constant, k, cosine, sine]
    signals = np.stack(columns, axis=1)
    least_squares = np.linalg.lstsq(signals, free, rcond=None)
    fitted = signals @ least_squares[0]
    difference = np.abs(fitted - free)
    largest_difference = difference.max()
    assert largest_difference < 1e-9
    rank = np.linalg.matrix_rank(free)
    assert rank == 4


@pytest.mark.parametrize("words", LOADS)
def test_the_certificate_is_the_theorem_on_the_augmented_pair(words):
    design = made(*words)
    model = motor_model()
    part_ = design.state_feedback
    system = append_internal_model(model, words)
    np.testing.assert_array_equal(part_.a, system.a)
    names = ("rate", "p", "y", "k", "sigma")
    numbers = {name: getattr(part_, name) for name in names}
    assert part_.certified
    assert StateFeedbackOfBall.holds(
        a=system.a, b=system.b, alpha=INPUT_BALL.alpha, beta=INPUT_BALL.beta, **numbers
    )
    controlled = controlled_system(model, part_)
    document = design.to_json()
    broken = failed_checks(document, model.linear, BALLS, controlled)
    assert broken == []
    shift = 1e-6 * np.eye(len(part_.a))
    a = part_.a + shift
    state_feedback = replace(part_, a=a)
    other = replace(design, state_feedback=state_feedback)
    controlled_by_other = controlled_system(model, other.state_feedback)
    document_of_other = other.to_json()
    assert failed_checks(document_of_other, model.linear, BALLS, controlled_by_other)


@pytest.mark.parametrize(("words", "load"), LOADS.items())
def test_on_the_motor_the_load_is_removed_and_without_its_mode_it_is_not(words, load):
    """Route one: the true motor at 8 rad/s."""
    left = {}
    laws = (words, ("step",))
    for law in laws:
        loop = LoopExperiment(**QUIET, **TURNING, disturbance=load)
        designed = made(*law)
        run = simulated(loop, designed)
        error = run.y - run.reference
        difference = np.abs(error)
        last_errors = difference[:, -200:]
        left[law] = last_errors.max()
    upper_limit = 1e-3 * (5 if len(words) == 2 else 1e-3)
    assert left[words] < upper_limit
    assert left[("step",)] > 0.02


def load_to_output(model: SSM, pair: Gains, slope: float) -> StateSpace:
    """The linear loop of plant, observer and internal model, from a load at the input to the
    output."""
    n = model.order
    z = len(pair.modes)
    a = model.linear.a
    b = slope * model.linear.b
    c = model.linear.c
    from_estimate = b @ pair.k[:, :n]
    from_modes = b @ pair.k[:, n:]
    injected = pair.l @ c
    observer_loop = a + from_estimate + injected
    fed = np.ones((z, 1)) @ c
    no_coupling = np.zeros((z, n))
    plant_row = [a, from_estimate, from_modes]
    observer_row = [-injected, observer_loop, from_modes]
    modes_row = [fed, no_coupling, pair.modes]
    loop_matrix = np.block([plant_row, observer_row, modes_row])
    no_load_on_controller = np.zeros((n + z, 1))
    into = np.vstack([b, no_load_on_controller])
    no_output_of_controller = np.zeros((1, n + z))
    read = np.hstack([c, no_output_of_controller])
    d = np.zeros((1, 1))
    return StateSpace(a=loop_matrix, b=into, c=read, d=d)


def test_at_its_frequency_the_model_passes_no_load():
    """Route two: the linear loop from a load at the input to the output, at constant slopes of S_u,
    by hand."""
    model = motor_model()
    whole_turn = 2 * np.pi
    frequency = whole_turn * HERTZ * STEP_S
    angle = np.array([frequency])
    passed = {}
    internal_models = (("step", "sine(0.5Hz)"), ("step",))
    for words in internal_models:
        pair = made(*words).gain_pair
        gains = []
        slopes = (INPUT_BALL.lower, INPUT_BALL.upper)
        for slope in slopes:
            loop = load_to_output(model, pair, slope)
            assert loop.spectral_radius < 1
            response = frequency_response(loop, angle)
            magnitudes = np.abs(response)
            largest = float(magnitudes.max())
            gains.append(largest)
        passed[len(words)] = max(gains)
    assert passed[2] < 1e-9
    assert passed[1] > 0.01


def test_the_margin_by_two_routes():
    model = motor_model()
    pair = made("ramp", "sine(0.5Hz)").gain_pair
    angles = np.geomspace(1e-3, np.pi, 200)
    slopes = (INPUT_BALL.lower, INPUT_BALL.alpha, INPUT_BALL.upper)
    peaks = []
    for slope in slopes:
        response = error_to_input_response(model.linear, pair, slope, 1.0)
        peaks.append(largest_gains(response, angles).max())
    by_space = max(peaks)
    ks = pair.k[None]
    ls = pair.l[None]
    by_factors = gain_peaks_on_grid(
        model.linear, ks, ls, BALLS, angles, internal_model=pair.internal
    )
    peak_by_factors = by_factors[0, 0]
    expected_peak = pytest.approx(by_space, rel=1e-9)
    assert peak_by_factors == expected_peak


def test_a_ramp_that_meets_a_limit_does_not_wind_up():
    """Held at the limit on the way, then free: where the loop without limits is."""
    rising = RampDisturbance(slope_per_s=2.0, from_s=1.0, until_s=4.0)
    longer = QUIET | {"horizon_s": 9.0}
    free = LoopExperiment(**longer, reference=rising)
    limited = replace(free, input_lower=-0.8, input_upper=1.6)
    loops = (limited, free)
    run, other = (simulated(loop, made("ramp")) for loop in loops)
    at_the_limit = run.u == -0.8
    samples_at_the_limit = at_the_limit.sum()
    assert samples_at_the_limit > 3
    smallest = other.u.min()
    assert smallest < -1.0
    error = run.y - other.y
    difference = np.abs(error)
    last_errors = difference[:, -50:]
    largest = last_errors.max()
    assert largest < 0.05


def test_the_certified_bound_holds_with_a_sine():
    run = LoopExperiment(initial_conditions=3, horizon_s=2.0)
    design = made("step", "sine(0.5Hz)")
    loop = run.run_design(motor(), motor_model(), design, seed=1)
    columns = certified_bound_columns(loop, design)
    certified_bound_violations = columns["certified_bound_violations"]
    assert certified_bound_violations == 0


def test_auto_takes_the_words_and_weighs_what_they_make():
    auto_internal_model = ("step", "sine(0.5Hz)")
    auto_with_sine = Auto(internal_model=auto_internal_model)
    assert auto_with_sine.internal_model_signals == ("step", "sine(0.5Hz)")
    assert Auto().internal_model_signals == ()
    auto = Auto(integral_weights=(1e-3,))
    modes = auto.internal_model_signals
    assert modes == ("step",)


REFUSED_WORDS = [
    "sine",
    "sine(0.5)",
    "sine(0Hz)",
    "cosine(1Hz)",
    "Step",
    "",
    "sine(-1Hz)",
    "sine(1e9Hz)x",
]


@pytest.mark.parametrize("word", REFUSED_WORDS)
def test_a_word_that_is_no_internal_model_is_refused(word):
    auto_internal_model = ("step", word)
    with pytest.raises(
        BadRequest, match="is no internal model; use step, ramp, or a sine such as sine"
    ):
        Auto(internal_model=auto_internal_model)


def test_a_sine_beyond_half_the_sampling_rate_is_refused():
    with pytest.raises(BadRequest, match="half the sampling rate is 50 Hz"):
        made("sine(50Hz)")


def test_an_internal_model_needs_a_linear_output_map():
    """The modes are driven by what S_y maps: behind a bend they would be no part of the model."""
    lag = StateSpace(a=0.5 * np.eye(1), b=np.eye(1), c=np.eye(1), d=np.zeros((1, 1)))
    model = SSM.from_linear(lag, 0.1)
    breakpoints = np.array([[-1.0, 1.0]])
    slopes = np.array([[0.8, 1.0, 0.9]])
    output_map = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    bent = replace(model, scaffold_out=output_map)
    rates = {"rate_controller": 0.1, "rate_observer": 0.1}
    synthesis = RiccatiSynthesis(**rates, internal_model=["step"])
    assert synthesis.design(model, certified_balls(model)).certified
    with pytest.raises(BadRequest, match="needs a linear output map"):
        synthesis.design(bent, certified_balls(bent))


def test_a_mode_at_a_zero_of_the_model_is_refused():
    """`x+ = 0.9 x + ...` behind a notch at 2 Hz: nothing that the input does shows in the output
    there."""
    whole_turn = 2 * np.pi
    angle = whole_turn * 2.0 * STEP_S
    roots = [0.9, 0.5, 0.3]
    poles = np.poly(roots)
    cosine = np.cos(angle)
    middle = -2 * cosine
    numerator = np.array([[1.0, middle, 1.0]])
    delays = np.eye(2, 3)
    rows_of_a = [-poles[1:], delays]
    a = np.vstack(rows_of_a)
    b = np.eye(3, 1)
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=numerator, d=d)
    model = replace(random_model(0), linear=linear, step_s=STEP_S)
    system = append_internal_model(model, ["sine(2.1Hz)"])
    order = system.order
    assert order == 5
    words = ["step", "sine(2Hz)"]
    with pytest.raises(BadRequest, match=r"at 2 Hz the model passes .* leave this mode out"):
        append_internal_model(model, words)


def test_a_gain_of_another_internal_model_is_refused():
    pair = made("ramp").gain_pair
    internal = np.eye(3)
    changed_pair = replace(pair, internal=internal)
    with pytest.raises(BadRequest, match=r"needs a gain of shape \(1, 5\)"):
        ObserverFeedback(model=motor_model(), gains=changed_pair)


def test_the_command_takes_a_sine_without_quotes():
    words = [
        "synthesis.internal_model=[step,sine(0.5Hz)]",
        'synthesis.internal_model=["sine(1Hz)"]',
        "seed=range(3)",
    ]
    other_words = words[1:]
    expected = ["synthesis.internal_model=[step,'sine(0.5Hz)']", *other_words]
    assert quote_sines(words) == expected
    settings = {"_target_": "ssm_study.synthesis.auto.Auto", "internal_model": ["ramp"]}
    part = construct_part("synthesis", settings)
    assert part.internal_model_signals == ("ramp",)
