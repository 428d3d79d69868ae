"""Initial states of simple models on records that do not begin at rest.

A regression can take the first measured outputs of a record as its past. Their noise is then its
initial state, and a slow mode carries it on for long. Models with states have two better starts
(`models.warm_start`): their state is estimated from the first samples, or simulated from the log
before the record. Here the simple models have them, too: linear ones as a state space, polynomials
by a run-in on the log before.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.models.baselines.regression import CONSTANT, INPUT, NarxModel
from ssm_study.models.identified import SSM
from ssm_study.models.metrics import Simulation
from ssm_study.models.warm_start import PAST, SAMPLES, preceding_log, states_from_preceding_log
from ssm_study.signals import DataSet, Trajectories, Trajectory
from ssm_study.systems import StateSpace

OUTPUTS = "outputs"  # the first measured outputs of a record are the model's past
STARTS = (OUTPUTS, SAMPLES, PAST)
INTEGRATES = 1e-9  # least distance of `sum f` from one: an integrator has no equilibrium
RUN_IN = 300  # samples of the log before a record that a polynomial runs through at most


def simulate_by_kind_of_start(
    model: NarxModel, data: DataSet, records: Trajectories, starts: Sequence[str] = STARTS
) -> dict[str, Simulation]:
    """Free runs of an ARX or NARX model from three kinds of initial states: measured, estimated, or
    from the preceding log.

    Only the named kinds are tried, as far as they exist; if every sample is scored, runs start from
    rest.
    """
    window = data.start_up_samples
    runs = {}
    if OUTPUTS in starts or window == 0:
        runs[OUTPUTS] = Simulation.simulate_records(model, records, window)
    if window == 0:
        return runs
    is_linear = model.codes.shape[1] == 1
    if not is_linear:
        if PAST in starts:
            runs[PAST] = simulate_after_preceding_log(model, data, records)
        return runs
    linear = arx_to_state_space(model, data.step_s)
    if SAMPLES in starts:
        runs[SAMPLES] = Simulation.simulate_records(linear, records, window)
    if PAST in starts:
        states = states_from_preceding_log(linear, data, records)
        runs[PAST] = Simulation.simulate_records(linear, records, window, states)
    return runs


def simulate_after_preceding_log(
    model: NarxModel, data: DataSet, records: Trajectories
) -> Simulation:
    """Simulate a NARX model on several records, each simulation beginning in the preceding part of
    the log. A record without such a log begins with its own measured outputs."""
    simulated = tuple(
        simulate_record_after_preceding_log(model, data, record) for record in records
    )
    return Simulation(records=records, simulated=simulated, start_up_samples=data.start_up_samples)


def simulate_record_after_preceding_log(
    model: NarxModel, data: DataSet, record: Trajectory
) -> Float[np.ndarray, "T p"]:
    """Simulate a NARX model on one record, beginning in the preceding part of the log."""
    past = preceding_log(data, record)
    window = data.start_up_samples
    if past is None:
        return model.simulate_from_outputs(record.u, record.y[:window])
    run_in = past[-RUN_IN:]
    both = Trajectory.concatenate([run_in, record])
    simulated = model.simulate_from_outputs(both.u, both.y[:window])
    return simulated[len(run_in) :]


def arx_to_state_space(model: NarxModel, step_s: float) -> SSM:
    """Convert a linear ARX model to a state-space model in observer canonical form.

    `y[k] = c + sum_i f_i y[k-i] + sum_j g_j u[k-j]` is `x+ = A x + B u, y = C x + D u` around the
    output `c / (1 - sum f)`, with `A` the companion matrix of `f`, `D = g_0`, `B_i = g_i + f_i D`.
    """
    codes = model.codes[:, 0]
    inputs = model.scale.inputs
    order = max(1, int((codes % 1000).max()))
    f = np.zeros(order)
    gains = np.zeros((order + 1, inputs))
    constant = 0.0
    for code, theta in zip(codes, model.theta, strict=True):
        lag = int(code) % 1000
        if code == CONSTANT:
            constant = float(theta)
        elif code < INPUT:
            f[lag - 1] = theta
        else:
            gains[lag, (int(code) - INPUT) // 1000] = theta
    a = np.eye(order, k=1)
    a[:, 0] = f
    direct = gains[:1]
    b = gains[1:] + f[:, None] * direct
    system = StateSpace(a=a, b=b, c=np.eye(1, order), d=direct)
    offset = model.scale.output_scale * constant / max(1.0 - f.sum(), INTEGRATES, key=abs)
    scale = replace(model.scale, output_equilibrium=model.scale.output_equilibrium + offset)
    return SSM.from_linear(system, step_s, scale)
