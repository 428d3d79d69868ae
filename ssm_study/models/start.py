"""Where training starts: modes on a ring, or modes of a linear model fitted to the data by least squares."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import linalg

from ssm_study.models.torch_lru import Start
from ssm_study.systems import StateSpace

ARX_LAGS = 24  # past samples in the least-squares model: enough for the order asked, few enough for short records
RESPONSE = 256  # samples of impulse response given to the realisation
NOISE_FLOOR = 1e-8  # relative: smaller singular values are rounding
SLOWEST = 0.9995  # starting modes are pulled inside this radius: a least-squares fit of noisy data may be unstable

Records = Sequence[tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]]  # (T, m), (T, p), T may differ


def on_ring(
    order: int,
    real_modes: int,
    radius: tuple[float, float],
    frequency: tuple[float, float],
    channels: tuple[int, int],
    rng: np.random.Generator,
) -> Start:
    """Radii uniform in area between the two, angles uniform in `frequency` (rad per sample); small random gains.

    Source: Orvieto et al. (2023), lemma 3.2.
    """
    pairs = (order - real_modes) // 2
    count = real_modes + pairs
    modes = np.sqrt(rng.uniform(radius[0] ** 2, radius[1] ** 2, size=count)).astype(complex)
    modes[real_modes:] *= np.exp(1j * rng.uniform(*frequency, size=pairs))
    m, p = channels
    b, c = (rng.normal(size=shape) + 1j * rng.normal(size=shape) for shape in ((count, m), (p, count)))
    b, c = b * np.sqrt(1 - np.abs(modes[:, None]) ** 2), c / np.sqrt(2 * count)
    b[:real_modes].imag, c[:, :real_modes].imag = 0.0, 0.0
    return Start(modes=modes, b=b, c=c, d=np.zeros((p, m)))


def from_data(records: Records, order: int, rng: np.random.Generator, feedthrough: bool) -> Start:
    """ARX by least squares over all records, its impulse response, a balanced realisation of it, its modes.

    Source: Ho & Kalman (1966); Juang & Pappa (1985) for the realisation.
    """
    response = impulse_response(*arx(records, min(ARX_LAGS, max(len(u) for u, _ in records) // 4), feedthrough))
    return modal_start(realise(response, order, rng))


def arx(
    records: Records, lags: int, feedthrough: bool
) -> tuple[Float[np.ndarray, "lags p p"], Float[np.ndarray, "lags_1 p m"]]:
    """`y[k] = sum_i a_i y[k-i] + sum_j b_j u[k-j]`, i = 1 ... lags, j = 0 ... lags (b_0 = 0 without feedthrough)."""
    rows, targets = [], []
    for u, y in records:
        past = [y[lags - i : len(y) - i] for i in range(1, lags + 1)]
        driven = [u[lags - j : len(u) - j] for j in range(0 if feedthrough else 1, lags + 1)]
        rows.append(np.hstack([*past, *driven]))
        targets.append(y[lags:])
    theta = np.linalg.lstsq(np.vstack(rows), np.vstack(targets), rcond=None)[0].T
    p, m = records[0][1].shape[1], records[0][0].shape[1]
    a = theta[:, : lags * p].reshape(p, lags, p).transpose(1, 0, 2)
    b = theta[:, lags * p :].reshape(p, -1, m).transpose(1, 0, 2)
    return a, b if feedthrough else np.concatenate([np.zeros((1, p, m)), b])


def impulse_response(a: Float[np.ndarray, "lags p p"], b: Float[np.ndarray, "lags1 p m"]) -> Float[np.ndarray, "K p m"]:
    """`h[k] = b_k + sum_i a_i h[k-i]`; cut where an unstable fit grows beyond ten times its early peak."""
    h = np.zeros((RESPONSE, *b.shape[1:]))
    for k in range(RESPONSE):
        recent = h[max(k - len(a), 0) : k][::-1]
        h[k] = (a[: len(recent)] @ recent).cumsum(0)[-1] if k else 0.0
        h[k] += b[k] if k < len(b) else 0.0
        if k > len(b) and np.abs(h[k]).max() > 10 * np.abs(h[: len(b)]).max():
            h[k:] = 0.0
            break
    return h


def realise(h: Float[np.ndarray, "K p m"], order: int, rng: np.random.Generator) -> StateSpace:
    """The balanced realisation of the Hankel matrix of `h[1:]`, cut to `order`; fast modes fill what it lacks."""
    half = len(h) // 2
    p, m = h.shape[1:]
    lags = 1 + np.arange(half)[:, None] + np.arange(half - 1)[None, :]
    hankel = h[lags].transpose(0, 2, 1, 3).reshape(half * p, (half - 1) * m)
    left, values, right = linalg.svd(hankel, full_matrices=False)
    kept = min(order, int((values > NOISE_FLOOR * values[0]).sum()))
    root = np.sqrt(values[:kept])
    observe, reach = left[:, :kept] * root, root[:, None] * right[:kept]
    a = np.linalg.lstsq(observe[:-p], observe[p:], rcond=None)[0]
    a = a + 1e-6 * rng.normal(size=a.shape)  # separates repeated modes, which no diagonal form can hold
    spare = rng.uniform(0.1, 0.4, size=order - kept)
    b = np.vstack([reach[:, :m], 0.1 * rng.normal(size=(order - kept, m))])
    c = np.hstack([observe[:p], 0.1 * rng.normal(size=(p, order - kept))])
    return StateSpace(a=linalg.block_diag(a, np.diag(spare)), b=b, c=c, d=h[0])


def modal_start(system: StateSpace) -> Start:
    """Eigenvalues inside the unit circle, real ones first, one of each pair; `b`, `c` in eigenvector coordinates."""
    values, vectors = np.linalg.eig(system.a)
    b, c = np.linalg.solve(vectors, system.b.astype(complex)), system.c @ vectors
    radius = np.abs(values)
    values = np.where(radius > 1.0, values / np.maximum(radius, 1.0) ** 2, values)  # mirrored into the unit circle
    values = np.where(np.abs(values) > SLOWEST, values * SLOWEST / np.maximum(np.abs(values), SLOWEST), values)
    real = np.flatnonzero(np.isreal(values))
    kept = np.concatenate([real, np.flatnonzero(values.imag > 0)])
    return Start(
        modes=values[kept].astype(complex), b=b[kept].astype(complex), c=c[:, kept].astype(complex), d=system.d
    )
