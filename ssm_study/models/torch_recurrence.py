"""One simulation law of the linear recurrence, four evaluations of it: convolution, chunks, scan, steps.

    x[k+1] = lambda x[k] + B u[k],    y[k] = Re(C x[k]) + D u[k],    x[0] given      (all modes are decoupled)

Modes are complex numbers; a real mode is one with zero imaginary part, and the factor two of a conjugate pair is
already in `C`. So the response is `y[k] = Re(C lambda^k x0) + sum_j g[k-j] u[j]` with `g[0] = D` and
`g[k] = Re(C lambda^(k-1) B)`.
Shapes: `decay (n,)` complex, the logarithm of lambda; `b (n, m)`, `c (p, n)` complex; `d (p, m)` real; `u (e, T, m)`;
`x0 (e, n)` complex. Convolution takes a leading axis of models on all of them at once.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ssm_study.models.torch_convolution import Convolution, PowerSum
from ssm_study.models.torch_rows import product, whole_lanes

FEW_POWERS = 4096  # below this the many small operations of doubling cost more than the exponentials
CHUNK = 64  # samples per chunk: products of this size keep one core's caches warm


@dataclass(frozen=True, kw_only=True)
class Modes:
    """The recurrence in explicit modal parameters; `decay = log(lambda)` with negative real part."""

    decay: Complex[Tensor, "*models n"]
    b: Complex[Tensor, "*models n m"]
    c: Complex[Tensor, "*models p n"]
    d: Float[Tensor, "*models p m"]


def power_sum(
    weights: Complex[Tensor, "*lead n"], decay: Complex[Tensor, "*models n"], samples: int
) -> Float[Tensor, "*lead T"]:
    """`Re sum_i weights_i lambda_i^k`, k = 0 ... samples - 1, without a table of samples x n.

    Two levels, `k = q s + r`: `lambda^k = lambda^(q s) lambda^r`, so two tables of about sqrt(T) rows and one real
    product. The powers are taken in complex128; the product runs in the precision of `weights`.
    """
    short = whole_lanes(math.isqrt(samples - 1) + 1)
    rows = whole_lanes(-(-samples // short))
    rate = decay.detach().to(torch.complex128)  # `PowerSum` differentiates the tables itself
    fine, coarse = powers(rate, short).to(weights.dtype), powers(rate * short, rows).to(weights.dtype)
    between = (1,) * (weights.dim() - decay.dim())
    fine, coarse = (table.view(*decay.shape[:-1], *between, *table.shape[-2:]) for table in (fine, coarse))
    return PowerSum.apply(weights, decay, fine, coarse).flatten(-2)[..., :samples]


def powers(rate: Complex[Tensor, "*models n"], count: int) -> Complex[Tensor, "*models count n"]:
    """Rows `exp(rate)^k`, k = 0 ... count - 1; large tables by doubling, nine times cheaper than the exponentials."""
    if count * rate.shape[-1] <= FEW_POWERS:
        return torch.exp(torch.arange(count, device=rate.device)[:, None] * rate[..., None, :])
    step = torch.exp(rate)[..., None, :]
    table = torch.ones_like(step)
    while table.shape[-2] < count:
        table, step = torch.cat([table, table * step], -2), step * step
    return table[..., :count, :]


def kernel(modes: Modes, samples: int) -> Float[Tensor, "*models p m T"]:
    """`g[0] = D`, `g[k] = Re(C lambda^(k-1) B)`: the impulse response."""
    weights = product(modes.c[..., :, None, :], modes.b.mT[..., None, :, :])
    tail = power_sum(weights, modes.decay, max(samples - 1, 1))[..., : samples - 1]
    return torch.cat([modes.d[..., None], tail], -1)


def free_response(modes: Modes, x0: Complex[Tensor, "e n"], samples: int) -> Float[Tensor, "e T p"]:
    """`Re(C lambda^k x0)`: what the initial states contribute."""
    return power_sum(x0[:, None, :] * modes.c, modes.decay, samples).transpose(1, 2)


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
    y = convolve(kernel(modes, u.shape[-2]), u)
    return y if x0 is None else y + free_response(modes, x0, u.shape[-2])


def convolve(g: Float[Tensor, "*models p m T"], u: Float[Tensor, "*models e T m"]) -> Float[Tensor, "*models e T p"]:
    """`y[k] = sum_j g[k-j] u[j]` of impulse responses and the inputs from rest."""
    samples = u.shape[-2]
    return Convolution.apply(g, u, fast_length(2 * samples - 1))[0]


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
    experiments, samples, m = u.shape
    blocks = -(-samples // CHUNK)
    padded = torch.nn.functional.pad(u, (0, 0, 0, blocks * CHUNK - samples)).view(experiments, blocks, CHUNK * m)
    rise = (padded @ _lift_matrix(modes).to(padded.dtype)).view(experiments, blocks, 2, -1)
    states = _states(modes.decay * CHUNK, torch.complex(rise[:, :, 0], rise[:, :, 1]), x0)
    within = padded @ _toeplitz(kernel(modes, CHUNK))
    across = torch.cat([states.real, -states.imag], -1) @ _read_matrix(modes)
    return (within + across).view(experiments, blocks * CHUNK, -1)[:, :samples]


def _lift_matrix(modes: Modes) -> Float[Tensor, "sm n2"]:
    """Rows (j, input), columns (Re, Im) of `lambda^(s-1-j) B`: a block's inputs to the state after it."""
    ages = torch.arange(CHUNK - 1, -1, -1, device=modes.decay.device)
    table = torch.exp(ages[:, None] * modes.decay)[:, None, :] * modes.b.T
    return torch.cat([table.real, table.imag], -1).flatten(0, 1)


def _read_matrix(modes: Modes) -> Float[Tensor, "n2 sp"]:
    """Rows (Re, -Im of the state before a block), columns (k, output) of `C lambda^k`."""
    table = (
        torch.exp(modes.decay[:, None] * torch.arange(CHUNK, device=modes.decay.device))[:, :, None]
        * modes.c.T[:, None, :]
    )
    return torch.cat([table.real, table.imag], 0).flatten(1)


def _toeplitz(g: Float[Tensor, "p m s"]) -> Float[Tensor, "sm sp"]:
    """`T[(j, input), (k, output)] = g[output, input, k - j]`, zero above the diagonal of time."""
    lag = torch.arange(CHUNK, device=g.device)[None, :] - torch.arange(CHUNK, device=g.device)[:, None]
    table = torch.where(lag >= 0, g[..., lag.clamp(min=0)], torch.zeros((), dtype=g.dtype, device=g.device))
    return table.permute(2, 1, 3, 0).flatten(2).flatten(0, 1)


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
CHUNKS_FROM_SAMPLES = 4096
"""Measured in benchmarks/models_recurrence.py: chunks win where their products are small and the transforms long."""


def respond(
    modes: Modes, u: Float[Tensor, "*models e T m"], x0: Complex[Tensor, "e n"] | None = None
) -> Float[Tensor, "*models e T p"]:
    """The faster of convolution and chunks for this length and order; both are the same law."""
    chunked = modes.decay.shape[-1] <= CHUNKS_UP_TO_MODES and u.shape[-2] >= CHUNKS_FROM_SAMPLES
    return (by_chunks if chunked else by_convolution)(modes, u, x0)
