"""Initial parameters for the training of a structured model."""

import numpy as np
from jaxtyping import Float
from scipy import linalg

from ssm_study.models.contracting import (
    RecurrenceMatrices,
    parameters_from_matrices,
    project_to_contracting,
    transform_to_metric,
)
from ssm_study.models.initial_system import (
    arx_impulse_response,
    fit_arx_matrices,
    realise_impulse_response,
)
from ssm_study.models.matrix_shapes import matrix_shapes
from ssm_study.models.structured import evaluate_activations
from ssm_study.training.structured_problem import CORE, SimulationProblem, Theta, regularised_loss

ARX_LAGS = 10  # of a start with at most half as many states
LAGS_PER_STATE = 4  # of a larger one: noise hides lightly damped modes from few lags
SLOWEST = 0.998  # a starting pole outside is pulled inside this radius
SCREENED = 24  # sets of random poles, of which the best is taken
LONGEST = 600.0  # samples: the slowest time constant that is drawn
RESIDUE_RIDGE = 1e-6  # relative: two poles that are nearly the same
SMALL = 0.05  # of E: the neurons start as a perturbation of the linear fit
RESTS_WITHIN = 1.0  # of the bias of a neuron whose argument has unit size


def fit_initial_linear_model(
    problem: SimulationProblem, order: int, feedthrough: bool, rng: np.random.Generator
) -> Theta:
    """Fit the linear model with which the training of a structured model begins, by ARX and
    balanced realisation. It is ARX by least squares, a balanced realisation of its impulse
    response, its poles inside the unit circle."""
    records = records_without_padding(problem)
    inputs, outputs = (np.concatenate(signals) for signals in zip(*records, strict=True))
    if problem.integrating_output:
        records = [(u[:-1], np.diff(y, axis=0)) for u, y in records]
    lengths = (len(u) for u, _ in records)
    shortest = min(lengths)
    arx_lags = arx_lag_count(order)
    lags = min(arx_lags, shortest // 4)
    arx_matrices = fit_arx_matrices(records, lags, feedthrough)
    response = arx_impulse_response(*arx_matrices)
    system = realise_impulse_response(response, order, rng)

    n, m = system.b.shape
    p = len(system.c)
    eigenvalues = np.linalg.eigvals(system.a)
    moduli = np.abs(eigenvalues)
    radius = float(moduli.max())
    shapes = matrix_shapes(n, m, p, 0)
    start = {name: np.zeros(shape) for name, shape in shapes.items()}
    positive_radius = max(radius, 1e-9)
    shrinkage = SLOWEST / positive_radius
    start["a"] = system.a * min(1.0, shrinkage)
    start["b"] = system.b
    start["c"] = system.c
    if feedthrough:
        start["d"] = remove_disturbance_feedthrough(problem, system.d)
    record_count = len(problem.records.u)
    start["x0"] = np.zeros((record_count, n + p * problem.integrating_output))
    start["scaffold_in"] = problem.lift.initial_parameters(inputs)
    start["scaffold_out"] = problem.read.initial_parameters(outputs)
    return normalise_states(problem, start)


def arx_lag_count(order: int) -> int:
    """Number of lags of the ARX model from which an initial linear model of given order is
    realised."""
    return ARX_LAGS if 2 * order <= ARX_LAGS else LAGS_PER_STATE * order


def records_without_padding(
    problem: SimulationProblem,
) -> list[tuple[Float[np.ndarray, "T m"], Float[np.ndarray, "T p"]]]:
    """Inputs and outputs of each training record, without the samples that were padded."""
    inputs, outputs, _ = problem.records
    masks = problem.records.recorded_mask
    records = zip(inputs, outputs, masks, strict=True)
    return [(u[recorded], y[recorded]) for u, y, recorded in records]


def remove_disturbance_feedthrough(
    problem: SimulationProblem, d: Float[np.ndarray, "p m"]
) -> Float[np.ndarray, "p m"]:
    """Set to zero the columns of a feedthrough matrix that belong to measured disturbances."""
    is_input = np.arange(d.shape[1]) < problem.lift.channels
    return np.where(is_input, d, 0.0)


def normalise_states(problem: SimulationProblem, theta: Theta) -> Theta:
    """Scale the states of a linear model to a root mean square of one over the training records.

    Balanced states differ a thousandfold in size, and a step of Levenberg-Marquardt that suits one
    overturns another.
    """
    states = states_at_scored_samples(problem, theta)
    mean_squares = np.mean(states**2, axis=0)
    size = np.sqrt(mean_squares) + 1e-9
    x0 = theta["x0"].copy()
    x0[:, : len(size)] /= size
    scaled = dict(theta)
    scaled_rows = theta["a"] * size
    size_column = size[:, None]
    scaled["a"] = scaled_rows / size_column
    scaled["b"] = theta["b"] / size[:, None]
    scaled["c"] = theta["c"] * size
    scaled["x0"] = x0
    return scaled


def states_at_scored_samples(problem: SimulationProblem, theta: Theta) -> Float[np.ndarray, "N n"]:
    """Model states at all samples of the training records that count in the training error, stacked
    in one array."""
    _, _, states = problem.simulate_internal_signals(theta)
    earlier_states = states[:, :-1]
    is_recorded = problem.records.recorded_mask
    return earlier_states[is_recorded]


def fit_from_random_poles(
    problem: SimulationProblem, initial: Theta, estimates_states: bool, rng: np.random.Generator
) -> Theta:
    """Fit linear models with several random sets of poles, and return the one that fits the records
    best.

    For given poles and B the output is linear in C, and in the free response to a record's unknown
    initial state: two least-squares problems. ARX, which minimises the error of the next sample,
    misses slow modes where that sample hardly depends on the input.
    """
    order = len(initial["a"])
    candidates = []
    for _ in range(SCREENED):
        poles = draw_state_matrix(order, rng)
        fitted = fit_model_with_poles(problem, initial, poles, estimates_states, rng)
        candidates.append(initial | fitted)
    return min(candidates, key=lambda candidate: regularised_loss(problem, candidate, ()))


def draw_state_matrix(order: int, rng: np.random.Generator) -> Float[np.ndarray, "n n"]:
    """Draw a state matrix with random real and complex poles, whose time constants are spread
    evenly on a logarithmic scale."""
    blocks: list[np.ndarray] = []
    while (left := order - sum(map(len, blocks))) > 0:
        longest = np.log(LONGEST)
        log_time_constant = rng.uniform(0.0, longest)
        time_constant = np.exp(log_time_constant)
        radius = np.exp(-1.0 / time_constant)
        turn = np.eye(1)
        if left > 1 and rng.uniform() < 0.5:
            quarter_turn = 0.5 * np.pi
            largest_angle = rng.uniform(0.0, quarter_turn)
            squared_share = rng.uniform() ** 2
            angle = largest_angle * squared_share
            cosine = np.cos(angle)
            sine = np.sin(angle)
            upper_row = [cosine, sine]
            lower_row = [-sine, cosine]
            turn = np.array([upper_row, lower_row])
        blocks.append(radius * turn)
    return linalg.block_diag(*blocks)


def fit_model_with_poles(
    problem: SimulationProblem,
    initial: Theta,
    a: Float[np.ndarray, "n n"],
    estimates_states: bool,
    rng: np.random.Generator,
) -> Theta:
    """Fit a linear model with given poles to the training records by least squares. States have
    unit size; C and initial states are fitted."""
    _, outputs, weight = problem.records
    zero_states = 0.0 * initial["x0"]
    no_feedthrough = 0.0 * initial["d"]
    zero_blocks = {"x0": zero_states, "d": no_feedthrough}
    at_rest = initial | zero_blocks
    b = rng.normal(size=initial["b"].shape)
    drawn = {"a": a, "b": b}
    driven = at_rest | drawn
    _, _, states = problem.simulate_internal_signals(driven)
    x = states[:, :-1]
    mean_squares = np.mean(x**2, axis=(0, 1))
    size = np.sqrt(mean_squares) + 1e-12
    x = x / size
    a = a * size / size[:, None]
    b = b / size[:, None]

    # All slopes of S_y are equal here.
    output_map = problem.read.to_numpy(initial["scaffold_out"])
    output_slope = output_map(np.ones_like(outputs))
    y = outputs / output_slope
    sample_count = outputs.shape[1]
    decay = matrix_powers(a, sample_count)
    c = least_squares_output_matrix(x, y, weight, decay, estimates_states)
    record_count = len(outputs)
    state_count = len(a)
    x0 = np.zeros((record_count, state_count))
    if estimates_states:
        explained = x @ c.T
        remaining = y - explained
        x0 = least_squares_initial_states(remaining, weight, c, decay)
    fitted_blocks = {"a": a, "b": b, "c": c, "x0": x0}
    return at_rest | fitted_blocks


def least_squares_output_matrix(
    x: Float[np.ndarray, "N T n"],
    y: Float[np.ndarray, "N T p"],
    weight: Float[np.ndarray, "N T 1"],
    decay: Float[np.ndarray, "T n n"],
    estimates_states: bool,
) -> Float[np.ndarray, "p n"]:
    """Output matrix that fits the measured outputs best, by least squares on simulated states. Each
    record may also have a free decay, if it may begin in motion."""
    count, samples, n = x.shape
    regressors = x
    if estimates_states:
        # The columns of each record span what its initial state can do.
        summed_decay = decay.sum(axis=2)
        decays = [summed_decay] * count
        block_decays = linalg.block_diag(*decays)
        free_motion = block_decays.reshape(count, samples, -1)
        driven_and_free = [x, free_motion]
        regressors = np.concatenate(driven_and_free, axis=-1)
    rows = (weight * regressors).reshape(count * samples, -1)
    targets = (weight * y).reshape(count * samples, -1)
    coefficients = regularised_least_squares(rows, targets)
    return coefficients[:n].T


def least_squares_initial_states(
    residual: Float[np.ndarray, "N T p"],
    weight: Float[np.ndarray, "N T 1"],
    c: Float[np.ndarray, "p n"],
    decay: Float[np.ndarray, "T n n"],
) -> Float[np.ndarray, "N n"]:
    """Initial states whose free response best fits what the input leaves unexplained in the
    output."""
    count = len(residual)
    n = c.shape[1]
    weight_rows = weight[..., None]
    weighted_decay = weight_rows * (c @ decay)
    observed = weighted_decay.reshape(count, -1, n)
    missing = (weight * residual).reshape(count, -1, 1)
    rows_and_targets = zip(observed, missing, strict=True)
    states = [regularised_least_squares(rows, targets)[:, 0] for rows, targets in rows_and_targets]
    return np.stack(states)


def matrix_powers(a: Float[np.ndarray, "n n"], count: int) -> Float[np.ndarray, "T n n"]:
    """Powers of a matrix up to a given exponent, by repeated doubling."""
    identity = np.eye(len(a))
    powers = identity[None]
    ahead = a
    while len(powers) < count:
        doubled = [powers, powers @ ahead]
        powers = np.concatenate(doubled)
        ahead = ahead @ ahead
    return powers[:count]


def regularised_least_squares(
    x: Float[np.ndarray, "N k"], y: Float[np.ndarray, "N p"]
) -> Float[np.ndarray, "k p"]:
    """Coefficients of a least-squares fit with a small ridge penalty."""
    normal = x.T @ x
    k = len(normal)
    ridge = RESIDUE_RIDGE * np.trace(normal) / k
    penalty = ridge * np.eye(k)
    cross_products = x.T @ y
    return linalg.solve(normal + penalty, cross_products)


def add_random_neurons(
    problem: SimulationProblem, theta: Theta, count: int, rng: np.random.Generator
) -> Theta:
    """Add random neurons to the initial parameters of a structured model that is linear so far.
    States have unit size; F and the bias are random, so that neurons bend within the data, E small,
    G and H zero."""
    theta = normalise_states(problem, theta)
    n, m = theta["b"].shape
    p = len(theta["c"])
    neuron_shape = (count, n)
    f = rng.normal(size=neuron_shape)
    sizes = rng.uniform(0.7, 3.0, (count, 1))
    norms = np.linalg.norm(f, axis=1, keepdims=True)
    f *= sizes / norms
    random_rows = rng.normal(size=(n, count))
    e = SMALL * random_rows
    random_bias = rng.uniform(-1.0, 1.0, count)
    bias = RESTS_WITHIN * random_bias
    input_norm = np.linalg.norm(theta["b"])
    neurons = {"e": e * input_norm, "f": f, "bias": bias}
    neurons["g"] = np.zeros((count, m))
    neurons["h"] = np.zeros((p, count))
    return theta | neurons


def contracting_initial_parameters(problem: SimulationProblem, theta: Theta, rate: float) -> Theta:
    """Initial parameters of a contracting structured model that is close to a given model. It is
    the nearest on the path of `contracting.project_to_contracting`."""
    v, _, states = problem.simulate_internal_signals(theta)
    recorded = problem.records.recorded_mask
    earlier_states = states[:, :-1]
    x = earlier_states[recorded]
    from_state = x @ theta["f"].T
    from_input = v[recorded] @ theta["g"].T
    z = from_state + from_input + theta["bias"]
    slopes = evaluate_activations(problem.neurons, z, "slope")
    core_blocks = (theta[name] for name in CORE)
    core = RecurrenceMatrices(*core_blocks)
    mean_slopes = slopes.mean(axis=0)
    contracting = project_to_contracting(core, mean_slopes, rate)
    t = contracting.t
    free = parameters_from_matrices(transform_to_metric(contracting), rate)

    n = len(theta["a"])
    x0 = theta["x0"].copy()
    model_states = x0[:, :n]
    x0[:, :n] = model_states @ t.T
    moved = dict(theta)
    moved["b"] = t @ theta["b"]
    moved_rows = linalg.solve(t.T, theta["c"].T)
    moved["c"] = moved_rows.T
    moved["x0"] = x0
    free_blocks = free._asdict()
    log_scales = np.log(contracting.d)
    return moved | free_blocks | {"log_d": log_scales}
