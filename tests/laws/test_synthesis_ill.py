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
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.signals import Trajectory
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.deployed import add_gain_certificates
from ssm_study.synthesis.metrics import design_columns
from ssm_study.systems import Balls, JacobianBall, StateSpace

GRIDS = {
    "stretch_shares": (0.1, 0.9),
    "observer_rates": (0.05,),
    "input_weights": (1e-3, 1e2),
    "output_noises": (1.0,),
}
Draw = Callable[[np.random.Generator, int], np.ndarray]
MATRICES: dict[str, Draw] = {
    "zero": lambda _, n: np.zeros((n, n)),
    "nearly an integrator": lambda _, n: (1 - 1e-12) * np.eye(n),
    "nilpotent": lambda rng, n: np.diag(np.ones(n - 1), 1) * rng.choice([1e8, 1.0, 1e-8]),
    "all modes near the circle": lambda rng, n: (
        0.9999 * np.linalg.qr(rng.standard_normal((n, n)))[0]
    ),
    "both ends of the circle": lambda rng, n: np.diag(
        rng.choice([0.0, 1e-16, 0.5, 1 - 1e-9, 1e-9 - 1], n)
    ),
    "defective": lambda _, n: 0.5 * np.eye(n) + np.diag(np.full(n - 1, 1e6), 1),
    "drawn": lambda rng, n: (
        (a := rng.standard_normal((n, n))) * 0.99999999 / np.abs(np.linalg.eigvals(a)).max()
    ),
}
OUTPUTS: tuple[Callable[[np.random.Generator, np.ndarray], np.ndarray], ...] = (
    lambda rng, u: 0.5 * rng.standard_normal(u.shape).cumsum(axis=0),
    lambda _, u: motor_record().y[: len(u)],
    lambda _, u: np.zeros_like(u),
)


def drawn(kind: str, rng: np.random.Generator) -> tuple[SSM, Balls]:
    n = int(rng.integers(2, 5))
    shapes = ((n, 1), (1, n))
    b, c = (rng.standard_normal(shape) * 10.0 ** rng.integers(-14, 9) for shape in shapes)
    silent = rng.integers(
        4
    )  # a direction that the input does not reach or the output does not show; or all of them
    b[: int(rng.integers(n + 1)) if silent == 0 else 0] = 0
    c[:, : int(rng.integers(n + 1)) if silent == 1 else 0] = 0
    a = MATRICES[kind](rng, n)
    d = np.array([[rng.choice([0.0, 1.0, 1e8])]])
    linear = StateSpace(a=a, b=b, c=c, d=d)
    lower = float(rng.choice([1e-9, 1e-3, 0.12, 1.0]))
    jacobian_ball = JacobianBall.from_slopes(lower, 1.0)
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = Balls(input=jacobian_ball, output=output)
    return replace(motor_model(), linear=linear), balls


@pytest.mark.filterwarnings("ignore")  # of ill-conditioned matrices there is nothing else to say
@pytest.mark.parametrize("kind", MATRICES)
def test_a_design_comes_back(kind: str) -> None:
    for seed, integral_weights in enumerate([(), (0.3,)]):
        rng = np.random.default_rng([seed, *kind.encode()])
        model, balls = drawn(kind, rng)
        u = np.repeat(rng.uniform(-3, 3, 40), 5)[:, None]
        y = OUTPUTS[seed](rng, u)
        trajectory = Trajectory(u=u, y=y, step_s=0.01)
        record = (trajectory,)
        auto = Auto(**GRIDS, integral_weights=integral_weights)
        design = auto.design(model, balls, record)
        shown = measure_mismatch(model, record)
        facts = design_columns(add_gain_certificates(design, model, balls), model, balls, shown)
        assert isinstance(facts["controller_certified"], bool)
        assert design.feasible or facts["infeasible_reason"]


def test_a_norm_beyond_floats_is_infinite_and_one_below_them_small() -> None:
    one = np.ones((1, 1))
    a = -(1 - 1e-17) * one
    system = StateSpace(a=a, b=one, c=one, d=0 * one)
    assert hinf_norm(system) == np.inf
    system = StateSpace(a=0.5 * one, b=1e-170 * one, c=1e-3 * one, d=0 * one)
    assert hinf_norm(system) == pytest.approx(2e-173)
