"""A steep static curve behind a dead time, as of a titration: its records tell it from a good
plant, and what swings on it is not predicted to settle."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.adversarial.plants.titration import Titration
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.data.simulated import PERIOD, simulate_mismatch_records, simulate_sine_records
from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.sine_trials import measure_errors_at_sines, sensitive_spectral_lines
from ssm_study.signals import Scale
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.sine_judgement import sine_columns
from ssm_study.systems import StateSpace

STEEP = Titration(lag_s=1.0, height=0.3, width=0.03)
GOOD = replace(STEEP, height=0.0)
ORDER = 4
NOISE = np.sqrt(np.array(STEEP.noise_variance))
SWINGS = 0.1  # of the output's scale, without noise, after the transient


def least_squares_model(plant: Titration) -> SSM:
    """ARX model of a broadband record, in observer form and scaled to unit deviations."""
    rng = np.random.default_rng(0)
    heights = rng.uniform(-1, 1, 800)
    durations = rng.integers(1, 12, 800)
    held = np.repeat(heights, durations)[:3000, None]
    response = plant.simulate(held[None])
    y = response[1][0]
    standard_deviation = held.std()
    input_scale, output_scale = standard_deviation, y.std()
    u, y = held / input_scale, y / output_scale
    past = range(1, ORDER + 1)
    past_outputs = [y[ORDER - lag : -lag, 0] for lag in past]
    past_inputs = [u[ORDER - lag : -lag, 0] for lag in past]
    columns = past_outputs + past_inputs
    regressors = np.column_stack(columns)
    least_squares = np.linalg.lstsq(regressors, y[ORDER:, 0], rcond=None)
    weights = least_squares[0]
    a = np.eye(ORDER, k=1)
    a[:, 0] = weights[:ORDER]
    b = weights[ORDER:, None]
    c = np.eye(1, ORDER)
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    scale_input_scale = np.array([input_scale])
    scale_output_scale = np.array([output_scale])
    input_equilibrium = np.zeros(1)
    output_equilibrium = np.zeros(1)
    scale = Scale(
        input_scale=scale_input_scale,
        output_scale=scale_output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    ssm = SSM.from_linear(linear, plant.step_s)
    return replace(ssm, scale=scale)


def swing_of(plant: Titration, model: SSM, design: Design) -> float:
    """Largest output, scaled, in the last part of three loops without noise."""
    gains, linear = design.gain_pair, model.linear
    start_outputs = np.array([[0.5], [-1.0], [0.05]])
    x = plant.equilibrium_states(start_outputs)
    x_hat = np.zeros((3, ORDER))
    sizes = []
    for _ in range(400):
        y = model.scale.scaled_output(plant.output(x))
        u = x_hat @ gains.k.T
        innovation = x_hat @ linear.c.T - y
        correction = innovation @ gains.l.T
        x_hat = x_hat @ linear.a.T + u @ linear.b.T + correction
        physical_input = model.scale.physical_input(u)
        x = plant.next_states(x, physical_input, np.zeros((3, 0)))
        largest = np.abs(y).max()
        sizes.append(largest)
    largest = max(sizes[-80:])
    return float(largest)


def judged(
    plant: Titration, model: SSM, mismatch: Mismatch, input_weight: float, output_noise: float
) -> tuple[bool, float]:
    """Whether the design is predicted to be stable, sines included, and how its loop swings."""
    balls = certified_balls(model)
    request = RiccatiSynthesis(
        rate_controller=0.05,
        rate_observer=0.2,
        input_weight=input_weight,
        output_noise=output_noise,
    )
    design = request.design(model, balls)
    assert design.certified
    lines = sensitive_spectral_lines(model, design.gain_pair, balls, PERIOD)
    rng = np.random.default_rng([0, 13])
    records = simulate_sine_records(plant, rng, NOISE, lines)
    sines = measure_errors_at_sines(model, records, mismatch, PERIOD)
    facts = sine_columns(design, model, balls, mismatch, sines)
    return facts["predicted_stable"], swing_of(plant, model, design)


@pytest.fixture(scope="module", params=[STEEP, GOOD], ids=["steep", "good"])
def outcomes(request) -> tuple[Titration, list[tuple[bool, float]]]:
    plant = request.param
    model = least_squares_model(plant)
    rng = np.random.default_rng(0)
    trials = simulate_mismatch_records(plant, rng, NOISE)
    full = tuple(trial for trial in trials if trial.name == "trial_at_1")
    mismatch = measure_model_error(model, full, 0, trials)
    assert mismatch.plant_comes_to_rest
    weights = [(0.1, 0.1), (1.0, 1.0)]
    return plant, [judged(plant, model, mismatch, *pair) for pair in weights]


def test_no_design_that_swings_is_predicted(outcomes) -> None:
    _, judgements = outcomes
    assert all(swing < SWINGS for predicted, swing in judgements if predicted)
    assert any(predicted for predicted, _ in judgements)


def test_the_steep_curve_is_told_from_a_good_plant(outcomes) -> None:
    """The same designs: all predicted on the plant without the curve, some refused with it, and
    those swing."""
    plant, judgements = outcomes
    if plant is GOOD:
        assert all(predicted for predicted, _ in judgements)
    else:
        refused = [swing for predicted, swing in judgements if not predicted]
        assert len(refused) >= 1
        assert max(refused) > SWINGS
