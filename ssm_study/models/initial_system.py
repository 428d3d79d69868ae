"""Linear system with which the training of a recurrence begins, estimated from records or drawn at
random."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Complex, Float, Inexact

from ssm_study.systems import StateSpace

# past samples in the least-squares model: enough for the order asked, few enough for short records
ARX_LAGS = 24
RESPONSE = 256  # samples of impulse response given to the realisation
NOISE_FLOOR = 1e-8  # relative: smaller singular values are rounding
LEAST_SHARE = 0.5  # |y - ys| < |y| exactly where <y, ys> > <ys, ys> / 2
# starting modes are pulled inside this radius: a least-squares fit of noisy data may be unstable
SLOWEST = 0.9995

Range = Sequence[float]  # from, to
Record = tuple[Float[np.ndarray, "_ m"], Float[np.ndarray, "_ p"]]
Pairs = Sequence[Record]  # their lengths may differ


@dataclass(frozen=True, kw_only=True)
class InitialLinearSystem:
    """Linear system in modal form with which the training of a recurrence begins.

    `y = Re(c_r x_r) + 2 Re(c_c x_c) + d u`: the factor two of the pairs is not in `c`.
    """

    modes: Complex[np.ndarray, "n"]
    b: Complex[np.ndarray, "n m"]
    c: Complex[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]

    def simulate_output(self, u: Float[np.ndarray, "T m"]) -> Float[np.ndarray, "T p"]:
        """Simulate the output of the initial linear system from the equilibrium."""
        # SciPy loads a part at its first use: this one takes half a second.
        lfilter = scipy.signal.lfilter
        gains = zip(self.modes, self.b, strict=True)
        states = [lfilter([0.0, 1.0], [1.0, -mode], u @ gain) for mode, gain in gains]
        x = np.stack(states)
        is_real = self.modes.imag == 0
        twice = np.where(is_real, 1.0, 2.0)
        modal_output = twice * self.c @ x
        direct_output = u @ self.d.T
        return np.asarray(modal_output.real.T + direct_output)


def draw_stable_system(
    order: int,
    real_modes: int,
    radius: Range,
    frequency: Range,
    channels: tuple[int, int],
    rng: np.random.Generator,
) -> InitialLinearSystem:
    """Draw a random stable linear system whose eigenvalues lie in a ring inside the unit circle.
    Radii are uniform in area between the two given, angles uniform in `frequency` (rad per sample);
    gains are small and random.

    Source: Orvieto et al. (2023), lemma 3.2.
    """
    pairs = (order - real_modes) // 2  # each holds two states
    count = real_modes + pairs
    smallest_square = radius[0] ** 2
    largest_square = radius[1] ** 2
    squared_radii = rng.uniform(smallest_square, largest_square, size=count)
    radii = np.sqrt(squared_radii)
    modes = radii.astype(complex)
    angles = rng.uniform(frequency[0], frequency[1], size=pairs)
    modes[real_modes:] *= np.exp(1j * angles)
    m, p = channels
    moduli = np.abs(modes[:, None])
    remaining = 1 - moduli**2
    gains = np.sqrt(remaining)
    random_b = draw_complex_normal(rng, (count, m))
    b = random_b * gains
    c = draw_complex_normal(rng, (p, count))
    c = c / np.sqrt(2 * count)  # of like size at any radius and order
    b[:real_modes].imag = 0.0
    c[:, :real_modes].imag = 0.0
    no_feedthrough = np.zeros((p, m))
    return InitialLinearSystem(modes=modes, b=b, c=c, d=no_feedthrough)


def draw_complex_normal(
    rng: np.random.Generator, shape: tuple[int, int]
) -> Complex[np.ndarray, "_ _"]:
    """Draw complex numbers whose real and imaginary parts are independent and normally
    distributed."""
    real = rng.normal(size=shape)
    imaginary = rng.normal(size=shape)
    return real + 1j * imaginary


def estimate_initial_system(
    records: Pairs, order: int, rng: np.random.Generator, feedthrough: bool
) -> InitialLinearSystem:
    """Estimate the linear system with which training begins from the training records, by ARX and
    balanced realisation. ARX by least squares over all records, its impulse response, a balanced
    realisation of it, its modes.

    Long ARX models are unstable on noise, and where the input acts at once but no feedthrough is
    allowed; their modes, pulled into the unit circle, then answer a thousandfold. A start whose
    free run is further from the records than zero is made again with as many lags as states; if
    that is no better, it is scaled to what it explains. Source: Ho & Kalman (1966); Juang & Pappa
    (1985) for the realisation.
    """
    lengths = (len(u) for u, _ in records)
    longest_record = max(lengths)
    longest = min(ARX_LAGS, longest_record // 4)
    fewer_lags = min(order, longest)
    for lags in (longest, fewer_lags):
        arx_matrices = fit_arx_matrices(records, lags, feedthrough)
        response = arx_impulse_response(*arx_matrices)
        realised = realise_impulse_response(response, order, rng)
        start = modal_initial_system(realised)
        share = output_regression_coefficient(start, records)
        if share >= LEAST_SHARE:
            return start
    c = share * start.c
    d = share * start.d
    return replace(start, c=c, d=d)


def output_regression_coefficient(start: InitialLinearSystem, records: Pairs) -> float:
    """Coefficient of the regression of the measured output on the simulated output of an initial
    linear system. `<y, ys> / <ys, ys>` of the free runs `ys` from rest: half or more if these are
    nearer to `y` than zero is."""
    measured_outputs = [y for _, y in records]
    measured = np.concatenate(measured_outputs)
    simulated_outputs = [start.simulate_output(u) for u, _ in records]
    simulated = np.concatenate(simulated_outputs)
    squared_sum = (simulated**2).sum()
    smallest_float = np.finfo(float).tiny
    power = max(squared_sum, smallest_float)
    correlation = (measured * simulated).sum()
    return float(correlation / power)


def fit_arx_matrices(
    records: Pairs, lags: int, feedthrough: bool
) -> tuple[Float[np.ndarray, "lags p p"], Float[np.ndarray, "lags_1 p m"]]:
    """Estimate the coefficient matrices of a multivariable ARX model by least squares. `y[k] =
    sum_i a_i y[k-i] + sum_j b_j u[k-j]`, i = 1 ... lags, j = 0 ... lags (b_0 = 0 without
    feedthrough).

    Records of no more samples than lags, such as pieces between two holes of a log, are left out.
    """
    first = 0 if feedthrough else 1
    rows = []
    targets = []
    for u, y in records:
        if len(u) <= lags:
            continue
        output_lags = range(1, lags + 1)
        past = [y[lags - i : len(y) - i] for i in output_lags]
        input_lags = range(first, lags + 1)
        driven = [u[lags - j : len(u) - j] for j in input_lags]
        regressors = [*past, *driven]
        rows.append(np.hstack(regressors))
        targets.append(y[lags:])
    all_rows = np.vstack(rows)
    all_targets = np.vstack(targets)
    solution = np.linalg.lstsq(all_rows, all_targets, rcond=None)
    theta = solution[0].T
    inputs, outputs = records[0]
    p = outputs.shape[1]
    m = inputs.shape[1]
    output_part = theta[:, : lags * p]
    a = output_part.reshape(p, lags, p).transpose(1, 0, 2)
    input_part = theta[:, lags * p :]
    b = input_part.reshape(p, -1, m).transpose(1, 0, 2)
    return a, b if feedthrough else np.concatenate([np.zeros((1, p, m)), b])


def arx_impulse_response(
    a: Float[np.ndarray, "lags p p"], b: Float[np.ndarray, "lags1 p m"]
) -> Float[np.ndarray, "K p m"]:
    """Impulse response of an ARX model. `h[k] = b_k + sum_i a_i h[k-i]`; cut where an unstable fit
    grows beyond ten times its early peak."""
    input_shape = b.shape[1:]
    h = np.zeros((RESPONSE, *input_shape))
    for k in range(RESPONSE):
        lag_count = len(a)
        first = max(k - lag_count, 0)
        recent = h[first:k][::-1]
        if k:
            used_matrices = a[: len(recent)]
            h[k] = (used_matrices @ recent).cumsum(0)[-1]
        if k < len(b):
            h[k] += b[k]
        input_lags = len(b)
        early_response = h[:input_lags]
        early_peak = np.abs(early_response).max()
        if k > input_lags and np.abs(h[k]).max() > 10 * early_peak:
            h[k:] = 0.0
            break
    return h


def realise_impulse_response(
    h: Float[np.ndarray, "K p m"], order: int, rng: np.random.Generator
) -> StateSpace:
    """Balanced state-space realisation of an impulse response, truncated to a given order. If it
    has too few modes, fast ones are added."""
    half = len(h) // 2
    p, m = h.shape[1:]
    row_numbers = np.arange(half)
    rows = row_numbers[:, None]
    column_numbers = np.arange(half - 1)
    columns = column_numbers[None, :]
    blocks = h[1 + rows + columns]  # the direct term h[0] is D
    ordered_blocks = blocks.transpose(0, 2, 1, 3)
    hankel_width = (half - 1) * m
    hankel = ordered_blocks.reshape(half * p, hankel_width)
    left, values, right = scipy.linalg.svd(hankel, full_matrices=False)
    is_above_noise = values > NOISE_FLOOR * values[0]
    rank = min(order, int(is_above_noise.sum()))
    root = np.sqrt(values[:rank])
    observability = left[:, :rank] * root
    root_column = root[:, None]
    leading_right = right[:rank]
    reachability = root_column * leading_right
    earlier_rows = observability[:-p]
    later_rows = observability[p:]
    a = np.linalg.lstsq(earlier_rows, later_rows, rcond=None)[0]
    # Separates repeated modes, which no diagonal form can hold.
    perturbation = rng.normal(size=a.shape)
    a = a + 1e-6 * perturbation

    missing = order - rank
    fast_modes = rng.uniform(0.1, 0.4, size=missing)  # forgotten within a few samples
    random_b = rng.normal(size=(missing, m))
    more_b = 0.1 * random_b
    random_c = rng.normal(size=(p, missing))
    more_c = 0.1 * random_c
    fast_part = np.diag(fast_modes)
    a = scipy.linalg.block_diag(a, fast_part)
    b_of_system = reachability[:, :m]
    b = np.vstack([b_of_system, more_b])
    c_of_system = observability[:p]
    c = np.hstack([c_of_system, more_c])
    return StateSpace(a=a, b=b, c=c, d=h[0])


def modal_initial_system(system: StateSpace) -> InitialLinearSystem:
    """Initial linear system in modal form with the eigenvalues of a given system, moved inside the
    unit circle. Real ones come first, then one of each pair; `b`, `c` are in eigenvector
    coordinates."""
    values, vectors = np.linalg.eig(system.a)
    complex_b = system.b.astype(complex)
    b = np.linalg.solve(vectors, complex_b).astype(complex)
    modal_c = system.c @ vectors
    c = modal_c.astype(complex)
    values = stabilise_eigenvalues(values)
    is_real = np.isreal(values)
    real = np.flatnonzero(is_real)
    upper = np.flatnonzero(values.imag > 0)
    indices = np.concatenate([real, upper])
    modes = values[indices].astype(complex)
    modal_output_map = c[:, indices]
    return InitialLinearSystem(modes=modes, b=b[indices], c=modal_output_map, d=system.d)


def stabilise_eigenvalues(values: Inexact[np.ndarray, "n"]) -> Inexact[np.ndarray, "n"]:
    """Reflect unstable eigenvalues into the unit circle, and limit the modulus of all
    eigenvalues."""
    radius = np.abs(values)
    bounded_radius = np.maximum(radius, 1.0)
    mirrored = values / bounded_radius**2
    values = np.where(radius > 1.0, mirrored, values)
    radius = np.abs(values)
    slow_radius = np.maximum(radius, SLOWEST)
    pulled = values * SLOWEST / slow_radius
    return np.where(radius > SLOWEST, pulled, values)
