"""Settings of the linear recurrence between static maps, and the linear system with which its
training begins."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy
from jaxtyping import Complex, Float, Inexact

from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require, require_at_least, require_one_of, require_positive
from ssm_study.signals import DataSet
from ssm_study.systems import StateSpace

if TYPE_CHECKING:
    from ssm_study.models.torch_ssm import TorchModel, TorchSSM

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
class Initialisation:
    """Linear system from which the training starts, in modal form.

    `y = Re(c_r x_r) + 2 Re(c_c x_c) + d u`: the factor two of the pairs is not in `c`.
    """

    modes: Complex[np.ndarray, "n"]
    b: Complex[np.ndarray, "n m"]
    c: Complex[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]

    def simulate_output(self, u: Float[np.ndarray, "T m"]) -> Float[np.ndarray, "T p"]:
        """Output of the initial linear system, simulated from the equilibrium."""
        # SciPy loads a part at its first use: this one takes half a second.
        lfilter = scipy.signal.lfilter
        gains = zip(self.modes, self.b, strict=True)
        states = [lfilter([0.0, 1.0], [1.0, -mode], u @ gain) for mode, gain in gains]
        x = np.stack(states)
        twice = np.where(self.modes.imag == 0, 1.0, 2.0)
        return np.asarray((twice * self.c @ x).real.T + u @ self.d.T)


def draw_modes_on_ring(
    order: int,
    real_modes: int,
    radius: Range,
    frequency: Range,
    channels: tuple[int, int],
    rng: np.random.Generator,
) -> Initialisation:
    """Draw random stable modes in a ring inside the unit circle. Radii are uniform in area between
    the two given, angles uniform in `frequency` (rad per sample); gains are small and random.

    Source: Orvieto et al. (2023), lemma 3.2.
    """
    pairs = (order - real_modes) // 2  # each holds two states
    count = real_modes + pairs
    squared_radii = rng.uniform(radius[0] ** 2, radius[1] ** 2, size=count)
    modes = np.sqrt(squared_radii).astype(complex)
    angles = rng.uniform(frequency[0], frequency[1], size=pairs)
    modes[real_modes:] *= np.exp(1j * angles)
    m, p = channels
    gains = np.sqrt(1 - np.abs(modes[:, None]) ** 2)
    b = draw_complex_normal(rng, (count, m)) * gains
    c = draw_complex_normal(rng, (p, count))
    c = c / np.sqrt(2 * count)  # of like size at any radius and order
    b[:real_modes].imag = 0.0
    c[:, :real_modes].imag = 0.0
    return Initialisation(modes=modes, b=b, c=c, d=np.zeros((p, m)))


def draw_complex_normal(
    rng: np.random.Generator, shape: tuple[int, int]
) -> Complex[np.ndarray, "_ _"]:
    """Draw complex numbers with independent normal real and imaginary parts."""
    real = rng.normal(size=shape)
    imaginary = rng.normal(size=shape)
    return real + 1j * imaginary


def estimate_initial_system(
    records: Pairs, order: int, rng: np.random.Generator, feedthrough: bool
) -> Initialisation:
    """Estimate, from the records, the linear system with which training begins. ARX by least
    squares over all records, its impulse response, a balanced realisation of it, its modes.

    Long ARX models are unstable on noise, and where the input acts at once but no feedthrough is
    allowed; their modes, pulled into the unit circle, then answer a thousandfold. A start whose
    free run is further from the records than zero is made again with as many lags as states; if
    that is no better, it is scaled to what it explains. Source: Ho & Kalman (1966); Juang & Pappa
    (1985) for the realisation.
    """
    longest_record = max(len(u) for u, _ in records)
    longest = min(ARX_LAGS, longest_record // 4)
    for lags in (longest, min(order, longest)):
        response = arx_impulse_response(*fit_arx_matrices(records, lags, feedthrough))
        start = modal_initialisation(realise_impulse_response(response, order, rng))
        share = output_regression_coefficient(start, records)
        if share >= LEAST_SHARE:
            return start
    return replace(start, c=share * start.c, d=share * start.d)


def output_regression_coefficient(start: Initialisation, records: Pairs) -> float:
    """Coefficient of the regression of the measured output on an initial system's output. `<y, ys>
    / <ys, ys>` of the free runs `ys` from rest: half or more if these are nearer to `y` than zero
    is."""
    measured = np.concatenate([y for _, y in records])
    simulated = np.concatenate([start.simulate_output(u) for u, _ in records])
    power = max((simulated**2).sum(), np.finfo(float).tiny)
    return float((measured * simulated).sum() / power)


def fit_arx_matrices(
    records: Pairs, lags: int, feedthrough: bool
) -> tuple[Float[np.ndarray, "lags p p"], Float[np.ndarray, "lags_1 p m"]]:
    """Least-squares estimate of a multivariable ARX model. `y[k] = sum_i a_i y[k-i] + sum_j b_j
    u[k-j]`, i = 1 ... lags, j = 0 ... lags (b_0 = 0 without feedthrough)."""
    first = 0 if feedthrough else 1
    rows = []
    targets = []
    for u, y in records:
        past = [y[lags - i : len(y) - i] for i in range(1, lags + 1)]
        driven = [u[lags - j : len(u) - j] for j in range(first, lags + 1)]
        rows.append(np.hstack([*past, *driven]))
        targets.append(y[lags:])
    solution = np.linalg.lstsq(np.vstack(rows), np.vstack(targets), rcond=None)
    theta = solution[0].T
    inputs, outputs = records[0]
    p = outputs.shape[1]
    m = inputs.shape[1]
    a = theta[:, : lags * p].reshape(p, lags, p).transpose(1, 0, 2)
    b = theta[:, lags * p :].reshape(p, -1, m).transpose(1, 0, 2)
    return a, b if feedthrough else np.concatenate([np.zeros((1, p, m)), b])


def arx_impulse_response(
    a: Float[np.ndarray, "lags p p"], b: Float[np.ndarray, "lags1 p m"]
) -> Float[np.ndarray, "K p m"]:
    """Impulse response of an ARX model. `h[k] = b_k + sum_i a_i h[k-i]`; cut where an unstable fit
    grows beyond ten times its early peak."""
    h = np.zeros((RESPONSE, *b.shape[1:]))
    for k in range(RESPONSE):
        recent = h[max(k - len(a), 0) : k][::-1]
        if k:
            h[k] = (a[: len(recent)] @ recent).cumsum(0)[-1]
        if k < len(b):
            h[k] += b[k]
        early_peak = np.abs(h[: len(b)]).max()
        if k > len(b) and np.abs(h[k]).max() > 10 * early_peak:
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
    rows = np.arange(half)[:, None]
    columns = np.arange(half - 1)[None, :]
    blocks = h[1 + rows + columns]  # the direct term h[0] is D
    hankel = blocks.transpose(0, 2, 1, 3).reshape(half * p, (half - 1) * m)
    left, values, right = scipy.linalg.svd(hankel, full_matrices=False)
    rank = min(order, int((values > NOISE_FLOOR * values[0]).sum()))
    root = np.sqrt(values[:rank])
    observability = left[:, :rank] * root
    reachability = root[:, None] * right[:rank]
    a = np.linalg.lstsq(observability[:-p], observability[p:], rcond=None)[0]
    # Separates repeated modes, which no diagonal form can hold.
    a = a + 1e-6 * rng.normal(size=a.shape)

    missing = order - rank
    fast_modes = rng.uniform(0.1, 0.4, size=missing)  # forgotten within a few samples
    more_b = 0.1 * rng.normal(size=(missing, m))
    more_c = 0.1 * rng.normal(size=(p, missing))
    a = scipy.linalg.block_diag(a, np.diag(fast_modes))
    b = np.vstack([reachability[:, :m], more_b])
    c = np.hstack([observability[:p], more_c])
    return StateSpace(a=a, b=b, c=c, d=h[0])


def modal_initialisation(system: StateSpace) -> Initialisation:
    """Initial system in modal form with the eigenvalues of a given system, moved inside the unit
    circle. Real ones come first, then one of each pair; `b`, `c` are in eigenvector coordinates."""
    values, vectors = np.linalg.eig(system.a)
    b = np.linalg.solve(vectors, system.b.astype(complex)).astype(complex)
    c = (system.c @ vectors).astype(complex)
    values = stabilise_eigenvalues(values)
    real = np.flatnonzero(np.isreal(values))
    upper = np.flatnonzero(values.imag > 0)
    indices = np.concatenate([real, upper])
    modes = values[indices].astype(complex)
    return Initialisation(modes=modes, b=b[indices], c=c[:, indices], d=system.d)


def stabilise_eigenvalues(values: Inexact[np.ndarray, "n"]) -> Inexact[np.ndarray, "n"]:
    """Move unstable eigenvalues inside the unit circle by reflection, and limit the modulus of
    all."""
    radius = np.abs(values)
    mirrored = values / np.maximum(radius, 1.0) ** 2
    values = np.where(radius > 1.0, mirrored, values)
    radius = np.abs(values)
    pulled = values * SLOWEST / np.maximum(radius, SLOWEST)
    return np.where(radius > SLOWEST, pulled, values)


class ModelSpec(ABC):
    """Base class of settings that build a trainable model, one class for each model structure.
    `build` draws initial parameters from `seed`."""

    # Whether what is identified is an `SSM`, which the study goes on to certify; a baseline is
    # scored only.
    gives_ssm: ClassVar[bool] = False
    sizes: ClassVar[tuple[str, ...]] = ()  # the fields that are at least 1

    def __post_init__(self) -> None:
        for name in self.sizes:
            require_at_least(1, f"model.{name}", getattr(self, name), "use a positive whole number")

    @abstractmethod
    def build(self, data: DataSet, seed: int) -> "TorchModel":
        """Build the trainable model with initial parameters that are drawn from a seed."""

    def for_training_run(self, start: int) -> "ModelSpec":  # noqa: ARG002
        """Copy of the settings with the initial values for one of several training runs. By default
        they are the same for all; each has its own seed."""
        return self


@dataclass(frozen=True, kw_only=True)
class SSMSpec(ModelSpec):
    """Settings of the linear recurrence between static maps. `x+ = A x + B S_u(u), y = S_y(C x + D
    S_u(u))`: order n, slopes in `[slope_lower, slope_upper]`.

    `start` "ring" draws modes with radii in `ring_radius` and angles (rad per sample) in
    `ring_frequency`, `real_modes` of them real. `slope_*` bound the scaffolding's own sector in
    scaled units; its gain lies in B and C. The states of `dead_time` (samples) come on top of the
    order.
    """

    gives_ssm: ClassVar[bool] = True

    order: int
    hidden_width: int
    slope_lower: float
    slope_upper: float
    feedthrough: bool
    scaffold_in: Trainable
    scaffold_out: Trainable
    start: str = "data"
    real_modes: int = 2
    ring_radius: Range = (0.5, 0.98)
    ring_frequency: Range = (0.05, 1.5)
    dead_time: int = 0

    def __post_init__(self) -> None:
        require_whole_number(0, "dead_time", self.dead_time, "use 0 for none")
        require_whole_number(1, "order", self.order, "a model has at least one state, use 8 or so")
        require_whole_number(1, "hidden_width", self.hidden_width, "use 32 or so")
        check_slope_bounds(self.slope_lower, self.slope_upper)
        require_one_of(("data", "ring"), "model.start", self.start)
        if self.start == "ring":
            self._check_ring()

    def _check_ring(self) -> None:
        """Raise `BadRequest` for an impossible ring or number of random modes."""
        require_whole_number(0, "real_modes", self.real_modes, "use 2")
        pairs = self.order - self.real_modes
        remedy = "leave an even number of states for the pairs"
        fits = pairs >= 0 and pairs % 2 == 0
        problem = f"{self.order} states minus these must be pairs"
        require(fits, "model.real_modes", self.real_modes, problem, remedy)
        for name, most in (("ring_radius", 1.0), ("ring_frequency", np.pi)):
            ends = getattr(self, name)
            fits = len(ends) == 2 and 0 <= ends[0] < ends[1] <= most
            problem = f"needs two increasing numbers in [0, {most:g}]"
            require(fits, f"model.{name}", ends, problem, "correct the range")

    def for_training_run(self, start: int) -> "SSMSpec":
        """Copy of the settings with the initial values for one of several training runs. The first
        begins with an estimated system, the others with random modes."""
        if not start:
            return self
        pairs = (self.order - 1) // 2
        return replace(self, start="ring", real_modes=self.order - 2 * pairs)

    def build(self, data: DataSet, seed: int) -> "TorchSSM":
        """Build the trainable linear recurrence between static maps."""
        from ssm_study.models.torch_ssm import LRU, TorchSSM

        rng = np.random.default_rng(seed)
        inputs, outputs = (np.concatenate(part) for part in zip(*scale_records(data), strict=True))
        scaffold_in = self.scaffold_in.build(self._map_context(inputs), rng)
        scaffold_out = self.scaffold_out.build(self._map_context(outputs), rng)
        start = self._initial_system(scale_records_with_disturbances(data), rng)
        lru = LRU(start, self.feedthrough, data.scale.disturbances)
        return TorchSSM(scaffold_in, lru, scaffold_out)

    def _map_context(self, samples: Float[np.ndarray, "N c"]) -> MapContext:
        """Width, slopes and input samples for one of the static maps."""
        slopes = (self.slope_lower, self.slope_upper)
        return MapContext(width=self.hidden_width, slopes=slopes, samples=samples)

    def _initial_system(self, records: Pairs, rng: np.random.Generator) -> Initialisation:
        """Linear system with which the training begins, estimated or drawn at random."""
        if self.start == "data":
            return estimate_initial_system(records, self.order, rng, self.feedthrough)
        u, y = records[0]
        channels = (u.shape[1], y.shape[1])
        sizes = (self.order, self.real_modes)
        return draw_modes_on_ring(*sizes, self.ring_radius, self.ring_frequency, channels, rng)


def scale_records(data: DataSet) -> Pairs:
    """Training records converted to scaled units. `(u - u_eq) / input_scale`, `(y - y_eq) /
    output_scale`."""
    scale = data.scale
    inputs = [scale.scaled_input(record.u) for record in data.training]
    outputs = [scale.scaled_output(record.y) for record in data.training]
    return list(zip(inputs, outputs, strict=True))


def scale_records_with_disturbances(data: DataSet) -> Pairs:
    """Training records converted to scaled units, with measured disturbances as further inputs."""
    return scale_records(data.with_disturbances_as_inputs())


def require_whole_number(least: int, name: str, value: object, remedy: str) -> None:
    """Raise `BadRequest` for a setting that is no whole number or is below a minimum."""
    fits = isinstance(value, int) and not isinstance(value, bool) and value >= least
    require(fits, f"model.{name}", value, f"must be a whole number, at least {least}", remedy)


def check_slope_bounds(lower: float, upper: float) -> None:
    """Raise `BadRequest` for slope bounds that are empty or include zero."""
    require_positive("model.slope_lower", lower, "use 0.01 or so")
    fits = lower < upper < np.inf
    names = "model.slope_lower, model.slope_upper"
    problem = "the lower slope must lie below the upper one"
    require(fits, names, (lower, upper), problem, "give lower < upper")
