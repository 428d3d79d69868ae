"""Hankel singular values of the recurrent unit in closed form, differentiable."""

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ssm_study.models.torch_recurrence import Modes


def gramians(modes: Modes, reals: int) -> tuple[Complex[Tensor, "n n"], Complex[Tensor, "n n"]]:
    """`P_ij = b_i b_j^H / (1 - l_i conj(l_j))`, `Q_ij = conj(c_i)^T c_j / (1 - conj(l_i) l_j)` over all n modes.

    Conjugate partners are written out, so the modes are those of the real system. The conjugates matter: without them
    the formula is that of another system, and its values need not even be real.
    """
    turn, b, c = _with_partners(modes, reals)
    reach = 1.0 - turn[:, None] * turn[None, :].conj()
    return (b @ b.mH) / reach, (c.mH @ c) / reach.conj()


def hankel_singular_values(modes: Modes, reals: int) -> Float[Tensor, "n"]:
    """`sigma_i = sqrt(eig_i(P Q))`, largest first, by the Cholesky-like root of P; zeros are rounded off at 1e-12."""
    p, q = gramians(modes, reals)
    values, vectors = torch.linalg.eigh(p)
    root = vectors * torch.sqrt(values.clamp(min=1e-14 * values.detach().max()))
    inner = root.mH @ q @ root
    squares = torch.linalg.eigvalsh((inner + inner.mH) / 2)
    return torch.sqrt(squares.clamp(min=1e-24 * squares.detach().max())).flip(0)


def _with_partners(
    modes: Modes, reals: int
) -> tuple[Complex[Tensor, "n"], Complex[Tensor, "n m"], Complex[Tensor, "p n"]]:
    turn = torch.exp(modes.decay)
    half = modes.c[:, reals:] / 2  # the factor two of a pair is shared between the partners
    return (
        torch.cat([turn, turn[reals:].conj()]),
        torch.cat([modes.b, modes.b[reals:].conj()]),
        torch.cat([modes.c[:, :reals], half, half.conj()], 1),
    )
