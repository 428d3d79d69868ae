"""Arrays in which the signals of simulated closed loops are recorded, sample by sample."""

import numpy as np
from jaxtyping import Float, Int

from ssm_study.plants.plant import Plant

Values = dict[str, Float[np.ndarray, "S ..."]]
Log = dict[str, Float[np.ndarray, "N T _"]]
SomeCases = Int[np.ndarray, "S"]
SampleOfCase = Int[np.ndarray, "N"]


def write_stopped_cases(
    log: Log, plant: Plant, stopped: SomeCases, sample: int, last: Values
) -> None:
    """Write the last values of stopped simulations into all remaining samples of the log."""
    equilibrium = plant.equilibrium()
    stopped_count = len(stopped)
    at_rest = np.tile(equilibrium.u, (stopped_count, 1))
    last_values = {"u": at_rest, **last}
    repeated = {name: value[:, None] for name, value in last_values.items()}
    remaining = slice(sample, None)
    write_samples(log, stopped, remaining, repeated)


def write_samples(log: Log, cases: SomeCases, samples: int | slice, values: Values) -> None:
    """Write the signals of selected simulations at selected samples to the log."""
    for name, value in values.items():
        log[name][cases, samples] = value


def allocate_log(
    plant: Plant, estimate_count: int, shape: tuple[int, ...], state_count: int
) -> Log:
    """Allocate the log of a simulation: an array of zeros for each signal. `shape` is cases,
    samples, outputs."""
    cases, samples, outputs = shape
    inputs = len(plant.inputs)
    widths = {"u": inputs, "y": outputs, "measured": outputs}
    widths |= {"states": state_count, "estimate": estimate_count}
    return {name: np.zeros((cases, samples, width)) for name, width in widths.items()}


def repeat_last_values(log: Log, left_at_sample: SampleOfCase) -> None:
    """Fill the rest of a stopped simulation's log with the last values before the bound was
    exceeded."""
    for case in np.flatnonzero(left_at_sample > 0):
        left = left_at_sample[case]
        for values in log.values():
            last_value = values[case, left - 1]
            values[case, left:] = last_value
