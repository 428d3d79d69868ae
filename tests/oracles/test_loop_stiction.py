"""A plant with stiction comes to rest under a stable controller alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from loop_cases import motor_model

from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.plants.stribeck_drive import StribeckDrive
from ssm_study.robustness.sensitivity import controller_spectral_radius
from ssm_study.signals import Scale
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

UNIT_SLOPE = JacobianBall(alpha=1.0, beta=0.0)
ONES = JacobianBalls(input=UNIT_SLOPE, output=UNIT_SLOPE)


def drive() -> StribeckDrive:
    conf_path = Path(__file__).parents[2] / "conf"
    plant_path = conf_path / "plant"
    stribeck_drive_path = plant_path / "stribeck_drive.yaml"
    text = stribeck_drive_path.read_text()
    values = yaml.safe_load(text)
    return StribeckDrive(**{name: value for name, value in values.items() if name != "_target_"})


def drive_model() -> SSM:
    """The drive without friction, exact but for it: the current's lag, then the inertia."""
    plant = drive()
    h = drive().step_s
    lag = np.exp(-h / plant.current_lag_s)
    slip = np.exp(-h * plant.viscous_nms_per_rad / plant.inertia_kgm2)
    pushed = plant.torque_constant_nm_per_a * h / plant.inertia_kgm2
    gain = np.eye(1)
    identity = LinearScaffold(gain=gain)
    a = np.array([[lag, 0.0], [pushed, slip]])
    b = np.array([[1 - lag], [0.0]])
    c = np.array([[0.0, 1.0]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    return replace(
        motor_model(),
        linear=linear,
        scaffold_in=identity, scaffold_out=identity, scale=Scale.identity(1, 1),
    )  # fmt: skip


@pytest.mark.parametrize("stable", [True, False])
def test_a_plant_with_stiction_comes_to_rest_only_under_a_stable_controller(stable):
    """Both designs are certified for the model. From rest, with an estimate off by a millionth:
    friction holds the drive, so the controller runs alone. The stable one forgets; the other pushes
    until the drive breaks loose, and the input never dies out."""
    model = drive_model()
    plant = drive()
    weights = (
        {"input_weight": 1.0, "output_noise": 1.0}
        if stable
        else {"input_weight": 1e-5, "output_noise": 1e-6}
    )
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.05, rate_observer=0.1, **weights)
    design = riccati_synthesis.design(model, ONES)
    assert design.certified
    law = ObserverFeedback.from_design(model, design)
    radius = controller_spectral_radius(model.linear, law.gains, ONES)
    assert (radius < 1) == stable
    loop = LoopExperiment(initial_conditions=1, horizon_s=6.0)
    start = np.full((1, 1), 1e-6)
    no_noise = np.zeros((1, 600, 1))
    run = loop.simulate(plant, law, start, no_noise)
    last_inputs = np.abs(run.u[0, -100:])
    largest = last_inputs.max()
    assert (largest < 1e-12) == stable
    later_outputs = np.abs(run.y[0, 300:])
    largest = later_outputs.max()
    assert (largest == 0.0) == stable
