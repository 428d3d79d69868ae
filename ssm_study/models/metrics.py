"""Simulation of records by an identified model, and the fit of the simulated outputs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.columns import Column
from ssm_study.models.identified import SSM, ScaffoldedModel, Simulator
from ssm_study.models.structured import StructuredSSM
from ssm_study.signals import Trajectories, Trajectory, fit_percent, rmse

AS_TRAINED = "the model as it was trained is kept in the store, not in the run's folder"
A_COMPARISON = "of another model, which is fitted for comparison and not kept"
NOT_KEPT = "where the training records cannot be made or read again"

COLUMNS = (
    Column("model", "string", word="Model class", setting="model"),
    Column("order", "Int64", word="Model order", setting="model.order"),
    Column(
        "hidden_width", "Int64", head="width", word="Hidden width", setting="model.hidden_width"
    ),
    Column(
        "slope_lower",
        "Float64",
        "",
        "mu",
        "Requested slope floor",
        "–",
        setting="model.slope_lower",
    ),
    Column(
        "slope_upper",
        "Float64",
        "",
        "nu",
        "Requested slope ceiling",
        "–",
        setting="model.slope_upper",
    ),
    Column("scaffold_in", "string", word="Input scaffolding", setting="model.scaffold_in"),
    Column("scaffold_out", "string", word="Output scaffolding", setting="model.scaffold_out"),
    Column("neurons", "Int64", word="Neurons", unchecked=AS_TRAINED),
    Column("states_identified", "Int64", word="States identified", unchecked=AS_TRAINED),
    Column(
        "fit_train_percent",
        "Float64",
        "high",
        "fit train",
        "Fit on training records",
        "%",
        unchecked=NOT_KEPT,
    ),
    Column("fit_validation_percent", "Float64", "high", "fit val", "Fit on validation record", "%"),
    Column("fit_test_percent", "Float64", "high", "fit %", "Fit on test record", "%", shown=True),
    Column("piece_start", "string", word="Start of a test record"),
    Column(
        "fit_test_other_start_percent",
        "Float64",
        word="Fit on test record from the other start",
        unit="%",
    ),
    Column("members", "Int64", word="Models whose mean predicts"),
    Column(
        "fit_validation_members_percent",
        "Float64",
        "high",
        word="Fit of the mean on validation record",
        unit="%",
    ),
    Column(
        "fit_test_members_percent",
        "Float64",
        "high",
        word="Fit of the mean on test record",
        unit="%",
    ),
    Column("rmse_test", "Float64", "low", "rmse", "RMSE on test record", "output unit"),
    Column(
        "fit_baseline_percent",
        "Float64",
        "high",
        "baseline %",
        "Fit of the best baseline on test record",
        "%",
        unchecked=A_COMPARISON,
    ),
    Column(
        "fit_baseline_lowest_percent",
        "Float64",
        word="Lowest test fit of baselines that validate as well",
        unit="%",
        unchecked=A_COMPARISON,
    ),
    Column(
        "fit_baseline_highest_percent",
        "Float64",
        word="Highest test fit of baselines that validate as well",
        unit="%",
        unchecked=A_COMPARISON,
    ),
    Column("baseline", "string", word="Best baseline", unchecked=A_COMPARISON),
    Column("score_test_*", "Float64", "low", word="Benchmark score"),
    Column("score_members_*", "Float64", "low", word="Benchmark score of the mean"),
)


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Measured records together with a model's simulated outputs, in physical units. The first
    `start_up_samples` of each are not scored. `starts` has the state from which a record's run
    began, None where its first samples gave it."""

    records: Trajectories
    simulated: tuple[Float[np.ndarray, "_ p"], ...]
    start_up_samples: int
    starts: tuple[Any, ...] = ()

    @classmethod
    def simulate_records(
        cls,
        model: Simulator,
        records: Trajectories,
        start_up_samples: int,
        starts: tuple[Any, ...] = (),
    ) -> "Simulation":
        """Simulate a model on several records."""
        states = starts or (None,) * len(records)
        records_and_starts = zip(records, states, strict=True)
        simulated_records = (
            simulate_record(model, record, start_up_samples, state)
            for record, state in records_and_starts
        )
        simulated = tuple(simulated_records)
        return cls(
            records=records, simulated=simulated, start_up_samples=start_up_samples, starts=states
        )

    @property
    def fit_percent(self) -> float:
        """Fit of the simulated outputs to the measured outputs, in percent. `100 (1 - ||y - y_hat||
        / ||y - mean(y)||)` over the scored samples of all records."""
        return fit_percent(*self._scored_outputs())

    @property
    def rmse(self) -> float:
        """Root mean square error between simulated and measured outputs, in the unit of the output.
        `sqrt(mean((y - y_hat)^2))`."""
        return rmse(*self._scored_outputs())

    def _scored_outputs(self) -> tuple[Float[np.ndarray, "T p"], Float[np.ndarray, "T p"]]:
        """Measured and simulated outputs of all records, without the start-up samples that are not
        scored."""
        first = self.start_up_samples
        measured = [record.y[first:] for record in self.records]
        simulated = [y[first:] for y in self.simulated]
        all_measured = np.concatenate(measured)
        all_simulated = np.concatenate(simulated)
        return all_measured, all_simulated


def model_size_columns(model: Simulator) -> dict[str, Any]:
    """Table columns on the size of a model, such as its numbers of states and neurons. They may
    differ from the configuration, where folds chose the size."""
    if not isinstance(model, StructuredSSM):
        return {}
    neuron_count = len(model.neurons)
    return {"states_identified": model.order, "neurons": neuron_count}


def fit_columns(
    validation: Simulation, test: Simulation, scores: tuple[float, ...] = ()
) -> dict[str, Any]:
    """Table columns on a model's fits to the validation and test records, and on its test error. On
    a benchmark also its score, in the unit of the publications."""
    columns = {"fit_validation_percent": validation.fit_percent}
    columns["fit_test_percent"] = test.fit_percent
    columns["rmse_test"] = test.rmse
    return columns | numbered_columns("score_test_", scores)


def numbered_columns(prefix: str, scores: tuple[float, ...]) -> dict[str, float]:
    """Table columns of one score each, numbered from 1 as the test records are."""
    return {f"{prefix}{number}": score for number, score in enumerate(scores, start=1)}


# Variance of the output noise while estimating, scaled units: a few percent of the signal.
START_UP_NOISE = 1e-3
MappedInput = Float[np.ndarray, "T m"]
Gramian = Float[np.ndarray, "n n"]
GAUSS_NEWTON_STEPS = 5  # for a nonlinear S_y; a linear one is solved by the first


def simulate_record(
    model: Any, record: Trajectory, start_up_samples: int, initial_state: Any = None
) -> Float[np.ndarray, "T p"]:
    """Simulate a model on one record, from an initial state that is given or estimated from the
    first samples. The run starts from `initial_state` if that is given, and from rest if every
    sample is scored.

    A regression takes the start-up samples for its past outputs; another baseline starts at rest.
    """
    if isinstance(model, ScaffoldedModel):
        x0 = None if initial_state is None else np.asarray(initial_state, dtype=np.float64)
        if x0 is None and start_up_samples:
            x0 = estimate_initial_state(model, record, start_up_samples)
        return model.simulate(record.u, x0, record.d)
    if initial_state is not None:
        start_state = np.asarray(initial_state, dtype=np.float64)
        return model.simulate(record.u, start_state)
    if start_up_samples == 0:
        return model.simulate(record.u)
    first_outputs = record.y[:start_up_samples]
    return model.simulate_from_outputs(record.u, first_outputs)


def estimate_initial_state(
    model: Any, record: Trajectory, samples: int, excitation_record: Trajectory | None = None
) -> Float[np.ndarray, "n"]:
    """Estimate a model's initial state on a record from its first samples, by regularised least
    squares. `argmin |y - y_hat(x0)|^2 / noise + x0^T W^{-1} x0` over the first `samples`, W the
    Gramian of the states that the input reaches.

    W is that of the lifted input of the record, or of the one that is given (a decay has no input
    of its own), over its length, so a state that the input cannot reach is not invented to fit the
    noise; a mode near the unit circle, whose Gramian over all time is singular, does no harm. The
    current sample's output error is linearised through the model and solved by Gauss-Newton. The
    state is zero if an unstable model leaves no finite solution.
    """
    lifted = model.driving_signals(record.u, record.d)
    first_outputs = record.y[:samples]
    target = model.scale.scaled_output(first_outputs)
    reaching = (
        lifted
        if excitation_record is None
        else model.driving_signals(excitation_record.u, excitation_record.d)
    )
    prior = _excited_state_gramian(model, reaching)
    x0 = np.zeros(model.order)  # W, and the mean of the prior: rest
    for _ in range(GAUSS_NEWTON_STEPS):
        first_inputs = lifted[:samples]
        ybar, by_state = _linearise_output(model, first_inputs, x0)
        jacobians = [model.scaffold_out.jacobian(y) for y in ybar]
        slopes = np.stack(jacobians)  # of S_y on the way
        # d y_hat / d x0, all samples below one another
        o = (slopes @ by_state).reshape(-1, model.order)
        error = target - model.scaffold_out(ybar)
        missing = error.ravel() + o @ x0
        with np.errstate(all="ignore"):
            output_covariance = o @ prior @ o.T
            noise_covariance = START_UP_NOISE * np.eye(len(o))
            covariance = output_covariance + noise_covariance
        try:
            gain = prior @ o.T
            weighted_errors = np.linalg.solve(covariance, missing)
            x0 = gain @ weighted_errors
        except np.linalg.LinAlgError:  # the model is unstable, and its numbers overflow
            break
    is_finite = np.isfinite(x0)
    return x0 if is_finite.all() else np.zeros(model.order)


def _excited_state_gramian(model: Any, mapped_input: MappedInput) -> Gramian:
    """Gramian of the model states that the inputs of a record excite. With neurons it is the second
    moment of the states that the inputs reach from rest."""
    if isinstance(model, SSM):
        system = model.system_with_disturbances
        input_deviation = mapped_input.std(axis=0)
        b = system.b * input_deviation
        samples = len(mapped_input)
        return reachability_gramian(system.a, b, samples)
    _, states = model.simulate_recurrence(mapped_input)
    return states.T @ states / len(states)


def _linearise_output(
    model: Any, mapped_input: MappedInput, x0: Float[np.ndarray, "n"]
) -> tuple[np.ndarray, np.ndarray]:
    """Simulated output of a model from an initial state, and its derivative with respect to that
    state."""
    if isinstance(model, SSM):
        powers = [model.linear.c]  # C A^k, k = 0 ... T - 1
        for _ in range(len(mapped_input) - 1):
            next_power = powers[-1] @ model.linear.a
            powers.append(next_power)
        ybar, _ = model.system_with_disturbances.simulate(mapped_input, x0)
        return ybar, np.stack(powers)
    # Here, for it loads numba.
    from ssm_study.models.structured_kernel import simulate_with_sensitivities

    empty_shape = (1, len(mapped_input), 0)
    empty_columns = np.zeros(empty_shape)
    none = np.zeros(0, dtype=np.int64)
    matrices = (
        model.kernel_matrices_with_disturbances
        if model.scale.disturbances
        else model.kernel_matrices
    )
    ybar, by = simulate_with_sensitivities(
        matrices, mapped_input[None], x0[None], empty_columns, none
    )
    by_start = by["x0"][0]
    return ybar[0], by_start


def reachability_gramian(a: Gramian, b: Float[np.ndarray, "n m"], samples: int) -> Gramian:
    """Reachability Gramian of a linear recurrence over a finite horizon. `sum_k A^k B B^T A^kT`
    over k below the first power of two that is not less than `samples`, by doubling."""
    gramian = b @ b.T
    power = a
    doublings = (samples - 1).bit_length()
    for _ in range(doublings):
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
    return gramian
