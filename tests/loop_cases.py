"""A grey-box model of the motor and its balls: what the loop's tests close the loop with, without
any training."""

from functools import cache
from pathlib import Path

import numpy as np
import yaml

from ssm_study.certificates.certificate import Design
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.plants.dc_motor import DCMotor
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.signals import Scale, Trajectory
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

INPUT_BALL = JacobianBall.from_slopes(0.12, 1.0)
OUTPUT_BALL = JacobianBall(alpha=1.0, beta=0.0)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)


def flat(by_frequency: np.ndarray, gain: float) -> Mismatch:
    """One view of which only sizes are known."""
    none = np.zeros(len(ANGLES), dtype=complex)
    view = ModelErrorAtAmplitude(
        amplitude=1.0, gain=gain, by_frequency=by_frequency, linear=none, rest=by_frequency
    )
    views = (view,)
    return Mismatch(views=views)


@cache
def motor() -> DCMotor:
    repository = Path(__file__).parents[1]
    dc_motor_path = repository / "conf" / "plant" / "dc_motor.yaml"
    text = dc_motor_path.read_text()
    values = yaml.safe_load(text)
    settings = values.items()
    parameters = {name: value for name, value in settings if name != "_target_"}
    return DCMotor(**parameters)


@cache
def motor_model() -> SSM:
    """Second order, dead-zone and friction as one flat piece of S_u; least squares on
    `motor_record`, 84 % fit."""
    rows_of_a = [[0.973, 0.1], [0.0, -0.495]]
    a = np.array(rows_of_a)
    column_of_b = [[0.04], [0.44]]
    b = np.array(column_of_b)
    row_of_c = [1.0, 0.0]
    c = np.array([row_of_c])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    row_of_breakpoints = [-0.39, 0.39]
    breakpoints = np.array([row_of_breakpoints])
    row_of_slopes = [1.0, 0.12, 1.0]
    slopes = np.array([row_of_slopes])
    scaffold_in = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    gain = np.eye(1)
    scaffold_out = LinearScaffold(gain=gain)
    input_scale = np.array([1.7])
    output_scale = np.array([5.0])
    input_equilibrium = np.zeros(1)
    output_equilibrium = np.zeros(1)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    return SSM(
        linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out, scale=scale, step_s=0.01
    )


@cache
def motor_record() -> Trajectory:
    """Levels held for 2 to 30 samples, noise of variance 0.02: a validation record as the study
    draws them."""
    rng = np.random.default_rng(3)
    levels = rng.uniform(-3, 3, 120)
    holds = rng.integers(2, 30, 120)
    held_levels = np.repeat(levels, holds)
    u = held_levels[:800, None]
    response = motor().simulate(u[None])
    y = response[1][0]
    white_noise = rng.standard_normal(y.shape)
    standard_deviation = np.sqrt(0.02)
    noise = standard_deviation * white_noise
    return Trajectory(u=u, y=y + noise, step_s=0.01)


@cache
def motor_design() -> Design:
    synthesis = RiccatiSynthesis(
        rate_controller=0.03, rate_observer=0.2, input_weight=0.1, output_noise=0.1
    )
    model = motor_model()
    state_feedback = synthesis.state_feedback(model.linear, INPUT_BALL)
    observer = synthesis.observer(model.linear, OUTPUT_BALL)
    return Design(state_feedback=state_feedback, observer=observer)


def random_model(seed: int, *, inputs: int = 1, outputs: int = 1, order: int = 4) -> SSM:
    """A stable random model with slopes in [0.5, 1] and unequal scales, away from the origin."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    drawn_radius = rng.uniform(0.5, 0.97)
    factor = drawn_radius / spectral_radius
    a *= factor
    drawn_points = rng.uniform(-1, 1, (inputs, 3))
    breakpoints = np.sort(drawn_points, axis=1)
    b = rng.standard_normal((order, inputs))
    c = rng.standard_normal((outputs, order))
    d = np.zeros((outputs, inputs))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    slopes = rng.uniform(0.5, 1.0, (inputs, 4))
    scaffold_in = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    scaffold_out = LinearScaffold.identity(outputs)
    input_scale = rng.uniform(0.5, 2, inputs)
    output_scale = rng.uniform(0.5, 5, outputs)
    input_equilibrium = rng.standard_normal(inputs)
    output_equilibrium = rng.standard_normal(outputs)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    return SSM(
        linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out, scale=scale, step_s=0.01
    )
