"""The two costly steps of the convolution, each with its derivative written out: autograd would take 400 calls for it.

Both support backward, forward (`torch.func.jvp`) and vectorised (`vmap`) differentiation once; not twice.
"""

import inspect
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ssm_study.models.torch_rows import apart, product


class PowerSum(torch.autograd.Function):
    """`S[q s + r] = Re sum_i w_i C_qi F_ri` with `F_ri = lambda_i^r`, `C_qi = lambda_i^(s q)`, s rows in `fine`.

    The tables are functions of `decay = log(lambda)` whose derivative is taken here: `dS/d decay_i` weighs each term
    with its power `q s + r`. `w (*models, *lead, n)`, result `(*models, *lead, rows of C, rows of F)`; the tables have
    axes of length one for `lead`.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(
        weights: Complex[Tensor, "*c n"],
        decay: Complex[Tensor, "*models n"],  # noqa: ARG004 - the tables hold it
        fine: Complex[Tensor, "*b s n"],
        coarse: Complex[Tensor, "*b q n"],
    ) -> Float[Tensor, "*c q s"]:
        return _real_product(weights[..., None, :] * coarse, fine)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:  # noqa: ARG004
        weights, decay, fine, coarse = inputs
        ctx.models = decay.dim() - 1
        ctx.save_for_backward(weights, fine, coarse)
        ctx.save_for_forward(weights, fine, coarse)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights, fine, coarse = ctx.saved_tensors
        both = torch.stack([upstream[0], _ranks(upstream[0]) * upstream[0]], -3)
        reached = both @ _interleaved(fine)[..., None, :, :]
        plain, ranked = (
            (torch.view_as_complex(reached.unflatten(-1, (-1, 2))) * coarse[..., None, :, :]).sum(-2).unbind(-2)
        )
        d_decay = product(weights, ranked)
        lead = tuple(range(ctx.models, d_decay.dim() - 1))
        return plain.conj(), (d_decay.sum(lead) if lead else d_decay).conj(), None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        weights, fine, coarse = ctx.saved_tensors
        moved = torch.zeros((), device=weights.device)
        if tangents[0] is not None:
            moved = moved + _real_product(tangents[0][..., None, :] * coarse, fine)
        if tangents[1] is not None:
            d_decay = tangents[1].view(*tangents[1].shape[:-1], *(1,) * (weights.dim() - ctx.models - 1), -1)
            turned = _real_product((weights * d_decay)[..., None, :] * coarse, fine)
            moved = moved + _ranks(turned) * turned
        return moved


def _real_product(left: Complex[Tensor, "*c q n"], fine: Complex[Tensor, "*b s n"]) -> Float[Tensor, "*c q s"]:
    """`Re(left fine^T)` as one real product."""
    return _interleaved(left) @ _interleaved(fine.conj_physical()).mT


def _interleaved(table: Complex[Tensor, "*b k n"]) -> Float[Tensor, "*b k n2"]:
    """Real and imaginary parts side by side, without a copy."""
    return torch.view_as_real(table).flatten(-2)


def _ranks(table: Float[Tensor, "*c q s"]) -> Float[Tensor, "q s"]:
    """The power `q s + r` that stands in each place."""
    rows, columns = table.shape[-2:]
    return torch.arange(rows * columns, dtype=table.dtype, device=table.device).view(rows, columns)


class Convolution(torch.autograd.Function):
    """`y[k] = sum_j g[k-j] u[j]` by real transforms of `length` forward and back; autograd's own take complex ones.

    `g (p, m, T)`, `u (e, T, m)`, both with the same leading axes. Returns `y (e, T, p)` and the two spectra, which
    only the derivative needs.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(
        g: Float[Tensor, "*models p m T"], u: Float[Tensor, "*models e T m"], length: int
    ) -> tuple[Float[Tensor, "*models e T p"], Complex[Tensor, "*models p m f"], Complex[Tensor, "*models e m f"]]:
        spectrum, lifted = apart(torch.fft.rfft(g, n=length)), apart(torch.fft.rfft(u.mT, n=length))
        y = torch.fft.irfft(_mixed(spectrum, lifted), n=length)[..., : u.shape[-2]].mT
        return y, spectrum, lifted

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: tuple[Tensor, Tensor, Tensor]) -> None:
        _, u, ctx.length = inputs
        _, spectrum, lifted = output
        ctx.mark_non_differentiable(spectrum, lifted)
        ctx.set_materialize_grads(False)  # or the spectra get gradients of zeros
        ctx.samples = u.shape[-2]
        ctx.save_for_backward(spectrum, lifted)
        ctx.save_for_forward(spectrum, lifted)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        if upstream[0] is None:
            return None, None, None
        spectrum, lifted = ctx.saved_tensors
        error = torch.fft.rfft(upstream[0].mT, n=ctx.length)
        d_g = d_u = None
        if ctx.needs_input_grad[0]:
            d_g = torch.fft.irfft(_correlated(error, lifted), n=ctx.length)[..., : ctx.samples]
        if ctx.needs_input_grad[1]:
            mixed = _mixed(spectrum.transpose(-3, -2), error.conj()).conj()
            d_u = torch.fft.irfft(mixed, n=ctx.length)[..., : ctx.samples].mT
        return d_g, d_u, None

    @staticmethod
    def jvp(ctx: Any, d_g: Tensor | None, d_u: Tensor | None, _: None) -> tuple[Tensor, None, None]:
        spectrum, lifted = ctx.saved_tensors
        parts = [] if d_g is None else [_mixed(torch.fft.rfft(d_g, n=ctx.length), lifted)]
        parts += [] if d_u is None else [_mixed(spectrum, torch.fft.rfft(d_u.mT, n=ctx.length))]
        y = torch.fft.irfft(torch.stack(parts).sum(0), n=ctx.length)
        return y[..., : ctx.samples].mT, None, None


def _correlated(
    error: Complex[Tensor, "*models e p f"], lifted: Complex[Tensor, "*models e m f"]
) -> Complex[Tensor, "*models p m f"]:
    """Summed over the records; a plain product for one channel each."""
    if error.shape[-2] == lifted.shape[-2] == 1:
        return (error.conj() * lifted).sum(-3, keepdim=True).conj()  # a conjugate of `lifted` would lose its gaps
    return torch.einsum("...epf,...emf->...pmf", error, lifted.conj())


def _mixed(
    spectrum: Complex[Tensor, "*models p m f"], lifted: Complex[Tensor, "*models e m f"]
) -> Complex[Tensor, "*models e p f"]:
    """One matrix per frequency; a plain product for one channel each."""
    if spectrum.shape[-3:-1] == (1, 1):
        return spectrum * lifted
    return torch.einsum("...pmf,...emf->...epf", spectrum, lifted)


for _function in (PowerSum, Convolution):  # `apply` reads the signature at every call: 30 microseconds, if not kept
    vars(_function.forward)["__signature__"] = inspect.signature(_function.forward)
