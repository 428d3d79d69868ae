"""A Wiener-Hammerstein system whose parts are known, as a data set: what the model class can
represent exactly."""

import numpy as np

from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.systems import StateSpace

BREAKPOINTS = np.array([[-0.4, 0.4]])
SLOPES = np.array([[1.0, 0.2, 1.0]])
SOFT_DEAD_ZONE = MonotoneScaffold(breakpoints=BREAKPOINTS, slopes=SLOPES)
ROWS_OF_A = [[0.9, 0.1], [-0.1, 0.8]]
A = np.array(ROWS_OF_A)
B = np.array([[1.0], [0.5]])
C = np.array([[0.3, 0.2]])
D = np.zeros((1, 1))
TWO_POLES = StateSpace(a=A, b=B, c=C, d=D)


def true_system() -> SSM:
    scaffold_out = LinearScaffold.identity(1)
    input_scale = np.ones(1)
    output_scale = np.ones(1)
    input_equilibrium = np.array([0.5])
    output_equilibrium = np.array([10.0])
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    return SSM(
        linear=TWO_POLES,
        scaffold_in=SOFT_DEAD_ZONE,
        scaffold_out=scaffold_out,
        scale=scale,
        step_s=0.01,
    )


def held_levels(rng: np.random.Generator, samples: int, hold: int) -> np.ndarray:
    number_of_levels = -(-samples // hold)
    levels = rng.uniform(-2, 2, size=number_of_levels)
    held = np.repeat(levels, hold)
    return held[:samples, None]


def data_set(
    noise: float = 0.0, samples: int = 400, hold: int = 8, seed: int = 0, records: int = 3
) -> DataSet:
    rng = np.random.default_rng(seed)
    system = true_system()

    def record(name: str) -> Trajectory:
        input_equilibrium = system.scale.input_equilibrium
        levels = held_levels(rng, samples, hold)
        u = levels + input_equilibrium
        y = system.simulate(u)
        white_noise = rng.normal(size=y.shape)
        measured = y + noise * white_noise
        return Trajectory(u=u, y=measured, step_s=0.01, name=name)

    training = tuple(record(f"training_{i}") for i in range(records))
    validation = (record("validation"),)
    test = (record("test"),)
    channel = Channel(name="voltage", unit="V")
    inputs = (channel,)
    channel = Channel(name="speed", unit="rad/s")
    outputs = (channel,)
    scale_input_equilibrium = system.scale.input_equilibrium
    output_equilibrium = system.scale.output_equilibrium
    input_scale = np.array([1.2])
    output_scale = np.array([3.0])
    scale = Scale(
        input_equilibrium=scale_input_equilibrium,
        output_equilibrium=output_equilibrium,
        input_scale=input_scale,
        output_scale=output_scale,
    )
    return DataSet(
        training=training,
        validation=validation,
        test=test,
        inputs=inputs,
        outputs=outputs,
        scale=scale,
    )
