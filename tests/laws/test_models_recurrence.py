"""One law, two evaluations: convolution and chunks agree with plain stepping, and with the real
state space."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.models import torch_recurrence as recurrence
from ssm_study.models.initial_system import (
    draw_stable_system,
    estimate_initial_system,
    output_regression_coefficient,
    realise_impulse_response,
)
from ssm_study.models.torch_ssm import LRU

EVALUATIONS = {
    "convolution": recurrence.simulate_by_convolution,
    "chunks": recurrence.simulate_in_blocks,
}
Evaluation = Callable[..., torch.Tensor]


def draw_normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    """Independent standard normal numbers in double precision."""
    values = rng.normal(size=shape)
    return torch.from_numpy(values)


def by_steps(
    modes: recurrence.ModalForm, u: torch.Tensor, x0: torch.Tensor | None = None
) -> torch.Tensor:
    """One sample after the other, as deployed: the oracle."""
    turn = torch.exp(modes.decay)
    if x0 is None:
        x0 = torch.zeros(u.shape[0], len(turn), dtype=modes.b.dtype)
    x = x0
    y = []
    for sample in u.unbind(1):
        output_matrix = modes.c.T
        state_part = x @ output_matrix
        direct_part = sample @ modes.d.T
        output = state_part.real + direct_part
        y.append(output)
        dtype = modes.b.dtype
        input_part = sample.to(dtype) @ modes.b.T
        x = turn * x + input_part
    return torch.stack(y, 1)


def unit(
    seed: int,
    order: int,
    real_modes: int,
    m: int,
    p: int,
    radius: tuple[float, float] = (0.3, 0.99),
) -> LRU:
    rng = np.random.default_rng(seed)
    frequency = (0.05, 2.0)
    channels = (m, p)
    start = draw_stable_system(order, real_modes, radius, frequency, channels, rng)
    return LRU(start, feedthrough=True)


@st.composite
def cases(draw: st.DrawFn) -> tuple[int, int, int, int, int, int]:
    seeds = st.integers(0, 10_000)
    seed = draw(seeds)
    widths = st.integers(1, 3)
    m = draw(widths)
    p = draw(widths)
    numbers_of_modes = st.integers(0, 3)
    pairs = draw(numbers_of_modes)
    real = draw(numbers_of_modes)
    order = max(2 * pairs + real, 1)
    real_modes = order - 2 * pairs
    lengths = st.integers(2, 300)
    samples = draw(lengths)
    return (seed, order, real_modes, m, p, samples)


def drawn(
    seed: int, order: int, real: int, m: int, p: int, samples: int
) -> tuple[LRU, torch.Tensor, torch.Tensor]:
    """Unit, input and initial state; outside the strategy, because what torch loads at its first
    use draws numbers."""
    lru = unit(seed, order, real, m, p)
    rng = np.random.default_rng(seed + 1)
    with torch.no_grad():
        direct_part = draw_normal(rng, p, m)
        lru.d += direct_part
    u = draw_normal(rng, 2, samples, m)
    x0 = draw_normal(rng, 2, order)
    return lru, u, x0


@pytest.mark.parametrize("name", EVALUATIONS)
@given(case=cases())
def test_every_evaluation_agrees_with_stepping(name: str, case: tuple[int, ...]) -> None:
    lru, u, x0 = drawn(*case)
    with torch.no_grad():
        modes = lru.modal_form()
        start = lru.to_modal_state(x0)
        stepped = by_steps(modes, u, start)
        stepped_from_zero = by_steps(modes, u)
        evaluate = EVALUATIONS[name]
        evaluated = evaluate(modes, u, start)
        evaluated_from_zero = evaluate(modes, u)

    torch.testing.assert_close(evaluated, stepped, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(evaluated_from_zero, stepped_from_zero, rtol=1e-9, atol=1e-9)


@given(case=cases())
def test_the_real_state_space_is_the_same_system(case: tuple[int, ...]) -> None:
    lru, u, x0 = drawn(*case)
    with torch.no_grad():
        modes = lru.modal_form()
        start = lru.to_modal_state(x0)
        stepped_outputs = by_steps(modes, u, start)
        stepped = stepped_outputs.numpy()
    system = lru.to_state_space()

    inputs = u.numpy()
    start_states = x0.numpy()
    simulated, _ = system.simulate(inputs, start_states)

    np.testing.assert_allclose(simulated, stepped, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", EVALUATIONS)
def test_single_precision_stays_within_its_rounding(name: str) -> None:
    radius = (0.9, 0.999)
    lru = unit(1, 16, 2, 1, 1, radius=radius)
    rng = np.random.default_rng(2)
    u = draw_normal(rng, 2, 5000, 1)
    evaluate = EVALUATIONS[name]

    with torch.no_grad():
        exact = by_steps(lru.modal_form(), u)
        rounded = lru.float()
        rounded_modes = rounded.modal_form()
        rounded_u = u.float()
        rounded_output = evaluate(rounded_modes, rounded_u)
        single = rounded_output.double()

    # the modes themselves are rounded to float32: |d lambda| = 6e-8 over a memory of 1000 samples
    error = (single - exact).abs()
    largest_error = error.max()
    largest_output = exact.abs().max()
    assert largest_error <= 1e-4 * largest_output


@pytest.mark.parametrize("name", EVALUATIONS)
def test_single_precision_adds_little_to_the_rounding_of_slow_modes(name: str) -> None:
    """A memory of 10,000 samples and more: a power of a rounded mode taken in float32 loses its
    phase."""
    radius = (0.9999, 0.99999)
    lru = unit(1, 8, 2, 1, 1, radius=radius)
    rounded = lru.float()
    modes = rounded.modal_form()
    rng = np.random.default_rng(2)
    u = draw_normal(rng, 2, 5000, 1).float()
    double_parts = {}
    for part, values in vars(modes).items():
        dtype = torch.promote_types(values.dtype, torch.float64)
        double_parts[part] = values.to(dtype)
    double_modes = recurrence.ModalForm(**double_parts)
    evaluate = EVALUATIONS[name]

    with torch.no_grad():
        exact = by_steps(double_modes, u.double())
        single_output = evaluate(modes, u)
        single = single_output.double()

    error = (single - exact).abs()
    largest_error = error.max()
    largest_output = exact.abs().max()
    assert largest_error <= 2e-6 * largest_output


@pytest.mark.parametrize("name", EVALUATIONS)
def test_gradients_agree_with_stepping(name: str) -> None:
    lru = unit(3, 7, 3, 2, 2)
    rng = np.random.default_rng(4)
    u = draw_normal(rng, 2, 130, 2)
    target_rng = np.random.default_rng(5)
    target = draw_normal(target_rng, 2, 130, 2)

    def gradient(evaluate: Evaluation) -> list[torch.Tensor]:
        lru.zero_grad()
        modal_form = lru.modal_form()
        output = evaluate(modal_form, u)
        squared_errors = (output - target) ** 2
        loss = squared_errors.sum()
        loss.backward()
        return [p.grad.clone() for p in lru.parameters() if p.grad is not None]

    by_evaluation = gradient(EVALUATIONS[name])
    by_stepping = gradient(by_steps)
    for ours, oracle in zip(by_evaluation, by_stepping, strict=True):
        torch.testing.assert_close(ours, oracle, rtol=1e-8, atol=1e-8)


SEEDS = st.integers(0, 10_000)


@given(seed=SEEDS)
def test_every_value_of_the_free_parameters_is_stable(seed: int) -> None:
    lru = unit(seed, 6, 2, 1, 1)
    with torch.no_grad():
        for parameter in lru.parameters():
            rng = np.random.default_rng(seed)
            change = draw_normal(rng, *parameter.shape)
            parameter += 3 * change
        lru.nu[0] = -60.0  # a radius that rounds to one
    system = lru.to_state_space()
    assert system.spectral_radius < 1


FEWER_SEEDS = st.integers(0, 1000)
LENGTHS = st.integers(1, 2000)


@given(seed=FEWER_SEEDS, samples=LENGTHS)
def test_power_sums_are_the_powers_summed(seed: int, samples: int) -> None:
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.1, 0.999, 5)
    angle = rng.uniform(-np.pi, np.pi, 5)
    log_radius = np.log(radius)
    decay = log_radius + 1j * angle
    shape = (2, 5)
    real_part = rng.normal(size=shape)
    imaginary_part = rng.normal(size=shape)
    weights = real_part + 1j * imaginary_part
    exponents = decay[:, None] * np.arange(samples)
    powers = np.exp(exponents)
    summed = (weights @ powers).real

    decay_tensor = torch.from_numpy(decay)
    tables = recurrence.power_tables(decay_tensor, samples)
    weights_tensor = torch.from_numpy(weights)
    response = recurrence.modal_impulse_response(weights_tensor, tables)

    responses = response[:, :samples].numpy()
    np.testing.assert_allclose(responses, summed, atol=1e-10)


SIZES = [(1, 1, 17), (2, 3, 70), (1, 1, 1), (2, 1, 2), (1, 1, 64)]


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("name", ["convolution", "chunks"])
@pytest.mark.parametrize(("m", "p", "samples"), SIZES)
def test_the_derivatives_written_out_are_those_of_the_law(
    name: str, m: int, p: int, samples: int, moving: bool
) -> None:
    """Backward, against finite differences."""
    parts = _operands(m, p, samples)
    points = [part.clone().requires_grad_() for part in parts[: 6 if moving else 5]]

    def run(*operands: torch.Tensor) -> torch.Tensor:
        decay, b, c, d, u, *x0 = operands
        modal_form = recurrence.ModalForm(decay=decay, b=b, c=c, d=d)
        return EVALUATIONS[name](modal_form, u, *x0)

    torch.autograd.gradcheck(run, points, fast_mode=True)


def test_forward_derivatives_are_those_of_the_law() -> None:
    """Vectorised, where `simulate_modal_form` is told so, against stepping."""
    operands = _operands(2, 3, 520)
    generator = torch.Generator().manual_seed(1)
    directions = [
        torch.randn(4, *part.shape, generator=generator, dtype=part.dtype) for part in operands
    ]

    def directional_derivatives(law: Evaluation) -> torch.Tensor:
        def run(
            decay: torch.Tensor, b: torch.Tensor, c: torch.Tensor, d: torch.Tensor, *u: torch.Tensor
        ) -> torch.Tensor:
            modal_form = recurrence.ModalForm(decay=decay, b=b, c=c, d=d)
            return law(modal_form, *u)

        def derivative(*tangents: torch.Tensor) -> torch.Tensor:
            _, change = torch.func.jvp(run, operands, tangents)
            return change

        return torch.func.vmap(derivative)(*directions)

    with recurrence.allow_forward_derivatives():
        simulated = directional_derivatives(recurrence.simulate_modal_form)
    stepped = directional_derivatives(by_steps)
    torch.testing.assert_close(simulated, stepped, rtol=1e-9, atol=1e-9)


def _operands(m: int, p: int, samples: int) -> tuple[torch.Tensor, ...]:
    """`decay, b, c, d, u, x0` of two records and three modes."""
    generator = torch.Generator().manual_seed(m + p + samples)

    def draw_real(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def draw_gaussian(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    damping = -0.5 * draw_real(3) - 0.01
    frequency = 3 * draw_real(3)
    decay = torch.complex(damping, frequency)
    b = draw_gaussian(3, m, dtype=torch.complex128)
    c = draw_gaussian(p, 3, dtype=torch.complex128)
    x0 = draw_gaussian(2, 3, dtype=torch.complex128)
    d = draw_gaussian(p, m)
    u = draw_gaussian(2, samples, m)
    return decay, b, c, d, u, x0


@pytest.mark.parametrize("hold", [1, 8])
@pytest.mark.parametrize("order", [2, 6])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_a_start_is_nearer_to_its_records_than_no_model(
    hold: int, order: int, feedthrough: bool
) -> None:
    """Where the input acts at once, a long ARX model without feedthrough is unstable: its start
    answered thousandfold, and training ended at a fit of -55,000 %."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        levels = rng.uniform(-1.7, 1.7, 400 // hold)
        u = np.repeat(levels, hold)
        y = np.zeros(400)
        for k in range(400):
            y[k] = 0.8 * y[k - 1] + 0.6 * u[k]
        white_noise = rng.standard_normal((240, 1))
        training_u = u[:240, None]
        training_y = y[:240, None] + 0.001 * white_noise
        records = [(training_u, training_y)]

        start_rng = np.random.default_rng(0)
        start = estimate_initial_system(records, order, start_rng, feedthrough)
        simulated = start.simulate_output(training_u)

        largest_output = np.abs(simulated).max()
        largest_record = np.abs(y).max()
        assert largest_output < 10 * largest_record
        remaining_error = np.linalg.norm(simulated - training_y)
        without_model = np.linalg.norm(training_y)
        assert remaining_error <= without_model * (1 + 1e-9)
        assert output_regression_coefficient(start, records) >= 0.5


@pytest.mark.parametrize("seed", range(5))
def test_modes_that_a_response_does_not_show_are_forgotten_within_samples(seed: int) -> None:
    lags = np.arange(40.0)
    powers = 0.8**lags
    h = powers[:, None, None]
    rng = np.random.default_rng(seed)
    system = realise_impulse_response(h, 6, rng)
    poles = np.linalg.eigvals(system.a)
    moduli = np.abs(poles)
    sizes = np.sort(moduli)
    assert sizes[-1] == pytest.approx(0.8, abs=1e-4)
    assert sizes[-2] <= 0.4
