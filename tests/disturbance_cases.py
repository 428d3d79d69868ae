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
    voltage = rng.uniform(-3, 3, SAMPLES // 10).repeat(10)
    torque = rng.uniform(0, 2, SAMPLES // 25).repeat(25)
    speed = np.zeros(SAMPLES + 1)
    for k in range(SAMPLES):
        largest = max(abs(voltage[k]) - 0.4, 0.0)
        inside = np.sign(voltage[k]) * largest
        speed[k + 1] = 0.85 * speed[k] + 0.4 * inside - 0.5 * torque[k]
    noise = 0.01 * rng.standard_normal(SAMPLES)
    columns = {"voltage": voltage, "torque": torque, "speed": speed[:-1] + noise}
    path = folder / "motor.csv"
    table = pd.DataFrame(columns)
    table.to_csv(path, index=False)
    return path


def recorded(folder: Path, **fields: object) -> RecordedData:
    """The log as the command reads it."""
    told = {"input": "voltage", "output": "speed", "step_s": STEP_S, "start_up_samples": 10}
    path = str(motor_log(folder))
    return RecordedData(path=path, **told | fields)  # type: ignore[arg-type]


def random_model(seed: int, neurons: bool, kind: str = "tanh") -> SSM | StructuredSSM:
    """One input through a bent map, one output, two measured disturbances."""
    rng = np.random.default_rng(seed)
    system = drawn(seed, radius=0.8)
    breakpoints = np.array([[-0.5, 0.7]])
    slopes = np.array([[0.5, 1.0, 0.5]])
    bent = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    input_scale = np.array([2.0])
    output_scale = np.array([0.5])
    input_equilibrium = np.array([1.0])
    output_equilibrium = np.array([3.0])
    disturbance_scale = np.array([0.3, 4.0])
    disturbance_equilibrium = np.array([20.0, -1.0])
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
    shared = {
        "scaffold_in": bent,
        "scaffold_out": scaffold_out,
        "scale": scale,
        "step_s": 0.1,
        "b_d": b_d,
    }
    if neurons:
        bias = rng.normal(size=system.neurons)
        structured_ssm_neurons = (kind, kind)
        return StructuredSSM(**vars(system), bias=bias, neurons=structured_ssm_neurons, **shared)
    linear = StateSpace(a=system.a, b=system.b, c=system.c, d=system.d)
    return SSM(linear=linear, **shared)


def far_disturbance(model: SSM | StructuredSSM, samples: int, seed: int = 1) -> np.ndarray:
    """Steps of several scales."""
    scale = model.scale
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-5, 5, (samples // 5, scale.disturbances))
    return scale.disturbance_equilibrium + scale.disturbance_scale * levels.repeat(5, axis=0)


def differences_of_loops(
    model: SSM | StructuredSSM, d: np.ndarray | None, samples: int = 80, gains: Gains | None = None
) -> np.ndarray:
    """State and estimate of two loops, one minus the other, sample by sample."""
    rng = np.random.default_rng(4)
    k = -0.1 * rng.normal(size=(1, model.order))
    l_ = -0.1 * rng.normal(size=(model.order, 1))
    neurons = isinstance(model, StructuredSSM)
    gains = gains or Gains(k=k, l=l_, l_z=np.zeros((2, 1)) if neurons else None)
    law = ObserverFeedback(model=model, gains=gains)
    x = rng.normal(size=(2, model.order))
    memory = law.initial_memory(2)
    output_equilibrium = model.scale.output_equilibrium
    reference = np.tile(output_equilibrium, (1, 1))
    plan = law.reference_targets(reference)
    target = plan[0]
    rows = []
    for sample in range(samples):
        difference = x[0] - x[1]
        rows.append(np.concatenate([difference, memory[0] - memory[1]]))
        y = model.output_at(x, np.zeros((2, 1)))
        u = law.input(memory, y, target)
        load = () if d is None else (d[sample],)
        memory = law.advance(memory, u, y, target, *load)
        x = model.advance(x, model.map_input(u)) + (
            0.0 if d is None else model.disturbance_contribution(d[sample])
        )
    return np.array(rows)
