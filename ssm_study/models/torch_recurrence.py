"""Simulation of the linear recurrence in torch, by one convolution or in blocks of samples.

    x[k+1] = lambda x[k] + B u[k],    y[k] = Re(C x[k]) + D u[k],    x[0] given      (all modes are
    decoupled)

ModalForm are complex numbers; a real mode is one with zero imaginary part, and the factor two of a
conjugate pair is already in `C`. So the response is `y[k] = Re(C lambda^k x0) + sum_j g[k-j] u[j]`
with `g[0] = D` and `g[k] = Re(C lambda^(k-1) B)`. Shapes: `decay (n,)` complex, the logarithm of
lambda; `b (n, m)`, `c (p, n)` complex; `d (p, m)` real; `u (e, T, m)`; `x0 (e, n)` complex.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Complex, Float
from scipy.fft import next_fast_len
from torch import Tensor

CHUNK = 64  # samples per block: products of this size keep one core's caches warm
Real2 = Float[Tensor, "*r n2"]
Complex2 = Complex[Tensor, "*r n"]  # n2 = 2 n: real and imaginary parts
_AGES = torch.arange(CHUNK + 1, dtype=torch.float64)[:, None]


class BlockwiseRecurrence(torch.autograd.Function):
    """Differentiable torch operation that simulates a linear recurrence in blocks of 64 samples.
    Products of blocks and a scan of the states between them; shapes as above, `x0 (e, n)` or None.

        y_q = U_q T + Re(X_q W),    X_{q+1} = lambda^64 X_q + U_q G          (rows: records; q
        counts blocks)

    `T[(j, input), (k, output)] = g[k-j]` is the response within a block, `G` the inputs' way to the
    state after it and `W` the state's way to the outputs. Complex tables are stored as real ones,
    real and imaginary parts side by side. Differentiates backward, once: autograd's own way through
    the blocks takes three times as many calls.
    """

    @staticmethod
    def forward(
        ctx: Any, decay: Tensor, b: Tensor, c: Tensor, d: Tensor, u: Tensor, x0: Tensor | None
    ) -> Tensor:
        """Simulate a linear recurrence block by block, and store the values that the gradient
        needs."""
        rate = decay.to(torch.complex128)  # powers are taken in it: a phase grows with its sample
        exponents = _AGES.to(u.device) * rate
        power = torch.exp(exponents).to(decay.dtype)  # lambda^k, k = 0 ... 64
        later_powers = power[:-1].flip(0)
        lift_by_sample = later_powers[:, None] * b.mT
        flat_lift = lift_by_sample.flatten(0, 1)
        lift = _as_real(flat_lift)
        read_by_sample = power[:-1, None] * c
        flat_read = read_by_sample.flatten(0, 1)
        read = _as_real(flat_read.conj_physical())
        b_rows = b.mT.contiguous()
        within_block = _block_toeplitz_matrix(d, read, _as_real(b_rows))
        blocks = _split_into_blocks(u)
        later_blocks = len(blocks) - 1
        members = math.isqrt(later_blocks) + 1  # of a group of the scan, and powers of lambda^64
        multiples = torch.arange(1, members + 1, device=u.device)
        steps = multiples[:, None, None]
        exponents_of_groups = steps * (rate * CHUNK)
        turns = torch.exp(exponents_of_groups).to(decay.dtype)
        rise = _as_complex(blocks @ lift)
        x = _initial_states_of_blocks(turns, rise, x0)  # the state at the start of each block
        y = (blocks @ within_block).view(-1, within_block.shape[1])
        state_rows = _as_real(x)
        y = y.addmm_(state_rows.flatten(0, 1), read.mT)
        ctx.save_for_backward(turns, power, b, c, lift, read, within_block, blocks, x)
        ctx.samples = u.shape[1]
        ctx.starts_moving = x0 is not None
        output_blocks = y.view(*blocks.shape[:2], -1)
        return _join_blocks(output_blocks, ctx.samples, len(d))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the loss with respect to a linear recurrence's parameters, input and initial
        state."""
        turns, power, b, c, lift, read, within_block, blocks, x = ctx.saved_tensors
        m = b.shape[1]
        p = len(c)
        error_blocks = _split_into_blocks(upstream[0])
        reached = _as_complex(error_blocks @ read)
        later = _initial_states_of_blocks(turns.conj_physical(), reached.flip(0), None)
        later = later.flip(0)  # the loss by the inputs to the states
        pushed = _as_real(later).flatten(0, 1)
        errors = error_blocks.flatten(0, 1)  # adjoint of the states, rows by block
        d_u = None
        if ctx.needs_input_grad[4]:
            d_blocks = (errors @ within_block.mT).addmm_(pushed, lift.mT)
            d_u = _join_blocks(d_blocks.view(blocks.shape), ctx.samples, m)

        inputs = blocks.flatten(0, 1)
        impulse_products = inputs.mT @ errors
        d_g = _diagonal_sums(impulse_products, p, m)  # by the impulse response g
        tail = d_g[1:].reshape(-1, m)  # g[0] = D alone, g[k] = Re(C lambda^(k-1) B)
        lift_products = inputs.mT @ pushed
        by_lift = lift_products.view(CHUNK, m, -1)
        d_lift = _as_complex(by_lift).flip(0)
        d_read = _gradient_by_output_maps(errors, x, tail, b)

        power_conj = power.conj_physical()
        first_read = read[:-p]
        through_tail = _as_complex(tail.mT @ first_read)
        weighted_lift = power_conj[:-1, None] * d_lift
        d_b = weighted_lift.sum(0) + through_tail
        weighted_read = power_conj[:-1, None] * d_read
        d_c = weighted_read.sum(0)
        turn_products = x.conj() * later
        d_turn = turn_products.sum((0, 1))
        inside_lift = d_lift * b.mT.conj()
        inside_read = d_read * c.conj()
        d_inside = inside_lift.sum(1) + inside_read.sum(1)
        d_power = torch.cat([d_inside, d_turn[None]])
        weighted = _AGES.to(d_read.real) * (power_conj * d_power)
        d_decay = weighted.sum(0)  # d lambda^k = k lambda^k d decay
        d_x0 = torch.addcmul(reached[0], power_conj[-1], later[0]) if ctx.starts_moving else None
        return d_decay, d_b.mT, d_c, d_g[0], d_u, d_x0


def _gradient_by_output_maps(
    errors: Float[Tensor, "qe sp"],
    x: Complex[Tensor, "q e n"],
    tail: Float[Tensor, "kp m"],
    b: Complex[Tensor, "n m"],
) -> Complex[Tensor, "s p n"]:
    """Gradient of the loss with respect to the matrices from a block's initial state to its
    outputs.

    `tail` is the gradient by the impulse response after its first sample, through which the maps
    act on the loss, too.
    """
    p = errors.shape[1] // CHUNK
    state_rows = _as_real(x)
    by_read = errors.mT @ state_rows.flatten(0, 1)
    b_rows = b.mT.contiguous()
    by_read[:-p].addmm_(tail, _as_real(b_rows))
    read_blocks = by_read.view(CHUNK, p, -1)
    return _as_complex(read_blocks).conj_physical()


def _as_real(table: Complex2) -> Real2:
    """View an array of complex numbers as real and imaginary parts side by side, without a copy."""
    parts = torch.view_as_real(table)
    return parts.flatten(-2)


def _as_complex(table: Real2) -> Complex2:
    """View pairs of real and imaginary parts as complex numbers without copying."""
    pairs = table.view(*table.shape[:-1], -1, 2)
    return torch.view_as_complex(pairs)


def _block_toeplitz_matrix(
    d: Float[Tensor, "p m"], output_maps: Float[Tensor, "kp n2"], b: Float[Tensor, "m n2"]
) -> Tensor:
    """Block Toeplitz matrix of an impulse response. `T[(j, input), (k, output)] = g[output, input,
    k - j]`."""
    p, m = d.shape
    before = d.new_zeros(CHUNK - 1, p, m)
    response = output_maps[:-p] @ b.mT
    after = response.view(-1, p, m)
    whole_response = [before, d[None], after]
    g = torch.cat(whole_response)
    windows = g.unfold(0, CHUNK, 1)
    shifted = windows.flip(0)
    by_sample = shifted.permute(0, 2, 3, 1)
    return by_sample.reshape(CHUNK * m, CHUNK * p)


def _diagonal_sums(table: Float[Tensor, "sm sp"], p: int, m: int) -> Float[Tensor, "s p m"]:
    """Sums along the diagonals of a block Toeplitz matrix. With rows of length 2 s - 1 instead of 2
    s, a diagonal becomes a column."""
    by_blocks = table.view(CHUNK, m, CHUNK, p)
    flipped = by_blocks.permute(1, 3, 0, 2).flip(2)
    padded = torch.nn.functional.pad(flipped, (0, CHUNK))
    widened = padded.flatten(2)
    trimmed = widened[..., :-CHUNK]
    skewed = trimmed.unflatten(2, (CHUNK, -1))
    all_sums = skewed.sum(2)
    sums = all_sums[..., CHUNK - 1 :]
    return sums.permute(2, 1, 0)


def _split_into_blocks(signal: Float[Tensor, "e T m"]) -> Float[Tensor, "q e sm"]:
    """Split a signal into blocks of 64 samples, padded with zeros. Blocks come first."""
    missing = -signal.shape[1] % CHUNK
    filled = torch.nn.functional.pad(signal, (0, 0, 0, missing))
    by_block = filled.unflatten(1, (-1, CHUNK)).transpose(0, 1)
    return by_block.flatten(2).contiguous()


def _join_blocks(
    blocks: Float[Tensor, "q e sp"], samples: int, channels: int
) -> Float[Tensor, "e T p"]:
    """Join blocks of samples into one signal without the padding."""
    joined = blocks.unflatten(2, (CHUNK, channels)).transpose(0, 1).flatten(1, 2)
    return joined[:, :samples]


def _initial_states_of_blocks(
    powers: Complex[Tensor, "s 1 n"], increments: Complex[Tensor, "q e n"], x0: Tensor | None
) -> Tensor:
    """Compute the state of a diagonal recurrence at the beginning of each block of samples. `x[0] =
    x0`, `x[k+1] = lambda x[k] + increments[k]`: s steps in all groups of s at once, then from group
    to group."""
    groups = -(-len(increments) // len(powers))
    padded_length = groups * len(powers)
    x = increments.new_zeros(padded_length, *increments.shape[1:])
    x[1 : len(increments)] = increments[:-1]
    if x0 is not None:
        x[0] = x0
    group_length = len(powers)
    table = x.view(groups, group_length, *increments.shape[1:])
    members_of_groups = table.unbind(1)
    for before, now in pairwise(members_of_groups):
        now.addcmul_(before, powers[0])  # within all groups at once
    groups_in_order = table.unbind(0)
    for before, now in pairwise(groups_in_order):
        now.addcmul_(before[-1:], powers)  # what the group before ends with, turned k times
    return x[: len(increments)]


FEW_POWERS = 4096  # of fewer, doubling's many small operations cost more than the exponentials
CHUNKS_UP_TO_MODES = 16
# Measured in benchmarks/models_recurrence.py: chunks win where their products are small against the
# transforms.
CHUNKS_FROM_SAMPLES = 500
Input = Float[Tensor, "e T m"]
Output = Float[Tensor, "e T p"]
Modal = Complex[Tensor, "e n"]
Tables = tuple[Complex[Tensor, "s n"], Complex[Tensor, "q n"]]


@dataclass(frozen=True, kw_only=True)
class ModalForm:
    """Linear recurrence in modal (diagonal) coordinates. `decay = log(lambda)` with negative real
    part."""

    decay: Complex[Tensor, "n"]
    b: Complex[Tensor, "n m"]
    c: Complex[Tensor, "p n"]
    d: Float[Tensor, "p m"]


def final_state(modes: ModalForm, u: Input, x0: Modal | None = None) -> Modal:
    """State of a modal recurrence after the last sample of an input. `x[T] = lambda^T x0 + sum_j
    lambda^(T-1-j) B u[j]`."""
    samples = u.shape[1]
    rate = modes.decay.to(torch.complex128)
    later_powers = mode_powers(rate, samples).flip(0)
    ages = later_powers.to(modes.b.dtype)
    inputs_by_channel = u.transpose(1, 2)
    real = inputs_by_channel @ ages.real
    imaginary = u.transpose(1, 2) @ ages.imag
    moments = torch.complex(real, imaginary)
    weighted_moments = moments * modes.b.T
    x = weighted_moments.sum(1)
    if x0 is None:
        return x
    complex_decay = torch.exp(rate * samples)
    decay = complex_decay.to(x.dtype)
    return x + decay * x0


def simulate_by_convolution(modes: ModalForm, u: Input, x0: Modal | None = None) -> Output:
    """Simulate a linear recurrence in modal form by FFT convolution with its impulse response. `y =
    g * u` by real transforms of a fast length; it can be differentiated forward, vectorised, and
    any number of times."""
    p, m = modes.d.shape
    samples = u.shape[1]
    both = power_tables(modes.decay, samples)
    whole_length = 2 * samples - 1
    length = next_fast_len(whole_length, real=True)
    c_columns = modes.c[:, None]
    b_rows = modes.b.mT
    by_pair = c_columns * b_rows
    weights = by_pair.flatten(0, 1)  # C_i B_i, one row per pair of output and input
    delayed_response = modal_impulse_response(weights, both)
    tail = delayed_response[:, : samples - 1]
    flat_response = torch.cat([modes.d.flatten()[:, None], tail], 1)
    g = flat_response.view(p, m, -1)
    spectrum = torch.fft.rfft(g, n=length)
    lifted = torch.fft.rfft(u.mT, n=length)
    product = torch.einsum("pmf,emf->epf", spectrum, lifted)
    whole_output = torch.fft.irfft(product, n=length)
    y = whole_output[..., :samples]
    if x0 is not None:
        weighted_starts = x0[:, None] * modes.c
        free_weights = weighted_starts.flatten(0, 1)
        free_response = modal_impulse_response(free_weights, both)
        free = free_response[:, :samples]
        free_output = free.unflatten(0, (len(x0), -1))
        y = y + free_output
    return y.mT


def simulate_in_blocks(modes: ModalForm, u: Input, x0: Modal | None = None) -> Output:
    """Simulate a linear recurrence in modal form in blocks of samples. Blocks of 64 samples are
    matrix products; the states between blocks follow the same law, 64 times slower."""
    return BlockwiseRecurrence.apply(modes.decay, modes.b, modes.c, modes.d, u, x0)


def power_tables(decay: Complex[Tensor, "n"], samples: int) -> Tables:
    """Two tables of powers of the eigenvalues, whose products are all powers up to a number of
    samples. `F_ri = lambda_i^r` and `C_qi = lambda_i^(s q)`, so that `lambda^k = C_q F_r` with `k =
    q s + r`.

    About sqrt(samples) rows each; the powers are taken in complex128.
    """
    short = math.isqrt(samples - 1) + 1
    rate = decay.to(torch.complex128)
    fine = mode_powers(rate, short)
    negative_blocks = -samples // short
    coarse = mode_powers(rate * short, -negative_blocks)
    return fine.to(decay.dtype), coarse.to(decay.dtype)


def mode_powers(rate: Complex[Tensor, "n"], count: int) -> Complex[Tensor, "count n"]:
    """Powers of the eigenvalues of a modal recurrence, one row for each exponent below a limit.
    Large tables are made by doubling, nine times cheaper than the exponentials."""
    if count * len(rate) <= FEW_POWERS:
        exponents = torch.arange(count, device=rate.device)
        products = exponents[:, None] * rate
        return torch.exp(products)
    step = torch.exp(rate)[None]
    table = torch.ones_like(step)
    while len(table) < count:
        doubled = [table, table * step]
        table = torch.cat(doubled)
        step = step * step  # twice as many rows each time
    return table[:count]


def modal_impulse_response(weights: Complex[Tensor, "r n"], tables: Tables) -> Float[Tensor, "r K"]:
    """Impulse response of a recurrence in modal form, as weighted sums of powers of the
    eigenvalues. `Re sum_i weights_i lambda_i^k`, as one real product of two tables, without a table
    of samples x n."""
    fine, coarse = tables
    weight_rows = weights[:, None, :]
    weighted_powers = weight_rows * coarse
    left = torch.view_as_real(weighted_powers).flatten(-2)
    conjugate_fine = fine.conj().resolve_conj()
    right = torch.view_as_real(conjugate_fine).flatten(-2)
    response_table = left @ right.mT
    return response_table.flatten(-2)


_FORWARD = ContextVar("derivatives are taken forward", default=False)


@contextmanager
def allow_forward_derivatives() -> Iterator[None]:
    """Context manager in which simulation uses only operations that torch can differentiate in
    forward mode."""
    token = _FORWARD.set(True)
    try:
        yield
    finally:
        _FORWARD.reset(token)


def simulate_modal_form(modes: ModalForm, u: Input, x0: Modal | None = None) -> Output:
    """Simulate a linear recurrence in modal form by the faster of two equivalent methods.
    Convolution and blocks give the same result; their speed depends on length and order."""
    are_few_modes = len(modes.decay) <= CHUNKS_UP_TO_MODES
    few = are_few_modes and u.shape[1] >= CHUNKS_FROM_SAMPLES
    takes_chunks = few and not _FORWARD.get()
    simulate = simulate_in_blocks if takes_chunks else simulate_by_convolution
    return simulate(modes, u, x0)
