"""One simulation law of the linear recurrence, four evaluations of it: convolution, chunks, scan, steps.

    x[k+1] = lambda x[k] + B u[k],    y[k] = Re(C x[k]) + D u[k],    x[0] given      (all modes are decoupled)

Modes are complex numbers; a real mode is one with zero imaginary part, and the factor two of a conjugate pair is
already in `C`. So the response is `y[k] = Re(C lambda^k x0) + sum_j g[k-j] u[j]` with `g[0] = D` and
`g[k] = Re(C lambda^(k-1) B)`.
Shapes: `decay (n,)` complex, the logarithm of lambda; `b (n, m)`, `c (p, n)` complex; `d (p, m)` real; `u (e, T, m)`;
`x0 (e, n)` complex. Convolution takes a leading axis of models on all of them at once.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ssm_study.models.torch_chunks import Chunks
from ssm_study.models.torch_convolution import Convolution, impulse_response, mixed, power_sums, powers, tables


@dataclass(frozen=True, kw_only=True)
class Modes:
    """The recurrence in explicit modal parameters; `decay = log(lambda)` with negative real part."""

    decay: Complex[Tensor, "*models n"]
    b: Complex[Tensor, "*models n m"]
    c: Complex[Tensor, "*models p n"]
    d: Float[Tensor, "*models p m"]


def end_state(
    modes: Modes, u: Float[Tensor, "e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Complex[Tensor, "e n"]:
    """`x[T] = lambda^T x0 + sum_j lambda^(T-1-j) B u[j]`: where the recurrence stands after the last sample."""
    samples, rate = u.shape[1], modes.decay.to(torch.complex128)
    ages = powers(rate, samples).flip(0).to(modes.b.dtype)
    moments = torch.complex(u.transpose(1, 2) @ ages.real, u.transpose(1, 2) @ ages.imag)
    x = (moments * modes.b.T).sum(1)
    return x if x0 is None else x + torch.exp(rate * samples).to(x.dtype) * x0


def by_convolution(
    modes: Modes, u: Float[Tensor, "*models e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "*models e T p"]:
    """Product of spectra with zero padding; O(T log T), the cost nearly independent of n."""
    length = fast_length(2 * u.shape[-2] - 1)
    return Convolution.apply(modes.decay, modes.b, modes.c, modes.d, u, x0, length)


def by_plain_convolution(
    modes: Modes, u: Float[Tensor, "e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "e T p"]:
    """The same in torch's own operations: slower, but differentiable forward, vectorised and any number of times."""
    samples = u.shape[-2]
    both, length = tables(modes.decay, samples), fast_length(2 * samples - 1)
    weights = (modes.c[:, None] * modes.b.mT).flatten(0, 1)
    g = impulse_response(modes.d, power_sums(weights, both), samples)
    y = torch.fft.irfft(mixed(torch.fft.rfft(g, n=length), torch.fft.rfft(u.mT, n=length)), n=length)[..., :samples]
    if x0 is not None:
        free = power_sums((x0[:, None] * modes.c).flatten(0, 1), both)[:, :samples]
        y = y + free.unflatten(0, (len(x0), -1))
    return y.mT


@cache
def fast_length(samples: int) -> int:
    """The next length of the form 2^a 3^b 5^c: transforms of other lengths are several times slower."""
    best = 1 << max(samples - 1, 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            rest = -(-samples // three)
            best = min(best, three << max(rest - 1, 0).bit_length())
            three *= 3
        five *= 5
    return best


def by_chunks(
    modes: Modes, u: Float[Tensor, "e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "e T p"]:
    """Blocks of 64 samples as matrix products; the states between blocks follow the same law, 64 times slower."""
    return Chunks.apply(modes.decay, modes.b, modes.c, modes.d, u, x0)


def _states(
    decay: Complex[Tensor, "n"], rise: Complex[Tensor, "e q n"], x0: Complex[Tensor, "e n"] | None
) -> Complex[Tensor, "e q n"]:
    """`x[k]` for k = 0 ... q - 1 of `x[k+1] = lambda x[k] + rise[k]` by doubling: log2(q) passes over the table."""
    first = torch.zeros_like(rise[:, :1]) if x0 is None else x0[:, None]
    x, shift = torch.cat([first, rise[:, :-1]], 1), 1
    while shift < x.shape[1]:
        x = torch.cat([x[:, :shift], x[:, shift:] + torch.exp(decay * shift) * x[:, :-shift]], 1)
        shift *= 2
    return x


def by_scan(
    modes: Modes, u: Float[Tensor, "e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "e T p"]:
    """All states by doubling, then read: the parallel scan, with its T x n table."""
    x = _states(modes.decay, u.to(modes.b.dtype) @ modes.b.T, x0)
    return (x @ modes.c.T).real + u @ modes.d.T


def by_steps(
    modes: Modes, u: Float[Tensor, "e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "e T p"]:
    """One sample after the other, as deployed; the reference the other evaluations are tested against."""
    turn = torch.exp(modes.decay)
    x = torch.zeros(u.shape[0], len(turn), dtype=modes.b.dtype, device=u.device) if x0 is None else x0
    y = []
    for sample in u.unbind(1):
        y.append((x @ modes.c.T).real + sample @ modes.d.T)
        x = turn * x + sample.to(modes.b.dtype) @ modes.b.T
    return torch.stack(y, 1)


CHUNKS_UP_TO_MODES = 16
CHUNKS_FROM_SAMPLES = 3000
"""Measured in benchmarks/models_recurrence.py: chunks win where their products are small and the transforms long."""


_FORWARD = ContextVar("derivatives are taken forward", default=False)


@contextmanager
def forward_derivatives() -> Iterator[None]:
    """Within it `respond` and `LRU` keep to operations that differentiate forward and vectorised."""
    token = _FORWARD.set(True)
    try:
        yield
    finally:
        _FORWARD.reset(token)


def one_convolution(modes: int, samples: int) -> bool:
    """Whether `respond` takes the convolution with its derivative written out."""
    return not _FORWARD.get() and not _chunked(modes, samples)


def _chunked(modes: int, samples: int) -> bool:
    return modes <= CHUNKS_UP_TO_MODES and samples >= CHUNKS_FROM_SAMPLES


def respond(
    modes: Modes, u: Float[Tensor, "*models e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "*models e T p"]:
    """The faster of convolution and chunks for this length and order; both are the same law."""
    if _FORWARD.get():
        return by_plain_convolution(modes, u, x0)
    chunked = _chunked(modes.decay.shape[-1], u.shape[-2])
    return (by_chunks if chunked else by_convolution)(modes, u, x0)
