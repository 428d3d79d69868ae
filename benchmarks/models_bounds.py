"""Outside bounds of the recurrence, forward and backward in one call: JAX's compiled FFT, and
numba's compiled loop."""

from collections.abc import Callable

import numpy as np
from numba import njit
from scipy.fft import next_fast_len


def jax_fft(u: np.ndarray, modes: int) -> Callable[[], None]:
    """Gradient by every parameter and the input of the same convolution, compiled by XLA (package
    jax)."""
    import jax
    import jax.numpy as jnp

    samples = u.shape[1]
    rng = np.random.default_rng(0)
    length = next_fast_len(2 * samples - 1, real=True)
    parameters = {
        "nu": jnp.log(-jnp.log(jnp.asarray(rng.uniform(0.5, 0.99, modes), jnp.float32))),
        "theta": jnp.asarray(rng.uniform(0.05, 1.5, modes), jnp.float32),
        "c": jnp.asarray(rng.normal(size=(2, modes)), jnp.float32),
    }

    def loss(p: dict[str, jnp.ndarray], signal: jnp.ndarray) -> jnp.ndarray:
        weights = (p["c"][0] + 1j * p["c"][1]) * jnp.sqrt(-jnp.expm1(-2 * jnp.exp(p["nu"])))
        rate = -jnp.exp(p["nu"]) + 1j * p["theta"]
        short = int(np.ceil(np.sqrt(samples)))
        fine = jnp.exp(jnp.arange(short)[:, None] * rate)
        coarse = weights * jnp.exp(short * jnp.arange(-(-samples // short))[:, None] * rate)
        kernel = (coarse.real @ fine.real.T - coarse.imag @ fine.imag.T).ravel()[:samples]
        y = jnp.fft.irfft(jnp.fft.rfft(signal, length) * jnp.fft.rfft(kernel, length), length)[
            :, :samples
        ]
        return (y**2).mean()

    both = jax.jit(jax.grad(loss, argnums=(0, 1)))
    signal = jnp.asarray(u[..., 0])
    return lambda: jax.block_until_ready(both(parameters, signal))


def numba_loop(u: np.ndarray, modes: int) -> Callable[[], None]:
    """The recurrence sample by sample and its adjoint, compiled for this machine."""
    rng = np.random.default_rng(0)
    turn = np.sqrt(rng.uniform(0.25, 0.98, modes)) * np.exp(1j * rng.uniform(0.05, 1.5, modes))
    parts = [
        part.astype(np.float32)
        for part in (turn.real, turn.imag, rng.normal(size=modes), rng.normal(size=modes))
    ]
    states = np.empty((2, u.shape[1], modes), np.float32)
    return lambda: _loop(u[..., 0], *parts, states)  # type: ignore[call-arg]


@njit(fastmath=True, cache=True)
def _loop(u, lr, li, cr, ci, states):  # type: ignore[no-untyped-def]
    """`x+ = lambda x + u, y = Re(c x)`; the gradient of `mean(y^2) / 2` by lambda, c and u."""
    records, samples = u.shape
    n = len(lr)
    scale = np.float32(1.0 / u.size)
    d_lr = np.zeros_like(lr)
    d_li = np.zeros_like(lr)
    d_cr = np.zeros_like(lr)
    d_ci = np.zeros_like(lr)
    d_u = np.empty_like(u)
    y = np.empty_like(u[0])
    xr = np.empty_like(lr)
    xi = np.empty_like(lr)
    sr = np.empty_like(lr)
    si = np.empty_like(lr)
    for e in range(records):
        xr[:], xi[:] = 0.0, 0.0
        for t in range(samples):
            out = np.float32(0.0)
            for i in range(n):
                states[0, t, i], states[1, t, i] = xr[i], xi[i]
                out += cr[i] * xr[i] - ci[i] * xi[i]
                a = lr[i] * xr[i] - li[i] * xi[i] + u[e, t]
                xi[i] = lr[i] * xi[i] + li[i] * xr[i]
                xr[i] = a
            y[t] = out
        sr[:], si[:] = 0.0, 0.0
        for t in range(samples - 1, -1, -1):
            g = y[t] * scale
            pushed = np.float32(0.0)
            for i in range(n):
                vr = states[0, t, i]
                vi = states[1, t, i]
                pushed += sr[i]
                d_lr[i] += vr * sr[i] + vi * si[i]
                d_li[i] += vr * si[i] - vi * sr[i]
                d_cr[i] += g * vr
                d_ci[i] -= g * vi
                a = lr[i] * sr[i] + li[i] * si[i] + cr[i] * g
                si[i] = lr[i] * si[i] - li[i] * sr[i] - ci[i] * g
                sr[i] = a
            d_u[e, t] = pushed
    return y, d_lr, d_li, d_cr, d_ci, d_u
