"""A data set from records: names, scales about the equilibrium, and what is refused at its edge."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_study.data import experiments
from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.experiments import benchmark_folder
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Trajectory

CHANNELS = ((Channel(name="u", unit="V"),), (Channel(name="y", unit="m"),))
DISTURBANCES = (Channel(name="d", unit="N"),)
REST = (np.array([1.0]), np.array([2.0]))


def record_of(samples: int, seed: int = 0, step_s: float = 0.1) -> Trajectory:
    """A random record with a measured disturbance."""
    rng = np.random.default_rng(seed)
    u, y, d = rng.standard_normal((3, samples, 1))
    return Trajectory(u=u, y=y, d=d, step_s=step_s)


def assemble(*records: Trajectory, **changes: Any) -> DataSet:
    """A data set whose last two records validate and test."""
    *training, validation, test = records
    parts = (training, [validation], [test])
    settings: dict[str, Any] = {"equilibrium": REST, "channels": CHANNELS, "start_up_samples": 3}
    return assemble_dataset(parts, **(settings | changes))


def test_scales_are_those_of_the_training_records_about_the_equilibrium() -> None:
    records = [record_of(20, seed) for seed in range(4)]
    data = assemble(*records)
    for side, at in (("u", 1.0), ("y", 2.0)):
        values = np.concatenate([getattr(record, side) for record in records[:2]])
        mean_square = ((values - at) ** 2).mean()
        name = {"u": "input", "y": "output"}[side]
        scale = getattr(data.scale, f"{name}_scale")
        expected = pytest.approx(np.sqrt(mean_square))
        assert scale[0] == expected
        actual = getattr(data.scale, f"{name}_equilibrium")[0]
        assert actual == at
    expected = ["training_1", "training_2"]
    actual = [record.name for record in data.training]
    assert actual == expected
    actual = data.validation[0].name
    assert actual == "validation_1"
    actual = data.test[0].name
    assert actual == "test_1"
    actual = (data.inputs, data.outputs)
    assert actual == CHANNELS
    assert data.disturbances == ()
    assert data.start_up_samples == 3
    driven = assemble(
        *records, equilibrium=(*REST, np.zeros(1)), channels=(*CHANNELS, DISTURBANCES)
    )
    assert driven.disturbances == DISTURBANCES
    assert driven.scale.disturbances == 1


def test_a_record_is_longer_than_the_start_up_window_by_two_samples() -> None:
    records = [record_of(20)] * 2
    count = len(assemble(*records, record_of(5)).test)
    assert count == 1
    with pytest.raises(BadRequest, match="no longer than the start-up window of 3 samples"):
        assemble(*records, record_of(4))


def test_sampling_times_agree_to_nine_digits() -> None:
    records = [record_of(20)] * 2
    alike = replace(records[0], step_s=0.1 * (1 + 0.9e-9))
    assert assemble(*records, alike)
    for factor in (1 + 2e-9, 1 - 2e-9):
        other = replace(records[0], step_s=0.1 * factor)
        with pytest.raises(BadRequest, match=r"differs from the 0\.1 s of the first"):
            assemble(*records, other)


def test_a_constant_channel_or_an_empty_part_is_refused() -> None:
    record = record_of(20)
    constant = replace(record, y=np.ones((20, 1)))
    assert assemble(record, constant, constant), "of the training records alone"
    with pytest.raises(BadRequest, match=r"y = 1\.0: constant over the training records"):
        assemble(constant, record, record)
    with pytest.raises(BadRequest, match=r"data\.training = none"):
        assemble(record, record)


def test_a_benchmark_is_looked_for_where_it_is_stated_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = tmp_path / "stated"
    beside = tmp_path / "beside"
    monkeypatch.setattr(experiments, "RECORDS_BESIDE", beside)
    (beside / "emps").mkdir(parents=True)
    monkeypatch.delenv(experiments.RECORDS_VARIABLE, raising=False)
    assert benchmark_folder("emps") == beside / "emps"
    monkeypatch.setenv(experiments.RECORDS_VARIABLE, str(stated))
    assert benchmark_folder("emps") == beside / "emps"
    (stated / "emps").mkdir(parents=True)
    assert benchmark_folder("emps") == stated / "emps"
