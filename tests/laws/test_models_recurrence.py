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
    draw_modes_on_ring,
    estimate_initial_system,
    output_regression_coefficient,
)
from ssm_study.models.torch_ssm import LRU

EVALUATIONS = {
    "convolution": recurrence.simulate_by_convolution,
    "chunks": recurrence.simulate_in_chunks,
}
Evaluation = Callable[..., torch.Tensor]


def by_steps(
    modes: recurrence.ModalForm, u: torch.Tensor, x0: torch.Tensor | None = None
) -> torch.Tensor:
    """One sample after the other, as deployed: the oracle."""
    turn = torch.exp(modes.decay)
    x = torch.zeros(u.shape[0], len(turn), dtype=modes.b.dtype) if x0 is None else x0
    y = []
    for sample in u.unbind(1):
        y.append((x @ modes.c.T).real + sample @ modes.d.T)
        x = turn * x + sample.to(modes.b.dtype) @ modes.b.T
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
    start = draw_modes_on_ring(order, real_modes, radius, frequency, channels, rng)
    return LRU(start, feedthrough=True)


@st.composite
def cases(draw: st.DrawFn) -> tuple[int, int, int, int, int, int]:
    seed = draw(st.integers(0, 10_000))
    m = draw(st.integers(1, 3))
    p = draw(st.integers(1, 3))
    pairs = draw(st.integers(0, 3))
    real = draw(st.integers(0, 3))
    largest = max(2 * pairs + real, 1)
    return (seed, largest, real if 2 * pairs + real else 1, m, p, draw(st.integers(2, 300)))


def drawn(
    seed: int, order: int, real: int, m: int, p: int, samples: int
) -> tuple[LRU, torch.Tensor, torch.Tensor]:
    """Unit, input and initial state; outside the strategy, because what torch loads at its first
    use draws numbers."""
    lru = unit(seed, order, real, m, p)
    rng = np.random.default_rng(seed + 1)
    with torch.no_grad():
        lru.d += torch.from_numpy(rng.normal(size=(p, m)))
    u = torch.from_numpy(rng.normal(size=(2, samples, m)))
    return lru, u, torch.from_numpy(rng.normal(size=(2, order)))


@pytest.mark.parametrize("name", EVALUATIONS)
@given(case=cases())
def test_every_evaluation_agrees_with_stepping(name: str, case: tuple[int, ...]) -> None:
    lru, u, x0 = drawn(*case)
    with torch.no_grad():
        modes = lru.modal_form()
        start = lru.to_modal_state(x0)
        expected = by_steps(modes, u, start)
        actual = EVALUATIONS[name](modes, u, start)
        torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)
        actual = EVALUATIONS[name](modes, u)
        torch.testing.assert_close(actual, by_steps(modes, u), rtol=1e-9, atol=1e-9)


@given(case=cases())
def test_the_real_state_space_is_the_same_system(case: tuple[int, ...]) -> None:
    lru, u, x0 = drawn(*case)
    with torch.no_grad():
        modes = lru.modal_form()
        y = by_steps(modes, u, lru.to_modal_state(x0)).numpy()
    system = lru.to_state_space()
    response = system.simulate(u.numpy(), x0.numpy())
    actual = response[0]
    np.testing.assert_allclose(actual, y, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", EVALUATIONS)
def test_single_precision_stays_within_its_rounding(name: str) -> None:
    radius = (0.9, 0.999)
    lru = unit(1, 16, 2, 1, 1, radius=radius)
    rng = np.random.default_rng(2)
    u = torch.from_numpy(rng.normal(size=(2, 5000, 1)))
    with torch.no_grad():
        modes = lru.modal_form()
        exact = by_steps(modes, u)
        single = EVALUATIONS[name](lru.float().modal_form(), u.float()).double()
    # the modes themselves are rounded to float32: |d lambda| = 6e-8 over a memory of 1000 samples
    largest = (single - exact).abs().max()
    upper_limit = 1e-4 * exact.abs().max()
    assert largest <= upper_limit


@pytest.mark.parametrize("name", EVALUATIONS)
def test_single_precision_adds_little_to_the_rounding_of_slow_modes(name: str) -> None:
    """A memory of 10,000 samples and more: a power of a rounded mode taken in float32 loses its
    phase."""
    radius = (0.9999, 0.99999)
    modes = unit(1, 8, 2, 1, 1, radius=radius).float().modal_form()
    rng = np.random.default_rng(2)
    u = torch.from_numpy(rng.normal(size=(2, 5000, 1))).float()
    parts = {
        part: values.to(torch.promote_types(values.dtype, torch.float64))
        for part, values in vars(modes).items()
    }
    with torch.no_grad():
        modal_form = recurrence.ModalForm(**parts)
        exact = by_steps(modal_form, u.double())
        difference = EVALUATIONS[name](modes, u).double() - exact
        largest = difference.abs().max()
        upper_limit = 2e-6 * exact.abs().max()
        assert largest <= upper_limit


@pytest.mark.parametrize("name", EVALUATIONS)
def test_gradients_agree_with_stepping(name: str) -> None:
    lru = unit(3, 7, 3, 2, 2)
    rng = np.random.default_rng(4)
    u = torch.from_numpy(rng.normal(size=(2, 130, 2)))
    rng = np.random.default_rng(5)
    target = torch.from_numpy(rng.normal(size=(2, 130, 2)))

    def gradient(evaluate: Evaluation) -> list[torch.Tensor]:
        lru.zero_grad()
        difference = evaluate(lru.modal_form(), u) - target
        (difference**2).sum().backward()
        return [p.grad.clone() for p in lru.parameters() if p.grad is not None]

    for one, other in zip(gradient(EVALUATIONS[name]), gradient(by_steps), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


@given(seed=st.integers(0, 10_000))
def test_every_value_of_the_free_parameters_is_stable(seed: int) -> None:
    lru = unit(seed, 6, 2, 1, 1)
    with torch.no_grad():
        for parameter in lru.parameters():
            rng = np.random.default_rng(seed)
            parameter += 3 * torch.from_numpy(rng.normal(size=tuple(parameter.shape)))
        lru.nu[0] = -60.0  # a radius that rounds to one
    assert lru.to_state_space().spectral_radius < 1


@given(seed=st.integers(0, 1000), samples=st.integers(1, 2000))
def test_power_sums_are_the_powers_summed(seed: int, samples: int) -> None:
    rng = np.random.default_rng(seed)
    decay = np.log(rng.uniform(0.1, 0.999, 5)) + 1j * rng.uniform(-np.pi, np.pi, 5)
    weights = rng.normal(size=(2, 5)) + 1j * rng.normal(size=(2, 5))
    direct = (weights @ np.exp(decay[:, None] * np.arange(samples))).real
    fast = recurrence.modal_impulse_response(
        torch.from_numpy(weights), recurrence.power_tables(torch.from_numpy(decay), samples)
    )[:, :samples]
    actual = fast.numpy()
    np.testing.assert_allclose(actual, direct, atol=1e-10)


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("name", ["convolution", "chunks"])
@pytest.mark.parametrize(
    ("m", "p", "samples"), [(1, 1, 17), (2, 3, 70), (1, 1, 1), (2, 1, 2), (1, 1, 64)]
)
def test_the_derivatives_written_out_are_those_of_the_law(
    name: str, m: int, p: int, samples: int, moving: bool
) -> None:
    """Backward, against finite differences."""
    at = _operands(m, p, samples)[: 6 if moving else 5]

    def run(*operands: torch.Tensor) -> torch.Tensor:
        decay, b, c, d, u, *x0 = operands
        modal_form = recurrence.ModalForm(decay=decay, b=b, c=c, d=d)
        return EVALUATIONS[name](modal_form, u, *x0)

    torch.autograd.gradcheck(run, [part.clone().requires_grad_() for part in at], fast_mode=True)


def test_forward_derivatives_are_those_of_the_law() -> None:
    """Vectorised, where `simulate_modal_form` is told so, against stepping."""
    at = _operands(2, 3, 520)
    generator = torch.Generator()
    rng = generator.manual_seed(1)
    push = [torch.randn(4, *part.shape, generator=rng, dtype=part.dtype) for part in at]

    def pushed(law: Evaluation) -> torch.Tensor:
        def run(
            decay: torch.Tensor, b: torch.Tensor, c: torch.Tensor, d: torch.Tensor, *u: torch.Tensor
        ) -> torch.Tensor:
            modal_form = recurrence.ModalForm(decay=decay, b=b, c=c, d=d)
            return law(modal_form, *u)

        return torch.func.vmap(lambda *tangents: torch.func.jvp(run, at, tangents)[1])(*push)

    with recurrence.allow_forward_derivatives():
        found = pushed(recurrence.simulate_modal_form)
    torch.testing.assert_close(found, pushed(by_steps), rtol=1e-9, atol=1e-9)


def _operands(m: int, p: int, samples: int) -> tuple[torch.Tensor, ...]:
    """`decay, b, c, d, u, x0` of two records and three modes."""
    generator = torch.Generator()
    rng = generator.manual_seed(m + p + samples)
    real = torch.rand(3, generator=rng, dtype=torch.float64)
    decay = torch.complex(-0.5 * real - 0.01, 3 * torch.rand(3, generator=rng, dtype=torch.float64))
    b, c, x0 = (
        torch.randn(*s, generator=rng, dtype=torch.complex128) for s in ((3, m), (p, 3), (2, 3))
    )
    shapes = ((p, m), (2, samples, m))
    d, u = (torch.randn(*shape, generator=rng, dtype=torch.float64) for shape in shapes)
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
        u = np.repeat(rng.uniform(-1.7, 1.7, 400 // hold), hold)
        y = np.zeros(400)
        for k in range(400):
            y[k] = 0.8 * y[k - 1] + 0.6 * u[k]
        white_noise = rng.standard_normal((240, 1))
        records = [(u[:240, None], y[:240, None] + 0.001 * white_noise)]
        start = estimate_initial_system(records, order, np.random.default_rng(0), feedthrough)
        made = start.simulate_output(records[0][0])
        largest = np.abs(made).max()
        upper_limit = 10 * np.abs(y).max()
        assert largest < upper_limit
        difference = made - records[0][1]
        norm = np.linalg.norm(difference)
        upper_limit = np.linalg.norm(records[0][1]) * (1 + 1e-9)
        assert norm <= upper_limit
        assert output_regression_coefficient(start, records) >= 0.5
