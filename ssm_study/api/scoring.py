"""Free-run simulation of a model on a given record, scored in the same way as the test records.

A slice of a record begins in motion. Its first samples tell the state in which it begins and are
not scored, just as for the model's own records; with no such samples it starts from equilibrium.
"""

from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np

from ssm_study.api.arguments import Values
from ssm_study.data.arrays import (
    disturbance_array,
    require_consistent_time_indexes,
    signal_array_and_names,
)
from ssm_study.models.members import mean_simulation
from ssm_study.models.metrics import Simulation
from ssm_study.refusal import require, require_at_least
from ssm_study.signals import Trajectory

if TYPE_CHECKING:
    from ssm_study.api.model import Model

FEWEST_SCORED = 2  # samples


def simulate_given_record(
    model: "Model",
    u: Values,
    y: Values,
    disturbance: Values | None,
    start_up_samples: Any,
    name: str = "the model",
) -> Simulation:
    """Simulate a given record from an initial state that is estimated from its first samples.

    `start_up_samples` is that of the model's own records if it is None, and with 0 the run starts
    from equilibrium. Raises `BadRequest` for other channels or lengths, and for a record that is no
    longer than its start.
    """
    data = model.data
    require_consistent_time_indexes(u, y, data.step_s)
    input_count = len(data.inputs)
    _, inputs = signal_array_and_names(u, "u", input_count, model.input_names)
    _, outputs = signal_array_and_names(y, "y", columns=model.output_names)
    samples = len(inputs)
    output_count = len(data.outputs)
    expected_shape = (samples, output_count)
    problem = f"{name} gives outputs {expected_shape}"
    remedy = "give the outputs of this input"
    has_expected_shape = outputs.shape == expected_shape
    require(has_expected_shape, "y", outputs.shape, problem, remedy)
    measured = disturbance_array(disturbance, model.disturbance_names, len(inputs))
    output_samples = len(outputs)
    start_up = read_start_up_samples(start_up_samples, data.start_up_samples, output_samples)
    record = Trajectory(u=inputs, y=outputs, d=measured, step_s=data.step_s)
    members = model.identification.members or (model.simulator,)
    runs = [Simulation.simulate_records(member, (record,), start_up) for member in members]
    return runs[0] if len(runs) == 1 else mean_simulation(runs)


def read_start_up_samples(start_up_samples: Any, default: int, samples: int) -> int:
    """Number of samples at the beginning of a record that serve to estimate the initial state; a
    default if none is given. Raises `BadRequest` for a value that is no number of samples, and if
    no samples are left to score."""
    if start_up_samples is None:
        start_up_samples = default
    remedy = "use 20, or 0 to start from equilibrium"
    is_integer = isinstance(start_up_samples, Integral)
    is_count = is_integer and not isinstance(start_up_samples, bool)
    require(is_count, "start_up_samples", start_up_samples, "is no whole number", remedy)
    require_at_least(0, "start_up_samples", start_up_samples, remedy)
    scored = samples - int(start_up_samples)
    problem = (
        f"the first {start_up_samples} samples give the initial state, so none are left to score"
    )
    remedy = "give a longer record, or fewer start_up_samples"
    require(scored >= FEWEST_SCORED, "y", samples, problem, remedy)
    return int(start_up_samples)


def require_varying_outputs(simulation: Simulation) -> None:
    """Raise `BadRequest` for a record whose outputs are constant after the start-up samples."""
    start = simulation.start_up_samples
    moves = any(np.ptp(record.y[start:], axis=0).any() for record in simulation.records)
    problem = "is constant, and the score compares the error with its deviation from the mean"
    require(moves, "y", "one value", problem, "score a record in which it moves")
