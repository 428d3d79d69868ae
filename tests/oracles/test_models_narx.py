"""NARX from several records: no row of its regression reaches across the joint between two
experiments."""

import numpy as np
import pytest

from ssm_study.data.assembly import assemble
from ssm_study.models.baselines.solved import NARX, own_rows
from ssm_study.signals import Channel, Trajectory

KNOWN = {1001: 1.2, 1002: -0.5, 2001: 0.3}  # y[k] = 1.2 y[k-1] - 0.5 y[k-2] + 0.3 u[k-1]


def record(samples: int, seed: int) -> Trajectory:
    """Begins in motion, so that the joint to the record before is a jump."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=samples), 3.0 * rng.normal(size=samples)
    for k in range(2, samples):
        y[k] = KNOWN[1001] * y[k - 1] + KNOWN[1002] * y[k - 2] + KNOWN[2001] * u[k - 1]
    return Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)


def test_a_row_has_its_past_in_its_own_record() -> None:
    np.testing.assert_array_equal(np.flatnonzero(own_rows([5, 1, 4], 2)) + 2, [2, 3, 4, 8, 9])
    assert own_rows([6], 2).all()


def test_the_system_is_found_from_records_that_do_not_join() -> None:
    pytest.importorskip("sysidentpy")
    parts = (record(300, 0), record(12, 1)), (record(50, 2),), (record(50, 3),)
    channels = (Channel(name="u", unit="V"),), (Channel(name="y", unit="m"),)
    data = assemble(parts, (np.zeros(1), np.zeros(1)), channels, 0)
    found = NARX(lags=2, degree=1, terms=3).solve(data)
    gain = float(data.scale.input_scale[0] / data.scale.output_scale[0])
    theta = {int(code): value for (code,), value in zip(found.codes, found.theta, strict=True)}
    assert theta == pytest.approx(KNOWN | {2001: KNOWN[2001] * gain}, abs=1e-3)
