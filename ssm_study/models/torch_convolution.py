"""The recurrence as a convolution: impulse response and spectra, their derivatives written out in one function.

Autograd would take 400 calls for it, and complex transforms where real ones do.
"""

import math
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ssm_study.models.torch_rows import apart, product, whole_lanes

FEW_POWERS = 4096  # below this the many small operations of doubling cost more than the exponentials
LEAST_ROWS = 16  # smaller products of matrices are computed in another way in a batch, and round differently
Tables = tuple[Complex[Tensor, "*models s n"], Complex[Tensor, "*models q n"]]
"""`F_ri = lambda_i^r` and `C_qi = lambda_i^(s q)`, so that `lambda^k = C_q F_r` with `k = q s + r`."""


def tables(decay: Complex[Tensor, "*models n"], samples: int) -> Tables:
    """About sqrt(samples) rows each, whole lanes of them; the powers are taken in complex128."""
    short = max(whole_lanes(math.isqrt(samples - 1) + 1), LEAST_ROWS)
    rows = max(whole_lanes(-(-samples // short)), LEAST_ROWS)
    rate = decay.to(torch.complex128)
    return powers(rate, short).to(decay.dtype), powers(rate * short, rows).to(decay.dtype)


def powers(rate: Complex[Tensor, "*models n"], count: int) -> Complex[Tensor, "*models count n"]:
    """Rows `exp(rate)^k`, k = 0 ... count - 1; large tables by doubling, nine times cheaper than the exponentials."""
    if count * rate.shape[-1] <= FEW_POWERS:
        return torch.exp(torch.arange(count, device=rate.device)[:, None] * rate[..., None, :])
    step = torch.exp(rate)[..., None, :]
    table = torch.ones_like(step)
    while table.shape[-2] < count:
        table, step = torch.cat([table, table * step], -2), step * step
    return table[..., :count, :]


def power_sums(weights: Complex[Tensor, "*models r n"], both: Tables) -> Float[Tensor, "*models r T"]:
    """`Re sum_i weights_i lambda_i^k` without a table of samples x n: one real product of the two tables."""
    fine, coarse = (table[..., None, :, :] for table in both)
    left = interleaved(weights[..., None, :] * coarse)
    return (left @ interleaved(torch.complex(fine.real, -fine.imag)).mT).flatten(-2)


def power_sums_back(
    upstream: Float[Tensor, "*models r T"], weights: Complex[Tensor, "*models r n"], both: Tables
) -> tuple[Complex[Tensor, "*models r n"], Complex[Tensor, "*models n"]]:
    """Conjugates of the loss by `weights` and by `decay = log(lambda)`, which weighs each term with its power."""
    fine, coarse = (table[..., None, :, :] for table in both)
    ranks = torch.arange(upstream.shape[-1], dtype=upstream.dtype, device=upstream.device)
    table = torch.stack([upstream, ranks * upstream], -2).unflatten(-1, (coarse.shape[-2], -1))
    reached = torch.view_as_complex((table @ interleaved(fine)[..., None, :, :]).unflatten(-1, (-1, 2)))
    plain, ranked = (reached * coarse[..., None, :, :]).sum(-2).unbind(-2)
    return plain, product(weights, ranked).sum(-2)


def interleaved(table: Complex[Tensor, "*b k n"]) -> Float[Tensor, "*b k n2"]:
    """Real and imaginary parts side by side, without a copy."""
    return torch.view_as_real(table).flatten(-2)


class Convolution(torch.autograd.Function):
    """`y[k] = Re(C lambda^k x0) + sum_j g[k-j] u[j]`, `g[0] = D`, `g[k] = Re(C lambda^(k-1) B)`.

    `decay (n,)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, `u (e, T, m)`, all with the same leading axes of models;
    `x0 (e, n)` or None, for one model. Returns `y (e, T, p)`; `length` is that of the transforms. Backward, once.
    """

    @staticmethod
    def forward(
        ctx: Any, decay: Tensor, b: Tensor, c: Tensor, d: Tensor, u: Tensor, x0: Tensor | None, length: int
    ) -> Float[Tensor, "*models e T p"]:
        samples, free = u.shape[-2], None
        both, weights = tables(decay, samples), _weights(b, c, x0)
        sums = power_sums(weights, both)
        g = impulse_response(d, sums, samples)
        spectrum, lifted = apart(torch.fft.rfft(g, n=length)), apart(torch.fft.rfft(u.mT, n=length))
        y = torch.fft.irfft(mixed(spectrum, lifted), n=length)[..., :samples].mT
        if x0 is not None:
            free = sums[d.numel() :, :samples].view(len(x0), len(d), -1).mT
        ctx.save_for_backward(b, c, x0, weights, *both, spectrum, lifted)
        ctx.samples, ctx.length = samples, length
        return y if free is None else y + free

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        b, c, x0, weights, fine, coarse, spectrum, lifted = ctx.saved_tensors
        d_y = upstream[0].mT
        error = torch.fft.rfft(d_y, n=ctx.length)
        d_g = torch.fft.irfft(_correlated(error, lifted), n=ctx.length)[..., : ctx.samples]
        d_u = None
        if ctx.needs_input_grad[4]:
            d_u = mixed(spectrum.transpose(-3, -2), error.conj()).conj()
            d_u = torch.fft.irfft(d_u, n=ctx.length)[..., : ctx.samples].mT
        full = fine.shape[-2] * coarse.shape[-2]
        rows = torch.nn.functional.pad(d_g[..., 1:], (0, full - ctx.samples + 1)).flatten(-3, -2)
        if x0 is not None:
            rows = torch.cat([rows, torch.nn.functional.pad(d_y, (0, full - ctx.samples)).flatten(0, 1)])
        d_weights, d_decay = power_sums_back(rows, weights, (fine, coarse))
        d_b, d_c, d_x0 = _weights_back(d_weights, b, c, x0)
        return d_decay.conj_physical(), d_b, d_c, d_g[..., 0], d_u, d_x0, None


def impulse_response(
    d: Float[Tensor, "*models p m"], sums: Float[Tensor, "*models r K"], samples: int
) -> Float[Tensor, "*models p m T"]:
    """`h[0] = D, h[t] = C lambda^(t-1) B`, cut from the sums that the two-level kernel makes."""
    p, m = d.shape[-2:]
    tail = sums[..., : p * m, : samples - 1]
    return torch.cat([d.flatten(-2)[..., None], tail], -1).unflatten(-2, (p, m))


def _weights(
    b: Complex[Tensor, "*models n m"], c: Complex[Tensor, "*models p n"], x0: Complex[Tensor, "e n"] | None
) -> Complex[Tensor, "*models r n"]:
    """Of each impulse response, rows (output, input); then of what each initial state leaves, rows (record, output)."""
    weights = product(c[..., :, None, :], b.mT[..., None, :, :]).flatten(-3, -2)
    return weights if x0 is None else torch.cat([weights, (x0[:, None, :] * c).flatten(0, 1)])


def _weights_back(
    upstream: Complex[Tensor, "*models r n"],
    b: Complex[Tensor, "*models n m"],
    c: Complex[Tensor, "*models p n"],
    x0: Complex[Tensor, "e n"] | None,
) -> tuple[Complex[Tensor, "*models n m"], Complex[Tensor, "*models p n"], Complex[Tensor, "e n"] | None]:
    """The loss by `b`, `c` and `x0`, from the conjugate of that by the weights."""
    p, m = c.shape[-2], b.shape[-1]
    of_kernel, d_x0 = upstream[..., : p * m, :].unflatten(-2, (p, m)), None
    d_b = product(of_kernel, c[..., :, None, :]).sum(-3).conj_physical()
    d_c = product(of_kernel, b.mT[..., None, :, :]).sum(-2)
    if x0 is not None:
        of_start = upstream[p * m :].unflatten(0, (len(x0), p))
        d_c, d_x0 = d_c + (of_start * x0[:, None]).sum(0), (of_start * c).sum(1).conj_physical()
    return d_b.mT, d_c.conj_physical(), d_x0


def _correlated(
    error: Complex[Tensor, "*models e p f"], lifted: Complex[Tensor, "*models e m f"]
) -> Complex[Tensor, "*models p m f"]:
    """Summed over the records; a plain product for one channel each."""
    if error.shape[-2] == lifted.shape[-2] == 1:
        return (error.conj() * lifted).sum(-3, keepdim=True).conj()  # a conjugate of `lifted` would lose its gaps
    return torch.einsum("...epf,...emf->...pmf", error, lifted.conj())


def mixed(
    spectrum: Complex[Tensor, "*models p m f"], lifted: Complex[Tensor, "*models e m f"]
) -> Complex[Tensor, "*models e p f"]:
    """One matrix per frequency; a plain product for one channel each."""
    if spectrum.shape[-3:-1] == (1, 1):
        return spectrum * lifted
    return torch.einsum("...pmf,...emf->...epf", spectrum, lifted)
