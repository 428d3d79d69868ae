"""Training of structured models: the parametrisation is exact both ways, every derivative is that
of differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants_cases import from_yaml
from structured_adjoint import stepped_gradient

from ssm_study.models.contracting import (
    FreeParameters,
    RecurrenceMatrices,
    _balancing_scales,
    find_contraction_metric,
    matrices_from_parameters,
    parameters_from_matrices,
    project_to_contracting,
    transform_to_metric,
)
from ssm_study.models.spec import scale_records
from ssm_study.models.structured_spec import TrainablePiecewiseMap
from ssm_study.training.levenberg import DAMPING_RANGE
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.structured_problem import (
    CORE,
    FREE_CORE,
    DescentState,
    SimulationProblem,
    Theta,
    has_converged,
    minimise_simulation_error,
    pack_parameters,
    regularised_loss,
    take_step,
    unpack_parameters,
)
from ssm_study.training.structured_start import (
    LONGEST,
    draw_state_matrix,
    fit_from_random_poles,
    fit_initial_linear_model,
)

SIZES = {
    "seed": st.integers(0, 2**31),
    "n": st.integers(1, 5),
    "q": st.integers(0, 4),
    "rate": st.floats(0.3, 1.0),
}


def free_core(seed: int, n: int, q: int) -> FreeParameters:
    rng = np.random.default_rng(seed)
    x_e = rng.normal(size=(n, q))
    x_g = rng.normal(size=(n + q, n))
    log_d = 0.5 * rng.normal(size=q)
    return FreeParameters(x_e, x_g, log_d)


def analysis_gap(core: RecurrenceMatrices, multipliers: np.ndarray, rate: float) -> float:
    """The smallest eigenvalue of the open-loop inequality of docs/theory.md with `M = I`, as it
    stands there."""
    n = len(core.a)
    lam = np.diag(multipliers)
    coupling = -core.f.T @ lam
    contraction = rate**2 * np.eye(n)
    sector = np.block([[contraction, coupling], [-lam @ core.f, 2.0 * lam]])
    moved = np.hstack([core.a, core.e])
    difference = sector - moved.T @ moved
    eigenvalues = np.linalg.eigvalsh(difference)
    return float(eigenvalues[0])


@settings(max_examples=60, deadline=None)
@given(**SIZES)
def test_whatever_the_parameters_the_lmi_holds_and_they_are_found_again(
    seed: int, n: int, q: int, rate: float
) -> None:
    free = free_core(seed, n, q)
    core = matrices_from_parameters(free, rate)
    multipliers = np.exp(-2.0 * free.log_d)
    assert analysis_gap(core, multipliers, rate) > 0
    d = np.exp(free.log_d)
    e = core.e * d
    f = core.f / d[:, None]
    core_found = RecurrenceMatrices(core.a, e, f)
    back = parameters_from_matrices(core_found, rate)
    np.testing.assert_allclose(back.x_e, free.x_e, atol=1e-7, rtol=1e-7)
    np.testing.assert_allclose(back.x_g, free.x_g, atol=1e-7, rtol=1e-7)


def test_a_model_that_does_not_contract_has_no_parameters() -> None:
    free = free_core(0, 3, 2)
    core = matrices_from_parameters(free, 0.9)
    norm = np.linalg.norm(core.a, 2)
    factor = 1.2 / norm
    with pytest.raises(np.linalg.LinAlgError):
        parameters_from_matrices(replace_a(core, factor), 0.9)


def replace_a(core: RecurrenceMatrices, factor: float) -> RecurrenceMatrices:
    a = factor * core.a
    return RecurrenceMatrices(a, core.e, core.f)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), q=st.integers(1, 4))
def test_the_projection_contracts_whatever_it_is_given(seed: int, n: int, q: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    e = rng.normal(size=(n, q))
    f = rng.normal(size=(q, n))
    core = RecurrenceMatrices(a, e, f)
    slope = rng.uniform(0, 1, q)
    found = project_to_contracting(core, slope, 0.95)
    multipliers = np.ones(q)
    assert analysis_gap(transform_to_metric(found), multipliers, 0.95) > 0


def test_the_projection_ends_at_what_the_neurons_did_on_average() -> None:
    """A hardly contracting pair: as the neurons' share shrinks, `A + E diag(slope) F` stays what it
    was."""
    rng = np.random.default_rng(3)
    a = 0.5 * np.eye(2)
    e = 4 * rng.normal(size=(2, 2))
    f = 4 * rng.normal(size=(2, 2))
    core = RecurrenceMatrices(a, e, f)
    slope = np.array([0.2, 0.3])
    loop = core.a + (core.e * slope) @ core.f
    eigenvalues = np.linalg.eigvals(loop)
    spectral_radius = np.abs(eigenvalues).max()
    e = core.e * 0.6 / spectral_radius
    scaled = core._replace(e=e)
    contracting = project_to_contracting(scaled, slope, 0.9)
    found = contracting.core
    largest = np.abs(found.e).max()
    assert largest < np.abs(scaled.e).max()
    mean_slope = np.diag(slope)
    average = scaled.a + scaled.e @ mean_slope @ scaled.f
    eigenvalues = np.linalg.eigvals(average)
    spectral_radius = np.abs(eigenvalues).max()
    average *= min(1.0, 0.99 * 0.9 / spectral_radius)
    mean_slope = np.diag(slope)
    actual = found.a + found.e @ mean_slope @ found.f
    np.testing.assert_allclose(actual, average, atol=1e-12)


def test_a_model_that_contracts_already_is_left_as_it_is() -> None:
    free = free_core(1, 3, 2)
    x_e = 0.2 * free.x_e
    x_g = 0.3 * free.x_g
    parameters = free._replace(x_e=x_e, x_g=x_g)
    core = matrices_from_parameters(parameters, 0.9)
    assert find_contraction_metric(core, 0.9) is not None
    slope = np.full(2, 0.5)
    contracting = project_to_contracting(core, slope, 0.9)
    actual = contracting.core.f
    np.testing.assert_allclose(actual, core.f)
    f = 0.0 * core.f
    blind_core = core._replace(f=f)
    metric = find_contraction_metric(blind_core, 0.9)
    assert metric is not None  # neurons that see nothing
    e = core.e[:, :0]
    f = core.f[:0]
    linear_core = RecurrenceMatrices(core.a, e, f)
    metric = find_contraction_metric(linear_core, 0.9)
    assert metric is not None  # no neurons
    eigenvalues = np.linalg.eigvals(core.a)
    spectral_radius = np.abs(eigenvalues).max()
    factor = 1.5 / spectral_radius
    assert find_contraction_metric(replace_a(core, factor), 0.9) is None


KINDS = ("tanh", "softplus", "clipped_cubic")  # smooth: a difference across a kink is no derivative


def problem(
    seed: int, rate: float | None, integrating_output: bool = False
) -> tuple[SimulationProblem, Theta]:
    rng = np.random.default_rng(seed)
    n = 3
    m = 2
    p = 2
    q = 3
    pairs = [(rng.normal(size=(t, m)), rng.normal(size=(t, p))) for t in (30, 22)]
    lift = TrainablePiecewiseMap(m, 4, 0.1, 1.5)
    knots = 0 if integrating_output else 3
    read = TrainablePiecewiseMap(p, knots, 0.3, 1.0)
    shapes = {"b": (n, m), "c": (p, n), "d": (p, m)}
    shapes |= {"g": (q, m), "h": (p, q), "bias": (q,)}
    theta = {name: 0.5 * rng.normal(size=shape) for name, shape in shapes.items()}
    core = free_core(seed, n, q)
    theta |= core._asdict() if rate else matrices_from_parameters(core, 0.9)._asdict()
    input_parameters = len(lift.parameter_channels)
    scaffold_in = 0.6 * rng.normal(size=input_parameters)
    output_parameters = len(read.parameter_channels)
    scaffold_out = 0.6 * rng.normal(size=output_parameters)
    theta |= {"scaffold_in": scaffold_in, "scaffold_out": scaffold_out}
    states = n + p * integrating_output
    theta["x0"] = rng.normal(size=(2, states))
    records = RecordBatch.from_pairs(pairs)
    one = SimulationProblem(
        records=records,
        neurons=KINDS,
        lift=lift,
        read=read,
        rate=rate,
        integrating_output=integrating_output,
    )
    return one, theta


@pytest.mark.parametrize("rate", [None, 0.95])
@pytest.mark.parametrize("integrating_output", [False, True])
def test_the_jacobian_is_that_of_differences(rate: float | None, integrating_output: bool) -> None:
    """The Jacobian is checked for all blocks at once: the core through its parametrisation, both
    scaffoldings, unequal records, their starts."""
    one, theta = problem(3, rate, integrating_output)
    recurrence = FREE_CORE if rate else CORE
    free = (*recurrence, *"bcdgh", "bias", "scaffold_in", "scaffold_out", "x0")
    flat = pack_parameters(theta, free)
    r, j, turn = one.residual_and_jacobian(theta, free)
    expected = one.weighted_error(theta)
    np.testing.assert_allclose(r, expected, atol=1e-13)
    steps = 1e-6 * np.eye(len(flat))
    ahead, behind = (
        [one.weighted_error(theta | unpack_parameters(flat + s * h, theta, free)) for h in steps]
        for s in (1, -1)
    )
    difference = np.stack(ahead) - np.stack(behind)
    differences = difference.T / 2e-6
    np.testing.assert_allclose(j @ turn, differences, atol=2e-7)


def test_the_gradient_is_that_of_the_adjoint() -> None:
    one, theta = problem(5, None)
    lift = TrainablePiecewiseMap(2, 0, 0.1, 1.0)
    read = TrainablePiecewiseMap(2, 0, 0.1, 1.0)
    one = replace(one, lift=lift, read=read)
    scaffold_in = np.zeros(0)
    scaffold_out = np.zeros(0)
    theta |= {"scaffold_in": scaffold_in, "scaffold_out": scaffold_out}
    free = (*CORE, *"bcdgh", "bias")
    r, j, _ = one.residual_and_jacobian(theta, free)
    by_adjoint = stepped_gradient(one, theta)
    actual = 2 * j.T @ r
    gradients = [by_adjoint[name].ravel() for name in free]
    expected = np.concatenate(gradients)
    np.testing.assert_allclose(actual, expected, rtol=1e-9)


def test_the_ridge_weighs_the_squares_of_the_parameters_that_are_moved() -> None:
    one, theta = problem(0, None)
    free = ("a", "b", "bias", "x0")
    bare = regularised_loss(one, theta, ())
    of_input_matrix = np.square(theta["b"]).sum()
    of_bias = np.square(theta["bias"]).sum()
    squares = float(of_input_matrix + of_bias)  # coordinates and starts are free
    weighed = replace(one, ridge=0.3)
    assert regularised_loss(one, theta, free) == pytest.approx(bare)
    expected = bare + 0.3 * squares
    assert regularised_loss(weighed, theta, free) == pytest.approx(expected)
    descent_loss = regularised_loss(weighed, theta, free)
    at = DescentState(theta=theta, loss=descent_loss, damping=1e-2)
    after = take_step(weighed, at, free)
    expected = regularised_loss(weighed, after.theta, free)
    assert after.loss == pytest.approx(expected)
    assert after.loss < at.loss


def test_a_step_whose_damped_matrix_overflows_has_failed_and_ends_nothing() -> None:
    """An unstable draw: the loss and the normal matrix are finite, not so the matrix times a
    damping."""
    lift = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    read = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    maps = {"lift": lift, "read": read}
    ramp = np.arange(900.0)[:, None]
    pairs = [(np.ones((900, 1)), ramp)]
    records = RecordBatch.from_pairs(pairs)
    one = SimulationProblem(records=records, neurons=(), **maps)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    theta = fit_initial_linear_model(one, 1, False, rng)
    a = np.array([[1.48]])
    begun = theta | {"a": a}
    descent_loss = regularised_loss(one, begun, ())
    at = DescentState(theta=begun, loss=descent_loss, damping=1e6)
    jacobian = one.residual_and_jacobian(begun, ("a",))[1]
    normal = np.square(jacobian).sum()
    assert np.isfinite(at.loss)
    assert np.isfinite(normal)
    with np.errstate(over="ignore"):
        assert not np.isfinite(normal * at.damping)
    after = take_step(one, at, ("a",))
    assert after.theta is begun
    assert after.loss == at.loss


def test_a_refused_step_does_not_end_the_linear_fit_of_a_start() -> None:
    """Records of the motor: a step that suits the largest balanced state overturns one of a six
    hundredth."""
    made = from_yaml("data", "simulated", "validation_samples=20", "test_samples=20")
    plant = from_yaml("plant", "dc_motor")
    excitation = from_yaml("excitation", "aprbs")
    recording = made.build(plant, excitation, 8)
    lift = TrainablePiecewiseMap(1, 16, 0.1, 1.0)
    read = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    maps = {"lift": lift, "read": read}
    batch = RecordBatch.from_pairs(scale_records(recording))
    records = batch.cut_whole_records(2000)
    one = SimulationProblem(records=records, neurons=(), **maps)  # type: ignore[arg-type]
    rng = np.random.default_rng(8)
    begun = fit_initial_linear_model(one, 5, False, rng)
    assert regularised_loss(one, begun, ()) > 0.05
    minimised = minimise_simulation_error(one, begun, ("a", "b", "c"), 15)
    assert minimised.loss < 0.0055
    assert not has_converged(1.0, 1.0, 1.0)
    assert has_converged(1.0, 1.0, DAMPING_RANGE[1])


def test_slow_modes_are_found_where_the_next_sample_hardly_depends_on_the_input() -> None:
    """Time constants of 40 and 25 samples, noise as large as a sample's change, a start far from
    rest."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 1))
    x = np.array([20.0, 10.0])
    y = []
    for v in u:
        y.append([x[0] + rng.normal()])
        slow_mode = 0.975 * x[0] + 0.05 * x[1]
        driven_mode = 0.96 * x[1] + v[0]
        x = np.array([slow_mode, driven_mode])
    standard_deviation = np.std(y)
    y = np.array(y) / standard_deviation
    lift = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    read = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    maps = {"lift": lift, "read": read}
    pairs = [(u, y)]
    records = RecordBatch.from_pairs(pairs)
    one = SimulationProblem(records=records, neurons=(), **maps)  # type: ignore[arg-type]
    begun = fit_initial_linear_model(one, 2, False, rng)
    found = fit_from_random_poles(one, begun, True, rng)
    assert regularised_loss(one, begun, ()) > 0.5
    assert regularised_loss(one, found, ()) < 0.1
    eigenvalues = np.linalg.eigvals(found["a"])
    moduli = sorted(np.abs(eigenvalues))
    for mode, true in zip(moduli, (0.96, 0.975), strict=True):
        assert mode == pytest.approx(true, abs=0.03)


def test_the_projection_leaves_slow_modes_slow() -> None:
    """A model inside the rate already keeps its A; one outside is pulled in by what it must and a
    percent."""
    a = np.diag([0.985, 0.5])
    e = np.full((2, 1), 1e-4)
    f = np.ones((1, 2))
    slow = RecurrenceMatrices(a, e, f)
    slope = np.full(1, 0.5)
    contracting = project_to_contracting(slow, slope, 0.999)
    core = contracting.core
    actual = core.a
    np.testing.assert_allclose(actual, slow.a, atol=1e-12)
    core = replace_a(slow, 1.1)
    slope = np.full(1, 0.5)
    fast = project_to_contracting(core, slope, 0.999)
    core_a = fast.core.a
    eigenvalues = np.linalg.eigvals(core_a)
    spectral_radius = np.abs(eigenvalues).max()
    assert spectral_radius == pytest.approx(0.989, abs=2e-3)


def test_lambda_is_balanced_whatever_stands_on_the_diagonal() -> None:
    """Osborne: off the diagonal, rows and columns of `diag(1/d) G diag(d)` are equally long."""
    rng = np.random.default_rng(0)
    scales = np.geomspace(1, 100, 5)
    gains = rng.uniform(0.1, 10.0, (5, 5)) * scales[:, None]
    d = _balancing_scales(gains + 50.0 * np.eye(5))
    assert d == pytest.approx(_balancing_scales(gains))
    scaled = gains / d[:, None] * d
    np.fill_diagonal(scaled, 0.0)
    norm = np.linalg.norm(scaled, axis=0)
    expected = np.linalg.norm(scaled, axis=1)
    assert norm == pytest.approx(expected, rel=1e-6)


def test_random_poles_decay_over_one_to_the_longest_count_of_samples() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        poles = np.linalg.eigvals(draw_state_matrix(5, rng))
        samples = -1.0 / np.log(np.abs(poles))
        assert (samples > 1 - 1e-9).all()
        upper_limit = LONGEST * (1 + 1e-9)
        assert (samples < upper_limit).all()
        upper_limit = 0.5 * np.pi
        angles = np.abs(np.angle(poles))
        assert (angles <= upper_limit).all()
