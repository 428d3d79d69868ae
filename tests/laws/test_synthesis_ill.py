"""An ill model ends nothing: whatever its matrices, a design comes back, certified or infeasible
with its reason.

Defective, nilpotent, zero and nearly unstable matrices, gains over 22 decades, inputs and outputs
without effect, and records that are noise, rest or somebody else's: of the first 153 drawn so, 43
ended the whole run.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor_model, motor_record

from ssm_study.bounds.frequency import hinf_norm
from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.signals import Trajectory
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.deployed import add_gain_certificates
from ssm_study.synthesis.metrics import design_columns
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

GRIDS = {
    "stretch_shares": (0.9,),
    "observer_rates": (0.05,),
    "input_weights": (1e-3, 1e2),
    "output_noises": (1.0,),
}
Draw = Callable[[np.random.Generator, int], np.ndarray]
MATRICES: dict[str, Draw] = {}
MATRICES["zero"] = lambda _, n: np.zeros((n, n))
MATRICES["nearly an integrator"] = lambda _, n: (1 - 1e-12) * np.eye(n)


def draw_nilpotent(rng: np.random.Generator, n: int) -> np.ndarray:
    size = rng.choice([1e8, 1.0, 1e-8])
    return size * np.eye(n, k=1)


def draw_modes_near_the_circle(rng: np.random.Generator, n: int) -> np.ndarray:
    white_noise = rng.standard_normal((n, n))
    turn, _ = np.linalg.qr(white_noise)
    return 0.9999 * turn


def draw_both_ends_of_the_circle(rng: np.random.Generator, n: int) -> np.ndarray:
    ends = [0.0, 1e-16, 0.5, 1 - 1e-9, 1e-9 - 1]
    modes = rng.choice(ends, n)
    return np.diag(modes)


def draw_defective(_: np.random.Generator, n: int) -> np.ndarray:
    return 0.5 * np.eye(n) + 1e6 * np.eye(n, k=1)


def draw_any(rng: np.random.Generator, n: int) -> np.ndarray:
    a = rng.standard_normal((n, n))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    return a * 0.99999999 / spectral_radius


MATRICES["nilpotent"] = draw_nilpotent
MATRICES["all modes near the circle"] = draw_modes_near_the_circle
MATRICES["both ends of the circle"] = draw_both_ends_of_the_circle
MATRICES["defective"] = draw_defective
MATRICES["drawn"] = draw_any


def wandering_output(rng: np.random.Generator, u: np.ndarray) -> np.ndarray:
    white_noise = rng.standard_normal(u.shape)
    return 0.5 * white_noise.cumsum(axis=0)


def output_of_the_motor(_: np.random.Generator, u: np.ndarray) -> np.ndarray:
    record = motor_record()
    return record.y[: len(u)]


OUTPUTS = (wandering_output, output_of_the_motor)
INTEGRAL_WEIGHTS: tuple[tuple[float, ...], ...] = ((), (0.3,))


def draw_model(kind: str, rng: np.random.Generator) -> tuple[SSM, JacobianBalls]:
    """A model of these matrices, and the balls of its maps.

    One in four has directions that the input does not reach, one in four has directions that the
    output does not show; it may be all of them.
    """
    n = int(rng.integers(2, 5))
    b = rng.standard_normal((n, 1)) * 10.0 ** rng.integers(-14, 9)
    c = rng.standard_normal((1, n)) * 10.0 ** rng.integers(-14, 9)
    silent = rng.integers(4)
    directions = int(rng.integers(n + 1))
    if silent == 0:
        b[:directions] = 0
    if silent == 1:
        c[:, :directions] = 0
    a = MATRICES[kind](rng, n)
    feedthrough = rng.choice([0.0, 1.0, 1e8])
    d = np.array([[feedthrough]])
    linear = StateSpace(a=a, b=b, c=c, d=d)
    lower = float(rng.choice([1e-9, 1e-3, 0.12, 1.0]))
    input_ball = JacobianBall.from_slopes(lower, 1.0)
    output_ball = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=input_ball, output=output_ball)
    return replace(motor_model(), linear=linear), balls


@pytest.mark.filterwarnings("ignore")  # of ill-conditioned matrices there is nothing else to say
@pytest.mark.parametrize("kind", MATRICES)
def test_a_design_comes_back(kind: str) -> None:
    for seed, integral_weights in enumerate(INTEGRAL_WEIGHTS):
        rng = np.random.default_rng([seed, *kind.encode()])
        model, balls = draw_model(kind, rng)
        levels = rng.uniform(-3, 3, 40)
        u = np.repeat(levels, 5)[:, None]
        y = OUTPUTS[seed](rng, u)
        trajectory = Trajectory(u=u, y=y, step_s=0.01)
        records = (trajectory,)
        auto = Auto(**GRIDS, integral_weights=integral_weights)
        design = auto.design(model, balls, records)
        mismatch = measure_model_error(model, records)
        certified = add_gain_certificates(design, model, balls)
        facts = design_columns(certified, model, balls, mismatch)
        assert isinstance(facts["controller_certified"], bool)
        assert design.feasible or facts["infeasible_reason"]


def test_a_norm_beyond_floats_is_infinite_and_one_below_them_small() -> None:
    one = np.ones((1, 1))
    a = -(1 - 1e-17) * one
    system = StateSpace(a=a, b=one, c=one, d=0 * one)
    assert hinf_norm(system) == np.inf
    system = StateSpace(a=0.5 * one, b=1e-170 * one, c=1e-3 * one, d=0 * one)
    assert hinf_norm(system) == pytest.approx(2e-173)
