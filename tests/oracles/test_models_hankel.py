"""Hankel singular values in closed form against SciPy's Lyapunov solver on the real state space."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov
from torch import Tensor

from ssm_study.models.scaffolds.linear import Linear
from ssm_study.models.scaffolds.scaffold import Frame
from ssm_study.models.spec import on_ring
from ssm_study.models.torch_recurrence import gramians, hankel_singular_values
from ssm_study.models.torch_ssm import LRU, TorchSSM
from ssm_study.training.fit import penalty as weighed


def unit(seed: int, order: int, real_modes: int, m: int, p: int) -> LRU:
    rng = np.random.default_rng(seed)
    return LRU(on_ring(order, real_modes, (0.3, 0.95), (0.2, 2.5), (m, p), rng), feedthrough=False)


@given(
    seed=st.integers(0, 10_000),
    pairs=st.integers(0, 3),
    real=st.integers(1, 2),
    m=st.integers(1, 2),
)
def test_closed_form_equals_lyapunov(seed: int, pairs: int, real: int, m: int) -> None:
    lru = unit(seed, 2 * pairs + real, real, m, 2)
    system = lru.to_state_space()
    w = solve_discrete_lyapunov(system.a, system.b @ system.b.T)
    v = solve_discrete_lyapunov(system.a.T, system.c.T @ system.c)
    expected = np.sqrt(np.sort(np.abs(np.linalg.eigvals(w @ v)))[::-1])
    with torch.no_grad():
        sigma = hankel_singular_values(lru.modes(), lru.reals).numpy()
    np.testing.assert_allclose(sigma, expected, atol=1e-6 * expected[0])


def test_without_the_conjugate_it_is_another_system() -> None:
    """Negative control for the trap: `b b^T / (1 - l_i l_j)` differs as soon as a mode is
    complex."""
    lru = unit(0, 4, 0, 1, 1)
    with torch.no_grad():
        modes = lru.modes()
        turn, b = torch.exp(modes.decay), modes.b
        wrong = (b @ b.mT) / (1 - turn[:, None] * turn[None, :])
        right = gramians(modes, 0)[0][:2, :2]
    assert (wrong - right).abs().max() > 0.1 * right.abs().max()


def summed(lru: LRU) -> Tensor:
    return hankel_singular_values(lru.modes(), lru.reals).sum()


def penalty(lru: LRU) -> Tensor:
    """What a line search relies on: a gradient that leaves out the division by the largest value
    misleads it."""
    frame = Frame(width=1, slopes=(1.0, 1.0), samples=np.zeros((1, 1)))
    through = Linear().build(frame, np.random.default_rng(0))
    model = TorchSSM(through, lru, through)
    return weighed(model, roughness_weight=0.0, hankel_weight=0.1)


@pytest.mark.parametrize("value", [summed, penalty])
def test_the_gradient_agrees_with_finite_differences(value: Callable[[LRU], Tensor]) -> None:
    lru = unit(3, 5, 1, 1, 1)
    value(lru).backward()
    for parameter in (lru.nu, lru.theta, lru.c_real):
        direction = torch.from_numpy(np.random.default_rng(4).normal(size=tuple(parameter.shape)))
        values = []
        with torch.no_grad():
            for step in (1e-5, -2e-5):
                parameter += step * direction
                values.append(value(lru).item())
            parameter += 1e-5 * direction
        assert parameter.grad is not None
        slope = (parameter.grad * direction).sum().item()
        assert slope == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4)
