"""From records to a data set: scales as pure gains about the equilibrium, and what must hold of every record."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Scale, Trajectory

SAME_STEP = 1e-9  # relative: sampling times written by different programs
Parts = tuple[Sequence[Trajectory], Sequence[Trajectory], Sequence[Trajectory]]
Rest = tuple[Float[np.ndarray, "m"], Float[np.ndarray, "p"]]


def assemble(
    parts: Parts,
    rest: Rest,
    *,
    inputs: tuple[Channel, ...],
    outputs: tuple[Channel, ...],
    start_up_samples: int,
    metadata: dict[str, str],
    trials: tuple[Trajectory, ...] = (),
) -> DataSet:
    """`scale = rms(training - rest)` per channel: a gain about the equilibrium `rest = (u, y)`.

    `parts` are training, validation and test. Raises `BadRequest` for a part without records, differing sampling times,
    a record no longer than the start-up window, or a channel that is constant over the training records.
    """
    named: list[tuple[Trajectory, ...]] = []
    for part, records in zip(("training", "validation", "test"), parts, strict=True):
        require(len(records) > 0, f"data.{part}", "none", "a data set needs at least one record here", "add one")
        named.append(tuple(replace(record, name=f"{part}_{k + 1}") for k, record in enumerate(records)))
    training, validation, test = named
    step_s, window = training[0].step_s, f"no longer than the start-up window of {start_up_samples} samples"
    for record in (*training, *validation, *test):
        remedy = "use a longer record or a smaller data.start_up_samples"
        require(len(record) > start_up_samples + 1, f"{record.name} (samples)", len(record), window, remedy)
        same = abs(record.step_s - step_s) <= SAME_STEP * step_s
        problem = f"differs from the {step_s:g} s of the first training record"
        require(same, f"{record.name}.step_s", record.step_s, problem, "resample the records to one sampling time")
    scale = Scale(
        input_scale=_gains(np.concatenate([r.u for r in training]), rest[0], inputs),
        output_scale=_gains(np.concatenate([r.y for r in training]), rest[1], outputs),
        input_equilibrium=rest[0],
        output_equilibrium=rest[1],
    )
    return DataSet(
        training=training,
        validation=validation,
        test=test,
        inputs=inputs,
        outputs=outputs,
        scale=scale,
        trials=trials,
        start_up_samples=start_up_samples,
        metadata=metadata,
    )


def _gains(
    values: Float[np.ndarray, "T c"], equilibrium: Float[np.ndarray, "c"], channels: tuple[Channel, ...]
) -> Float[np.ndarray, "c"]:
    problem = "constant over the training records, so nothing can be identified from it"
    for column, channel in zip(values.T, channels, strict=True):
        require(np.ptp(column) > 0, channel.name, column[0], problem, "excite it, or leave the channel out")
    return np.sqrt(np.mean((values - equilibrium) ** 2, axis=0))
