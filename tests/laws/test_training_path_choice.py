"""The records say whether the output answers within the sample, and training starts where they
move."""

import json
from dataclasses import replace

import numpy as np
import pytest
from models_cases import data_set

from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training.path_choice import choose_feedthrough
from ssm_study.training.structured_fit import StructuredFit
from ssm_study.training.structured_problem import Batch


def answering(data: DataSet, gain: float) -> DataSet:
    """The same records with a direct share of the input in the output."""

    def direct(record: Trajectory) -> Trajectory:
        return replace(record, y=record.y + gain * record.u)

    parts = {
        name: tuple(direct(record) for record in getattr(data, name))
        for name in ("training", "validation", "test")
    }
    return replace(data, **parts)


@pytest.mark.parametrize(("gain", "expected"), [(0.0, False), (2.0, True)])
def test_feedthrough_is_chosen_where_the_output_answers_at_once(
    gain: float, expected: bool
) -> None:
    data = answering(data_set(noise=0.02, samples=400, records=4), gain)
    feedthrough, tried = choose_feedthrough(data)
    assert feedthrough is expected
    assert json.loads(json.dumps(tried)) == tried
    assert [row["feedthrough"] for row in tried if row["chosen"]] == [expected]


def test_the_test_records_are_not_looked_at() -> None:
    data = answering(data_set(noise=0.02, samples=400, records=4), 2.0)
    other = replace(data, test=(replace(data.test[0], y=np.zeros_like(data.test[0].y)),))
    assert choose_feedthrough(data) == choose_feedthrough(other)


def test_short_records_choose_nothing() -> None:
    data = data_set(samples=120, records=1)
    assert choose_feedthrough(replace(data, validation=data.training)) == (False, [])


def test_only_true_false_and_auto_are_feedthrough() -> None:
    with pytest.raises(BadRequest, match=r"model.feedthrough = sometimes"):
        StructuredSpec(order=2, neurons=1, feedthrough="sometimes")


def moving_late(samples: int = 6000) -> Batch:
    """One record that stands still for its first half."""
    rng = np.random.default_rng(0)
    u = np.zeros((samples, 1))
    u[samples // 2 :] = rng.normal(size=(samples - samples // 2, 1))
    return Batch.padded([(u, np.cumsum(u, axis=0) * 0.1)])


def test_a_start_is_made_where_the_record_moves() -> None:
    records = moving_late()
    stretch = records.moving_stretch(2000)
    assert stretch.u.std() > 0.8
    assert records.cut(2000).u.std() == 0.0
    late = Batch(*(part[:, 3000:] for part in records))
    assert np.shares_memory(late.moving_stretch(2000).u, late.cut(2000).u)


def test_records_at_rest_have_no_start() -> None:
    u = np.zeros((300, 1))
    u[0] = 1.0
    records = Batch.padded([(u, np.arange(300.0)[:, None])])
    still = Batch(records.u * 0.0, records.y, records.weight)
    with pytest.raises(BadRequest, match="no stretch of the training records moves"):
        still.moving_stretch(100)


def test_a_log_that_stands_still_at_first_trains() -> None:
    """With the equilibrium at zero its first samples are all zero, and gave a singular matrix."""
    data = data_set(samples=400, records=1)
    record = data.training[0]
    u = np.concatenate([np.tile(data.scale.input_equilibrium, (2500, 1)), record.u])
    y = np.concatenate([np.tile(data.scale.output_equilibrium, (2500, 1)), record.y])
    data = replace(data, training=(replace(record, u=u, y=y),))
    spec = StructuredSpec(order=2, neurons=1, draws=1, start_steps=[5, 5, 3])
    fit = StructuredFit(spec, data, 0)
    fit.advance(3)
    assert float(fit.loss) < 0.2
