"""Peers of the recurrence, rewritten from their published code so that one run compares like with
like."""

import torch
from scipy.fft import next_fast_len
from torch import Tensor, nn


def associative_scan(decay: Tensor, rise: Tensor) -> Tensor:
    """`x[k] = decay[k] x[k-1] + rise[k]` over axis 1, by the odd-even recursion of
    `jax.lax.associative_scan`.

    This is the scan of the public PyTorch ports of the LRU (e.g. Gothos/LRU-pytorch, after Orvieto
    et al. 2023): both operands are full `(batch, T, n)` tables.
    """
    return _scan(decay, rise)[1]


def _scan(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    length = a.shape[1]
    if length < 2:
        return a, b
    even_a = a[:, :-1:2]
    odd_a = a[:, 1::2]
    even_b = b[:, :-1:2]
    odd_b = b[:, 1::2]
    half_a, half_b = _scan(odd_a * even_a, odd_a * even_b + odd_b)
    head_a, head_b = (half_a[:, :-1], half_b[:, :-1]) if length % 2 == 0 else (half_a, half_b)
    rest_a = a[:, 2::2]
    rest_b = b[:, 2::2]
    whole_a = torch.cat([a[:, :1], rest_a * head_a], 1)
    whole_b = torch.cat([b[:, :1], rest_a * head_b + rest_b], 1)
    return _interleave(whole_a, half_a), _interleave(whole_b, half_b)


def _interleave(even: Tensor, odd: Tensor) -> Tensor:
    out = even.new_empty(even.shape[0], even.shape[1] + odd.shape[1], *even.shape[2:])
    out[:, 0::2], out[:, 1::2] = even, odd
    return out


class PublicLRU(nn.Module):
    """The LRU layer of the public port: parameters as in Orvieto et al. (2023), states by the
    associative scan."""

    def __init__(self, modes: int, channels: int = 1) -> None:
        super().__init__()
        radius = torch.sqrt(torch.rand(modes) * (0.99**2 - 0.5**2) + 0.5**2)
        self.nu_log = nn.Parameter(torch.log(-torch.log(radius)))
        self.theta_log = nn.Parameter(torch.log(torch.rand(modes) * 1.5 + 0.05))
        self.gamma_log = nn.Parameter(torch.log(torch.sqrt(1 - radius**2)))
        self.b = nn.Parameter(torch.randn(modes, channels, dtype=torch.complex64) / 2**0.5)
        self.c = nn.Parameter(torch.randn(channels, modes, dtype=torch.complex64) / modes**0.5)
        self.d = nn.Parameter(torch.zeros(channels))

    def forward(self, u: Tensor) -> Tensor:
        turn = torch.exp(torch.complex(-torch.exp(self.nu_log), torch.exp(self.theta_log)))
        rise = (u.to(self.b.dtype) @ self.b.T) * torch.exp(self.gamma_log)
        states = associative_scan(turn.expand(1, u.shape[1], -1), rise)
        return (states @ self.c.T).real + self.d * u


class StepLoop(PublicLRU):
    """The same layer by a Python loop over time."""

    def forward(self, u: Tensor) -> Tensor:
        turn = torch.exp(torch.complex(-torch.exp(self.nu_log), torch.exp(self.theta_log)))
        rise = (u.to(self.b.dtype) @ self.b.T) * torch.exp(self.gamma_log)
        x = torch.zeros_like(rise[:, 0])
        states = []
        for sample in rise.unbind(1):
            x = turn * x + sample
            states.append(x)
        return (torch.stack(states, 1) @ self.c.T).real + self.d * u


class Recurrent(nn.Module):
    """torch's own LSTM or GRU with `hidden` states and a linear output."""

    def __init__(self, kind: type[nn.Module], hidden: int) -> None:
        super().__init__()
        self.cell = kind(1, hidden, batch_first=True)
        self.read = nn.Linear(hidden, 1)

    def forward(self, u: Tensor) -> Tensor:
        return self.read(self.cell(u)[0])


class BareFFT(nn.Module):
    """Forward and inverse real FFT of the padded signal, nothing else: what a convolution cannot go
    below."""

    def __init__(self, samples: int) -> None:
        super().__init__()
        self.length = next_fast_len(2 * samples - 1, real=True)
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, u: Tensor) -> Tensor:
        spectrum = torch.fft.rfft(u[..., 0] * self.gain, n=self.length)
        return torch.fft.irfft(spectrum, n=self.length)[..., : u.shape[1], None]


class DynoNetFilter(nn.Module):
    """dynoNet's transfer function of `order` (package dynonet): SciPy's filter forward, its
    sensitivities back."""

    def __init__(self, order: int) -> None:
        super().__init__()
        from dynonet.lti import SisoLinearDynamicalOperator

        self.filter = SisoLinearDynamicalOperator(n_b=order, n_a=order, n_k=1)

    def forward(self, u: Tensor) -> Tensor:
        return self.filter(u)
