"""The recurrence in blocks of 64 samples: products within them, a scan of the states between, derivative written out.

    y_q = U_q T + Re(X_q W),    X_{q+1} = lambda^64 X_q + U_q G          (rows: records; q counts blocks)

`T[(j, input), (k, output)] = g[k-j]` is the response within a block, `G` the inputs' way to the state after it and `W`
the state's way to the outputs. Complex tables are stored as real ones, real and imaginary parts side by side.
"""

import math
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

CHUNK = 64  # samples per block: products of this size keep one core's caches warm
_AGES = torch.arange(CHUNK + 1, dtype=torch.float64)[:, None]


class Chunks(torch.autograd.Function):
    """`y (e, T, p)` from `decay (n,)`, `b (n, m)`, `c (p, n)`, `d (p, m)`, `u (e, T, m)` and `x0 (e, n)` or None.

    Differentiates backward, once: autograd's own way through the blocks takes three times as many calls.
    """

    @staticmethod
    def forward(
        ctx: Any, decay: Tensor, b: Tensor, c: Tensor, d: Tensor, u: Tensor, x0: Tensor | None
    ) -> Float[Tensor, "e T p"]:
        power = torch.exp(_AGES.to(u.device) * decay.to(torch.complex128)).to(decay.dtype)  # lambda^k, k = 0 ... 64
        lift = _real((power[:-1].flip(0)[:, None] * b.mT).flatten(0, 1))
        read = _real((power[:-1, None] * c).flatten(0, 1).conj_physical())
        within = _toeplitz(d, read, _real(b.mT.contiguous()))
        blocks = _blocks(u)
        turns = _turns(decay * CHUNK, len(blocks))
        x = _scan(turns, _complex(blocks @ lift), x0)
        y = (blocks @ within).view(-1, within.shape[1]).addmm_(_real(x).flatten(0, 1), read.mT)
        ctx.save_for_backward(turns, power, b, c, lift, read, within, blocks, x)
        ctx.samples, ctx.starts_moving = u.shape[1], x0 is not None
        return _signal(y.view(*blocks.shape[:2], -1), ctx.samples, len(d))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        turns, power, b, c, lift, read, within, blocks, x = ctx.saved_tensors
        m, p = b.shape[1], len(c)
        errors, inputs, states = _blocks(upstream[0]), blocks.flatten(0, 1), _real(x).flatten(0, 1)
        reached = _complex(errors @ read)
        later = _scan(turns.conj_physical(), reached.flip(0), None).flip(0)  # the loss by the inputs to the states
        pushed, errors = _real(later).flatten(0, 1), errors.flatten(0, 1)
        d_u = None
        if ctx.needs_input_grad[4]:
            d_u = (errors @ within.mT).addmm_(pushed, lift.mT)
            d_u = _signal(d_u.view(blocks.shape), ctx.samples, m)
        d_g = _diagonal_sums(inputs.mT @ errors, p, m)
        tail = d_g[1:].reshape(-1, m)
        d_lift = _complex((inputs.mT @ pushed).view(CHUNK, m, -1)).flip(0)
        d_read = errors.mT @ states
        d_read[:-p].addmm_(tail, _real(b.mT.contiguous()))
        d_read = _complex(d_read.view(CHUNK, p, -1)).conj_physical()
        power_conj, d_turn = power.conj_physical(), (x.conj() * later).sum((0, 1))
        d_b = (power_conj[:-1, None] * d_lift).sum(0) + _complex(tail.mT @ read[:-p])
        d_c = (power_conj[:-1, None] * d_read).sum(0)
        d_power = torch.cat([(d_lift * b.mT.conj()).sum(1) + (d_read * c.conj()).sum(1), d_turn[None]])
        d_decay = (_AGES.to(d_read.real) * (power_conj * d_power)).sum(0)
        d_x0 = torch.addcmul(reached[0], power_conj[-1], later[0]) if ctx.starts_moving else None
        return d_decay, d_b.mT, d_c, d_g[0], d_u, d_x0


def _real(table: Complex[Tensor, "*r n"]) -> Float[Tensor, "*r n2"]:
    """Real and imaginary parts side by side, without a copy."""
    return torch.view_as_real(table).flatten(-2)


def _complex(table: Float[Tensor, "*r n2"]) -> Complex[Tensor, "*r n"]:
    return torch.view_as_complex(table.view(*table.shape[:-1], -1, 2))


def _toeplitz(
    d: Float[Tensor, "p m"], read: Float[Tensor, "kp n2"], b: Float[Tensor, "m n2"]
) -> Float[Tensor, "sm sp"]:
    """`T[(j, input), (k, output)] = g[output, input, k - j]`, zero above the diagonal of time."""
    p, m = d.shape
    g = torch.cat([d.new_zeros(CHUNK - 1, p, m), d[None], (read[:-p] @ b.mT).view(-1, p, m)])
    return g.unfold(0, CHUNK, 1).flip(0).permute(0, 2, 3, 1).reshape(CHUNK * m, CHUNK * p)


def _diagonal_sums(table: Float[Tensor, "sm sp"], p: int, m: int) -> Float[Tensor, "s p m"]:
    """What `_toeplitz` spread, gathered: rows of length 2 s - 1 instead of 2 s put a diagonal into a column."""
    flipped = table.view(CHUNK, m, CHUNK, p).permute(1, 3, 0, 2).flip(2)
    skewed = torch.nn.functional.pad(flipped, (0, CHUNK)).flatten(2)[..., :-CHUNK]
    return skewed.unflatten(2, (CHUNK, -1)).sum(2)[..., CHUNK - 1 :].permute(2, 1, 0)


def _blocks(signal: Float[Tensor, "e T m"]) -> Float[Tensor, "q e sm"]:
    """Blocks of samples first, filled up with zeros."""
    experiments, samples, channels = signal.shape
    whole, rest = divmod(samples, CHUNK)
    out = signal.new_empty(whole + bool(rest), experiments, CHUNK, channels)
    out[:whole] = signal[:, : whole * CHUNK].unflatten(1, (whole, CHUNK)).transpose(0, 1)
    if rest:
        out[whole, :, :rest] = signal[:, whole * CHUNK :]
        out[whole, :, rest:] = 0.0
    return out.flatten(2)


def _signal(blocks: Float[Tensor, "q e sp"], samples: int, channels: int) -> Float[Tensor, "e T p"]:
    """The inverse of `_blocks`."""
    return blocks.unflatten(2, (CHUNK, channels)).transpose(0, 1).flatten(1, 2)[:, :samples]


def _turns(decay: Complex[Tensor, "n"], steps: int) -> Complex[Tensor, "s 1 n"]:
    """`lambda^k`, k = 1 ... about sqrt(steps): as many as a group of the scan has."""
    members = math.isqrt(steps - 1) + 1
    return torch.exp(torch.arange(1, members + 1, device=decay.device)[:, None, None] * decay)


def _scan(
    turns: Complex[Tensor, "s 1 n"], rise: Complex[Tensor, "q e n"], x0: Complex[Tensor, "e n"] | None
) -> Complex[Tensor, "q e n"]:
    """`x[0] = x0`, `x[k+1] = lambda x[k] + rise[k]`: s steps in all groups of s at once, then from group to group."""
    groups = -(-len(rise) // len(turns))
    x = rise.new_zeros(groups * len(turns), *rise.shape[1:])
    x[1 : len(rise)] = rise[:-1]
    if x0 is not None:
        x[0] = x0
    table = x.view(groups, len(turns), *rise.shape[1:])
    for before, now in pairwise(table.unbind(1)):
        now.addcmul_(before, turns[0])
    for before, now in pairwise(table.unbind(0)):
        now.addcmul_(before[-1:], turns)
    return x[: len(rise)]
