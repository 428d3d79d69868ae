"""N4SID's B without feedthrough: recovered exactly from exact data, and the study goes on with the
model."""

import numpy as np
import pytest

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models.baselines.solved import N4SID, estimate_input_matrix
from ssm_study.signals import Channel, Trajectory
from ssm_study.systems import StateSpace

RNG = np.random.default_rng(0)
A = np.array([[0.9, 0.2], [-0.2, 0.8]])
B = RNG.normal(size=(2, 2))
C = RNG.normal(size=(1, 2))
D = np.zeros((1, 2))
TRUE = StateSpace(a=A, b=B, c=C, d=D)


def test_the_input_matrix_is_recovered_from_records_with_unknown_starts() -> None:
    records = []
    for length in (60, 90):
        u = RNG.normal(size=(length, 2))
        x0 = RNG.normal(size=2)
        response = TRUE.simulate(u, x0)
        records.append((u, response[0]))
    actual = estimate_input_matrix(TRUE.a, TRUE.c, records)
    np.testing.assert_allclose(actual, TRUE.b, atol=1e-10)


def test_a_system_without_feedthrough_is_identified_without_it() -> None:
    pytest.importorskip("nfoursid")
    b = TRUE.b[:, :1]
    d = np.zeros((1, 1))
    system = StateSpace(a=TRUE.a, b=b, c=TRUE.c, d=d)
    records = []
    for name in ("training", "validation", "test"):
        u = RNG.normal(size=(400, 1))
        y = system.simulate(u)[0]
        white_noise = RNG.normal(size=y.shape)
        measured = y + 0.02 * white_noise
        trajectory = Trajectory(u=u, y=measured, step_s=0.1, name=name)
        records.append((trajectory,))
    channel = Channel(name="u", unit="V")
    output_channel = Channel(name="y", unit="m")
    channels = (channel,), (output_channel,)
    training, validation, test = records
    parts = (training, validation, test)
    zero = np.zeros(1)
    rest = (zero, zero)
    data = assemble_dataset(parts, rest, channels, 0)
    n4_sid = N4SID(order=2, block_rows=10)
    model = n4_sid.fit_model(data)
    linear_d = model.linear.d
    assert not linear_d.any()
    u = data.test[0].u
    response = system.simulate(u)
    y = response[0]
    difference = model.simulate(u) - y
    mean = np.mean(difference**2)
    upper_limit = 0.02 * y.std()
    assert np.sqrt(mean) < upper_limit
