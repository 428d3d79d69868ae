"""From trajectories to a data set: equilibrium offsets, scales as pure gains, and what must hold of every record."""

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Trajectory

SAME_STEP = 1e-9  # relative: sampling times written by different programs


def assemble(
    *,
    training: tuple[Trajectory, ...],
    validation: tuple[Trajectory, ...],
    test: tuple[Trajectory, ...],
    inputs: tuple[Channel, ...],
    outputs: tuple[Channel, ...],
    input_equilibrium: Float[np.ndarray, "m"],
    output_equilibrium: Float[np.ndarray, "p"],
    start_up_samples: int,
    metadata: dict[str, str],
) -> DataSet:
    """`scale = rms(training - equilibrium)` per channel: a gain about the equilibrium, so that zero stays zero.

    Raises `BadRequest` for a part without records, differing sampling times, a record no longer than the start-up
    window, or a channel that is constant over the training records.
    """
    for part, records in (("training", training), ("validation", validation), ("test", test)):
        require(len(records) > 0, f"data.{part}", "none", "a data set needs at least one record here", "add one")
        for record in records:
            _check(record, training[0].step_s, start_up_samples)
    return DataSet(
        training=training,
        validation=validation,
        test=test,
        inputs=inputs,
        outputs=outputs,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
        input_scale=_gains(np.concatenate([r.u for r in training]), input_equilibrium, inputs),
        output_scale=_gains(np.concatenate([r.y for r in training]), output_equilibrium, outputs),
        start_up_samples=start_up_samples,
        metadata=metadata,
    )


def _check(record: Trajectory, step_s: float, start_up_samples: int) -> None:
    require(
        len(record) > start_up_samples + 1,
        f"{record.name} (samples)",
        len(record),
        f"no longer than the start-up window of {start_up_samples} samples",
        "use a longer record or a smaller data.start_up_samples",
    )
    require(
        abs(record.step_s - step_s) <= SAME_STEP * step_s,
        f"{record.name}.step_s",
        record.step_s,
        f"differs from the {step_s:g} s of the first training record",
        "resample the records to one sampling time",
    )


def _gains(
    values: Float[np.ndarray, "T c"], equilibrium: Float[np.ndarray, "c"], channels: tuple[Channel, ...]
) -> Float[np.ndarray, "c"]:
    for j, channel in enumerate(channels):
        require(
            float(np.ptp(values[:, j])) > 0,
            channel.name,
            values[0, j],
            "constant over the training records, so nothing can be identified from it",
            "excite it, or leave the channel out",
        )
    return np.sqrt(np.mean((values - equilibrium) ** 2, axis=0))
