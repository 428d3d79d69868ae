"""The PI that stands beside a choice: the textbook's rule on the same plant, starts and noise."""

import numpy as np
import pytest
from report_runs import random_model

from ssm_study.loop.motion import settling_times_s
from ssm_study.loop.peers.peer import replace_neurons_by_slopes
from ssm_study.loop.peers.pi import tyreus_luyben_pi
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.textbook_pi import textbook_pi_columns
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace

STEP_S = 0.1


def lag() -> SSM:
    """Two lags and no nonlinearity, in physical units of one."""
    one = np.ones(1)
    gain = np.eye(1)
    eye = LinearScaffold(gain=gain)
    a = np.array([[0.9, 0.1], [0.0, 0.8]])
    b = np.array([[0.0], [0.2]])
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    scale = Scale(
        input_scale=one, output_scale=one, input_equilibrium=0 * one, output_equilibrium=0 * one
    )
    return SSM(linear=linear, scaffold_in=eye, scaffold_out=eye, scale=scale, step_s=STEP_S)


def test_its_columns_are_those_of_the_loop_written_out() -> None:
    """`u = gain (e + i)`, `i+ = i + step / T e` by hand, sample by sample."""
    model = lag()
    plant = IdentifiedPlant.from_model(model)
    loop = LoopExperiment(
        initial_conditions=3, measurement_noise_variance=0.0
    ).with_default_horizon(model)
    facts = textbook_pi_columns(plant, model, loop, seed=1)
    pi = tyreus_luyben_pi(replace_neurons_by_slopes(model))
    y0, noise = loop.draw_starts_and_noise(plant, 1)
    times_s = []
    for start in y0:
        x = plant.equilibrium_states(start[None])[0]
        integral = 0.0
        outside = [0]
        for k in range(noise.shape[1]):
            linear_c = model.linear.c
            error = -float(linear_c[0] @ x)
            if abs(error) > plant.settling_band:
                outside.append(k + 1)
            u = pi.gain * (error + integral)
            integral += STEP_S / pi.integral_s * error
            linear_a = model.linear.a
            linear_b = model.linear.b
            x = linear_a @ x + linear_b[:, 0] * u
        times_s.append(STEP_S * outside[-1])
    assert facts["stable_count_pi"] == 3
    expected = np.mean(times_s)
    assert facts["settling_time_pi_s"] == pytest.approx(expected)


def test_it_starts_where_every_controller_starts() -> None:
    model = lag()
    plant = IdentifiedPlant.from_model(model)
    loop = LoopExperiment(initial_conditions=4).with_default_horizon(model)
    runs = loop.run_on_plant(plant, tyreus_luyben_pi(model), 7)
    times = settling_times_s(runs.rollouts_for_settling, plant.settling_band)
    settled = [time for time in times if time]
    settling_time_pi_s = textbook_pi_columns(plant, model, loop, 7)["settling_time_pi_s"]
    expected = np.mean(settled)
    assert settling_time_pi_s == pytest.approx(expected)


def test_nothing_is_said_where_the_rule_has_no_answer_or_there_is_no_plant() -> None:
    rng = np.random.default_rng(0)
    two = random_model(rng, "linear", 2)
    assert textbook_pi_columns(None, lag(), LoopExperiment(), 0) == {}
    plant = IdentifiedPlant.from_model(lag())
    assert textbook_pi_columns(plant, two, LoopExperiment(), 0) == {}
