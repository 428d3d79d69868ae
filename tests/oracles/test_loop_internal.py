"""Internal models: modes, certificate and frequency responses by two routes; loads and references
on the true motor."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import BALLS, INPUT_BALL, motor, motor_model, random_model

from ssm_study.bounds.frequency import frequency_response, largest_gains
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
from ssm_study.loop.metrics import certificate_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import Loop
from ssm_study.loop.rollout import Rollouts
from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.robustness.sensitivity import error_to_input_response, gain_peaks_on_grid
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import StateSpace

HERTZ = 0.5
STEP_S = 0.01
LOADS = {
    ("step", "sine(0.5Hz)"): PeriodicDisturbance(amplitude=0.005, frequency_hz=HERTZ),
    ("ramp",): RampDisturbance(slope_per_s=0.002, from_s=1.0, until_s=100.0),
}
TURNING = {"reference": StepReference(before=0.0, after=8.0, at_s=0.0)}
QUIET = {"initial_conditions": 1, "horizon_s": 8.0, "measurement_noise_variance": 0.0}


def made(*words: str) -> Design:
    inner = RiccatiSynthesis(
        rate_controller=0.03, rate_observer=0.2, input_weight=1.0, output_noise=0.1
    )
    changed_inner = replace(inner, integral_weight=1e-4, internal_model=words)
    return changed_inner.design(motor_model(), BALLS)


def simulated(loop: Loop, design: Design) -> Rollouts:
    law = ObserverFeedback.from_design(motor_model(), design)
    return loop.simulate(motor(), law, *loop.draw_starts_and_noise(motor(), seed=0))


def test_the_modes_are_those_of_the_signals():
    """Free, each copy makes the signals that it is for: `w[k+1] = A_z w[k]` annihilates nothing
    else."""
    words = ["sine(0.5Hz)", "ramp", "step"]
    modes = internal_model(words, STEP_S, outputs=2)
    k = np.arange(60)
    angle = 2 * np.pi * HERTZ * STEP_S
    rotation = np.exp(1j * angle)
    roots = [1, 1, rotation, np.exp(-1j * angle)]
    actual = np.poly(modes[::2, ::2])
    coefficients = np.poly(roots).real
    np.testing.assert_allclose(actual, coefficients, atol=1e-12)
    powers = [np.linalg.matrix_power(modes, int(i)) for i in k]
    free = np.stack([power[::2, ::2].sum(axis=1) for power in powers])
    cosine = np.cos(angle * k)
    sine = np.sin(angle * k)
    constant = np.ones(60)
    signals = np.stack([constant, k, cosine, sine], axis=1)
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
    assert failed_checks(design.to_json(), model.linear, BALLS, controlled) == []
    shift = 1e-6 * np.eye(len(part_.a))
    a = part_.a + shift
    state_feedback = replace(part_, a=a)
    other = replace(design, state_feedback=state_feedback)
    controlled_by_other = controlled_system(model, other.state_feedback)
    assert failed_checks(other.to_json(), model.linear, BALLS, controlled_by_other)


@pytest.mark.parametrize(("words", "load"), LOADS.items())
def test_on_the_motor_the_load_is_removed_and_without_its_mode_it_is_not(words, load):
    """Route one: the true motor at 8 rad/s."""
    left = {}
    for law in (words, ("step",)):
        loop = Loop(**QUIET, **TURNING, disturbance=load)
        run = simulated(loop, made(*law))
        difference = np.abs(run.y - run.reference)
        left[law] = difference[:, -200:].max()
    upper_limit = 1e-3 * (5 if len(words) == 2 else 1e-3)
    assert left[words] < upper_limit
    assert left[("step",)] > 0.02


def test_at_its_frequency_the_model_passes_no_load():
    """Route two: the linear loop from a load at the input to the output, at constant slopes of S_u,
    by hand."""
    model = motor_model()
    frequency = 2 * np.pi * HERTZ * STEP_S
    angle = np.array([frequency])
    passed = {}
    for words in (("step", "sine(0.5Hz)"), ("step",)):
        pair = made(*words).pair
        found = []
        n = model.order
        z = len(pair.modes)
        for slope in (INPUT_BALL.lower, INPUT_BALL.upper):
            a = model.linear.a
            b = slope * model.linear.b
            c = model.linear.c
            fed = np.ones((z, 1)) @ c
            state_loop = b @ pair.k[:, :n]
            from_modes = b @ pair.k[:, n:]
            rows = [[a, state_loop, from_modes]]
            rows += [[-pair.l @ c, a + b @ pair.k[:, :n] + pair.l @ c, b @ pair.k[:, n:]]]
            rows += [[fed, np.zeros((z, n)), pair.modes]]
            no_load_on_controller = np.zeros((n + z, 1))
            into = np.vstack([b, no_load_on_controller])
            no_output_of_controller = np.zeros((1, n + z))
            read = np.hstack([c, no_output_of_controller])
            block_matrix = np.block(rows)
            d = np.zeros((1, 1))
            loop = StateSpace(a=block_matrix, b=into, c=read, d=d)
            assert loop.spectral_radius < 1
            magnitudes = np.abs(frequency_response(loop, angle))
            largest = float(magnitudes.max())
            found.append(largest)
        passed[len(words)] = max(found)
    assert passed[2] < 1e-9
    assert passed[1] > 0.01


def test_the_margin_by_two_routes():
    model = motor_model()
    pair = made("ramp", "sine(0.5Hz)").pair
    angles = np.geomspace(1e-3, np.pi, 200)
    slopes = (INPUT_BALL.lower, INPUT_BALL.alpha, INPUT_BALL.upper)
    peaks = [
        largest_gains(error_to_input_response(model.linear, pair, slope, 1.0), angles).max()
        for slope in slopes
    ]
    by_space = max(peaks)
    ks = pair.k[None]
    ls = pair.l[None]
    by_factors = gain_peaks_on_grid(
        model.linear, ks, ls, BALLS, angles, internal_model=pair.internal
    )
    assert by_factors[0, 0] == pytest.approx(by_space, rel=1e-9)


def test_a_ramp_that_meets_a_limit_does_not_wind_up():
    """Held at the limit on the way, then free: where the loop without limits is."""
    rising = RampDisturbance(slope_per_s=2.0, from_s=1.0, until_s=4.0)
    longer = QUIET | {"horizon_s": 9.0}
    free = Loop(**longer, reference=rising)
    limited = replace(free, input_lower=-0.8, input_upper=1.6)
    loops = (limited, free)
    run, other = (simulated(loop, made("ramp")) for loop in loops)
    assert (run.u == -0.8).sum() > 3
    smallest = other.u.min()
    assert smallest < -1.0
    difference = np.abs(run.y - other.y)
    largest = difference[:, -50:].max()
    assert largest < 0.05


def test_the_certified_bound_holds_with_a_sine():
    run = Loop(initial_conditions=3, horizon_s=2.0)
    design = made("step", "sine(0.5Hz)")
    loop = run.run_design(motor(), motor_model(), design, seed=1)
    columns = certificate_columns(loop, design)
    certified_bound_violations = columns["certified_bound_violations"]
    assert certified_bound_violations == 0


def test_auto_takes_the_words_and_weighs_what_they_make():
    auto_internal_model = ("step", "sine(0.5Hz)")
    asked = Auto(internal_model=auto_internal_model)
    assert asked.modes == ("step", "sine(0.5Hz)")
    assert Auto().modes == ()
    auto = Auto(integral_weights=(1e-3,))
    modes = auto.modes
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


def test_a_mode_at_a_zero_of_the_model_is_refused():
    """`x+ = 0.9 x + ...` behind a notch at 2 Hz: nothing that the input does shows in the output
    there."""
    angle = 2 * np.pi * 2.0 * STEP_S
    poles = np.poly([0.9, 0.5, 0.3])
    cosine = np.cos(angle)
    middle = -2 * cosine
    numerator = np.array([[1.0, middle, 1.0]])
    delays = np.eye(2, 3)
    a = np.vstack([-poles[1:], delays])
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
    pair = made("ramp").pair
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
    expected = ["synthesis.internal_model=[step,'sine(0.5Hz)']", *words[1:]]
    assert quote_sines(words) == expected
    settings = {"_target_": "ssm_study.synthesis.auto.Auto", "internal_model": ["ramp"]}
    found = construct_part("synthesis", settings)
    assert found.modes == ("ramp",)
