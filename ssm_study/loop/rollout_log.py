"""Arrays in which the signals of simulated closed loops are recorded, sample by sample."""

import numpy as np
from jaxtyping import Float, Int

from ssm_study.plants.plant import Plant

Values = dict[str, Float[np.ndarray, "S ..."]]
Log = dict[str, Float[np.ndarray, "N T _"]]
SomeCases = Int[np.ndarray, "S"]
SampleOfCase = Int[np.ndarray, "N"]


def write_stopped_cases(log: Log, plant: Plant, stopped: SomeCases, k: int, last: Values) -> None:
    """Repeat the last values of cases that were stopped at the simulation's bound in all remaining
    samples of the log."""
    equilibrium = plant.equilibrium()
    stopped_count = len(stopped)
    at_rest = np.tile(equilibrium.u, (stopped_count, 1))
    last_values = {"u": at_rest, **last}
    repeated = {name: value[:, None] for name, value in last_values.items()}
    remaining = slice(k, None)
    write_samples(log, stopped, remaining, repeated)


def write_samples(log: Log, cases: SomeCases, samples: int | slice, values: Values) -> None:
    """Write the signals of some cases at some samples into the log."""
    for name, value in values.items():
        log[name][cases, samples] = value


def allocate_log(plant: Plant, estimates: int, shape: tuple[int, ...], states: int) -> Log:
    """Allocate a log: arrays of zeros for each signal of the simulated runs. `shape` is cases,
    samples, outputs."""
    cases, samples, outputs = shape
    inputs = len(plant.inputs)
    widths = {"u": inputs, "y": outputs, "measured": outputs}
    widths |= {"states": states, "estimate": estimates}
    return {name: np.zeros((cases, samples, width)) for name, width in widths.items()}


def repeat_last_values(log: Log, left_at_sample: SampleOfCase) -> None:
    """Fill the samples after a case has left the bound with its last values inside the bound."""
    for case in np.flatnonzero(left_at_sample > 0):
        left = left_at_sample[case]
        for values in log.values():
            last_value = values[case, left - 1]
            values[case, left:] = last_value
