"""Plants, records, premises and designs that the tests of coverage share."""

import numpy as np

from ssm_study.certificates.certificate import Design
from ssm_study.models.identified import SSM
from ssm_study.robustness.coverage import DiscWeights, ModelErrorSpectra, measure_error_spectra
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.signals import Trajectory
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

ZERO = np.zeros((1, 1))
UNIT = JacobianBall(alpha=1.0, beta=0.0)
BALLS = JacobianBalls(input=UNIT, output=UNIT)
PERIOD = 512
A = np.array([[0.9, 0.1], [0.0, 0.6]])
B = np.array([[0.0], [0.4]])
C = np.array([[1.0, 0.0]])
MODEL = StateSpace(a=A, b=B, c=C, d=ZERO)
OUTPUT_ALONE = DiscWeights(floor=1.0, output=ZERO, input=ZERO)


def period(rng: np.random.Generator) -> np.ndarray:
    """One period of a white input."""
    shape = (PERIOD, 1)
    return rng.uniform(-1, 1, shape)


def records(
    answer, amplitudes=(0.1, 1.0), noise: float = 0.0, shape: np.ndarray | None = None
) -> tuple[Trajectory, ...]:
    """Two periods after one that leads in; `answer` maps an input `(T, 1)` to the output."""
    rng = np.random.default_rng(1)
    one_period = period(rng) if shape is None else shape
    at_rest = np.zeros((PERIOD, 1))
    pattern = np.concatenate([one_period, one_period, one_period, at_rest])
    trajectories = []
    for amplitude in amplitudes:
        u = amplitude * pattern
        white_noise = rng.standard_normal(u.shape)
        y = answer(u) + noise * white_noise
        name = f"at {amplitude}"
        trajectory = Trajectory(u=u, y=y, step_s=0.01, name=name)
        trajectories.append(trajectory)
    return tuple(trajectories)


def respond(system: StateSpace, u: np.ndarray) -> np.ndarray:
    """The response of a linear system to an input from rest."""
    response = system.simulate(u)
    return response[0]


def linear(system: StateSpace):
    """A plant that is this linear system."""
    return lambda u: respond(system, u)


def scaled_model(share: float):
    """A plant whose gain differs from the model's by a share."""
    return lambda u: (1 + share) * respond(MODEL, u)


def premise(answer, **options) -> ModelErrorSpectra:
    """The premise of coverage that records of a plant give."""
    model = SSM.from_linear(MODEL, 0.01)
    recorded = records(answer, **options)
    validation = recorded[:1]
    mismatch = measure_model_error(model, recorded)
    trials = recorded[1:]
    return measure_error_spectra(model, validation, mismatch, 0, trials)


def design(linear_model: StateSpace = MODEL, input_weight: float = 0.3) -> Design:
    """A certified design for a linear model."""
    rates = {"rate_controller": 0.3, "rate_observer": 0.3}
    weights = {"input_weight": input_weight, "output_noise": 0.1}
    synthesis = RiccatiSynthesis(**rates, **weights)
    ssm = SSM.from_linear(linear_model, 0.01)
    certified = synthesis.design(ssm, BALLS)
    assert certified.certified
    return certified
