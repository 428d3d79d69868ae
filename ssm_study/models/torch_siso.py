"""The recurrent unit with one input and one output as a single convolution, from its free parameters to its signal.

The law is that of `torch_convolution`. With few modes the many small calls between free parameters and impulse response
cost more than the transforms: here they are one function, with its derivative written out.
"""

from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ssm_study.models.torch_convolution import interleaved, tables
from ssm_study.models.torch_rows import apart, conjugate_apart, product

LEAST_DAMPING = 1e-8  # per sample: below it the radius rounds to one, and what is stored is not stable


class SisoConvolution(torch.autograd.Function):
    """`y = g * u`, `g[0] = d`, `g[k] = Re sum_i w_i lambda_i^(k-1)`, `w = weight gain (c_real + i c_imag)`.

    `log(lambda) = -exp(nu) + i angle`, `gain = sqrt(1 - |lambda|^2)`. The first modes are real: their angle is `flip`,
    0 or pi, and they have no `c_imag`; `theta` is the angle of the pairs. Shapes: `nu, weight (n,)`, `flip (reals,)`,
    `theta (pairs,)`, `c_real (n, 1)`, `c_imag (pairs, 1)`, `d (1, 1)`, `u (e, T, 1)`, all with the same leading axes
    of models; returns `y (e, T, 1)`; `length` is that of the transforms. Differentiates backward, once.
    """

    @staticmethod
    def forward(
        ctx: Any,
        nu: Tensor,
        theta: Tensor,
        c_real: Tensor,
        c_imag: Tensor,
        d: Tensor,
        u: Tensor,
        flip: Tensor,
        weight: Tensor,
        length: int,
    ) -> Float[Tensor, "*models e T 1"]:
        u, reals, samples = u.squeeze(-1), flip.shape[-1], u.shape[-2]
        if reals:
            theta = torch.cat([flip, theta], -1)
            c_imag = torch.cat([torch.zeros_like(flip).unsqueeze(-1), c_imag], -2)
        damping = torch.exp(nu).clamp_(min=LEAST_DAMPING)
        less = torch.expm1(-2.0 * damping)  # |lambda|^2 - 1
        root = torch.sqrt(-less)
        gain, c = (root * weight).unsqueeze(-1), torch.cat([c_real, c_imag], -1)
        w = torch.view_as_complex(gain * c)
        fine, coarse = tables(torch.complex(-damping, theta), samples)
        fine = interleaved(fine)
        left = (w.unsqueeze(-2) * coarse).conj_physical()  # Re(a b) = Re(conj a) Re b + Im(conj a) Im b
        sums = (interleaved(left) @ fine.mT).flatten(-2)
        g = torch.cat([d.squeeze(-1), sums.narrow(-1, 0, samples - 1)], -1)
        spectrum, lifted = apart(torch.fft.rfft(g, n=length)), torch.fft.rfft(u, n=length)
        y = torch.fft.irfft(spectrum.unsqueeze(-2) * lifted, n=length).narrow(-1, 0, samples)
        ctx.save_for_backward(damping, less, root, weight, gain, c, w, fine, coarse, spectrum, lifted)
        ctx.length, ctx.reals = length, reals
        return y.unsqueeze(-1)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        damping, less, root, weight, gain, c, w, fine, coarse, spectrum, lifted = ctx.saved_tensors
        d_y, short, rows = upstream[0].squeeze(-1), fine.shape[-2], coarse.shape[-2]
        samples, spare = d_y.shape[-1], short * rows - d_y.shape[-1] + 1
        error = torch.fft.rfft(d_y, n=ctx.length)
        d_g = torch.fft.irfft((conjugate_apart(error) * lifted).sum(-2).conj(), n=ctx.length)
        d_u = None
        if ctx.needs_input_grad[5]:
            d_u = conjugate_apart(spectrum).unsqueeze(-2) * error
            d_u = torch.fft.irfft(d_u, n=ctx.length).narrow(-1, 0, samples).unsqueeze(-1)
        tail = torch.nn.functional.pad(d_g.narrow(-1, 1, samples - 1), (0, spare)).unsqueeze(-2)
        table = tail * _ranks(short * rows, tail.dtype, tail.device)
        reached = table.view(*tail.shape[:-2], 2 * rows, short) @ fine
        reached = torch.view_as_complex(reached.view(*tail.shape[:-2], 2, rows, -1, 2))
        plain, ranked = (reached * coarse.unsqueeze(-3)).sum(-2).unbind(-2)  # conj(dL/dw), and with k lambda^k
        d_damping, d_angle = torch.view_as_real(product(w, ranked)).neg().unbind(-1)
        d_w = torch.view_as_real(plain.conj_physical())
        d_root = (d_w * c).sum(-1) * weight
        d_damping = d_damping + d_root / root * (less + 1.0)  # d root = |lambda|^2 / root d damping
        d_nu = (damping * d_damping).masked_fill_(damping <= LEAST_DAMPING, 0.0)
        d_c, d_d, reals = gain * d_w, d_g.narrow(-1, 0, 1).unsqueeze(-1), ctx.reals
        d_c_imag = d_c.narrow(-1, 1, 1)[..., reals:, :]
        return d_nu, d_angle[..., reals:], d_c.narrow(-1, 0, 1), d_c_imag, d_d, d_u, None, None, None


@cache
def _ranks(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "2 k"]:
    """`1` and `k`: the weights of a power and of its derivative by `log(lambda)`."""
    with torch.inference_mode(False):
        ranks = torch.arange(count, dtype=dtype, device=device)
        return torch.stack([torch.ones_like(ranks), ranks])
