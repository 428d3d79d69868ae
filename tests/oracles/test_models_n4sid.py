"""N4SID's B without feedthrough: recovered exactly from exact data, and the study goes on with the
model."""

import numpy as np
import pytest

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models.baselines.solved import N4SID, input_matrix
from ssm_study.signals import Channel, Trajectory
from ssm_study.systems import StateSpace

RNG = np.random.default_rng(0)
TRUE = StateSpace(
    a=np.array([[0.9, 0.2], [-0.2, 0.8]]),
    b=RNG.normal(size=(2, 2)),
    c=RNG.normal(size=(1, 2)),
    d=np.zeros((1, 2)),
)


def test_the_input_matrix_is_recovered_from_records_with_unknown_starts() -> None:
    records = []
    for length in (60, 90):
        u = RNG.normal(size=(length, 2))
        records.append((u, TRUE.simulate(u, RNG.normal(size=2))[0]))
    np.testing.assert_allclose(input_matrix(TRUE.a, TRUE.c, records), TRUE.b, atol=1e-10)


def test_a_system_without_feedthrough_is_identified_without_it() -> None:
    pytest.importorskip("nfoursid")
    system = StateSpace(a=TRUE.a, b=TRUE.b[:, :1], c=TRUE.c, d=np.zeros((1, 1)))
    records = []
    for name in ("training", "validation", "test"):
        u = RNG.normal(size=(400, 1))
        y = system.simulate(u)[0]
        records.append(
            (Trajectory(u=u, y=y + 0.02 * RNG.normal(size=y.shape), step_s=0.1, name=name),)
        )
    channels = (Channel(name="u", unit="V"),), (Channel(name="y", unit="m"),)
    data = assemble_dataset(
        (records[0], records[1], records[2]), (np.zeros(1), np.zeros(1)), channels, 0
    )
    model = N4SID(order=2, block_rows=10).solve(data)
    assert not model.linear.d.any()
    u, y = data.test[0].u, system.simulate(data.test[0].u)[0]
    assert np.sqrt(np.mean((model.simulate(u) - y) ** 2)) < 0.02 * y.std()
