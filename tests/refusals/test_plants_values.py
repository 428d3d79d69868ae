"""Values no motor can have are refused by name, in one sentence."""

from dataclasses import replace

import pytest
from plants_cases import from_yaml

from ssm_study.plants.disturbance import StepDisturbance
from ssm_study.refusal import BadRequest

IMPOSSIBLE_BODIES = [
    ("resistance_ohm", 0.0),
    ("load_inertia_kgm2", -1e-4),
    ("coulomb_torque_nm", -1e-3),
    ("dead_zone_v", -0.4),
]
IMPOSSIBLE_STEPS = [
    ("step_s", 0.0),
    ("step_s", float("nan")),
    ("speed_noise_variance", -0.02),
    ("solver_step_s", 1e-3),
]
IMPOSSIBLE = IMPOSSIBLE_BODIES + IMPOSSIBLE_STEPS


@pytest.mark.parametrize(("field", "value"), IMPOSSIBLE)
def test_refused(field: str, value: float) -> None:
    sentence = rf"^{field} = .*\.$"
    with pytest.raises(BadRequest, match=sentence):
        replace(from_yaml("plant", "dc_motor"), **{field: value})


def test_a_step_that_ends_before_it_begins() -> None:
    with pytest.raises(
        BadRequest, match=r"at_s, until_s = \(2.0, 1.0\): not in order; give at_s < until_s"
    ):
        StepDisturbance(size=1.0, at_s=2.0, until_s=1.0)
