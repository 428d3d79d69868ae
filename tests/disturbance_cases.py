"""A motor whose load torque is measured, as a log."""

from pathlib import Path

import numpy as np
import pandas as pd
from structured_cases import drawn

from ssm_study.data.recorded import RecordedData
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.structured import StructuredSSM
from ssm_study.signals import Scale
from ssm_study.systems import Gains, StateSpace

STEP_S = 0.05
SAMPLES = 900


def motor_log(folder: Path) -> Path:
    """A motor with a dead zone under a voltage and a load torque that change on their own."""
    rng = np.random.default_rng(0)
    voltages = rng.uniform(-3, 3, SAMPLES // 10)
    voltage = voltages.repeat(10)
    torques = rng.uniform(0, 2, SAMPLES // 25)
    torque = torques.repeat(25)
    speed = np.zeros(SAMPLES + 1)
    for k in range(SAMPLES):
        beyond_the_zone = max(abs(voltage[k]) - 0.4, 0.0)
        inside = np.sign(voltage[k]) * beyond_the_zone
        driven = 0.85 * speed[k] + 0.4 * inside
        load = 0.5 * torque[k]
        speed[k + 1] = driven - load
    noise = 0.01 * rng.standard_normal(SAMPLES)
    noisy_speed = speed[:-1] + noise
    columns = {"voltage": voltage, "torque": torque, "speed": noisy_speed}
    path = folder / "motor.csv"
    table = pd.DataFrame(columns)
    table.to_csv(path, index=False)
    return path


def recorded(folder: Path, **fields: object) -> RecordedData:
    """The log as the command reads it."""
    settings = {"input": "voltage", "output": "speed", "step_s": STEP_S, "start_up_samples": 10}
    path = str(motor_log(folder))
    return RecordedData(path=path, **settings | fields)  # type: ignore[arg-type]


def random_model(seed: int, neurons: bool, kind: str = "tanh") -> SSM | StructuredSSM:
    """One input through a bent map, one output, two measured disturbances."""
    rng = np.random.default_rng(seed)
    system = drawn(seed, radius=0.8)
    row_of_breakpoints = [[-0.5, 0.7]]
    breakpoints = np.array(row_of_breakpoints)
    row_of_slopes = [[0.5, 1.0, 0.5]]
    slopes = np.array(row_of_slopes)
    bent = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    input_scale = np.array([2.0])
    output_scale = np.array([0.5])
    input_equilibrium = np.array([1.0])
    output_equilibrium = np.array([3.0])
    scales = [0.3, 4.0]
    disturbance_scale = np.array(scales)
    equilibria = [20.0, -1.0]
    disturbance_equilibrium = np.array(equilibria)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
        disturbance_scale=disturbance_scale,
        disturbance_equilibrium=disturbance_equilibrium,
    )
    scaffold_out = LinearScaffold.identity(1)
    b_d = rng.normal(size=(system.order, 2))
    common_parts = {
        "scaffold_in": bent,
        "scaffold_out": scaffold_out,
        "scale": scale,
        "step_s": 0.1,
        "b_d": b_d,
    }
    if neurons:
        bias = rng.normal(size=system.neurons)
        structured_ssm_neurons = (kind, kind)
        return StructuredSSM(
            **vars(system), bias=bias, neurons=structured_ssm_neurons, **common_parts
        )
    linear = StateSpace(a=system.a, b=system.b, c=system.c, d=system.d)
    return SSM(linear=linear, **common_parts)


def far_disturbance(model: SSM | StructuredSSM, samples: int, seed: int = 1) -> np.ndarray:
    """Steps of several scales."""
    scale = model.scale
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-5, 5, (samples // 5, scale.disturbances))
    held_levels = levels.repeat(5, axis=0)
    deviation = scale.disturbance_scale * held_levels
    return scale.disturbance_equilibrium + deviation


def differences_of_loops(
    model: SSM | StructuredSSM, d: np.ndarray | None, samples: int = 80, gains: Gains | None = None
) -> np.ndarray:
    """State and estimate of two loops, one minus the other, sample by sample."""
    rng = np.random.default_rng(4)
    row = rng.normal(size=(1, model.order))
    k = -0.1 * row
    column = rng.normal(size=(model.order, 1))
    l_ = -0.1 * column
    neurons = isinstance(model, StructuredSSM)
    gains = gains or Gains(k=k, l=l_, l_z=np.zeros((2, 1)) if neurons else None)
    law = ObserverFeedback(model=model, gains=gains)
    x = rng.normal(size=(2, model.order))
    memory = law.initial_memory(2)
    output_equilibrium = model.scale.output_equilibrium
    reference = np.tile(output_equilibrium, (1, 1))
    plan = law.target_trajectory(reference)
    target = plan[0]
    rows = []
    for sample in range(samples):
        difference = x[0] - x[1]
        difference_of_memory = memory[0] - memory[1]
        both = [difference, difference_of_memory]
        rows.append(np.concatenate(both))
        no_input = np.zeros((2, 1))
        y = model.output_at(x, no_input)
        u = law.input(memory, y, target)
        load = () if d is None else (d[sample],)
        memory = law.next_memory(memory, u, y, target, *load)
        mapped_input = model.map_input(u)
        x = model.next_state(x, mapped_input)
        if d is not None:
            x = x + model.disturbance_contribution(d[sample])
    return np.array(rows)
