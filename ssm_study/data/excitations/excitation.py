"""Base class of excitation signals, and signals with random levels. Signals that make a system show
itself: the interface, and the two the study trains on."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.refusal import require, require_at_least, require_positive

Inputs = Float[np.ndarray, "T m"]

Amplitude = float | tuple[float, ...] | list[float] | None


@dataclass(frozen=True, kw_only=True)
class SignalRequest:
    """Number of samples, sampling period, amplitude and clock period that an excitation signal
    shall have. `samples` every `step_s`, offsets up to `amplitude (m,)` from equilibrium, levels
    held at least `clock_s`."""

    samples: int
    step_s: float
    amplitude: tuple[float, ...]
    clock_s: float

    @property
    def inputs(self) -> int:
        """Number of input channels of the signal."""
        return len(self.amplitude)

    @property
    def clock_period_samples(self) -> int:
        """Shortest holding time of an excitation level (clock period), in whole sampling periods.
        Raises `BadRequest` for less than one."""
        samples = round(self.clock_s / self.step_s)
        problem = f"shorter than half the sampling time of {self.step_s:g} s"
        remedy = "hold each level for at least one sample"
        require(samples >= 1, "excitation.clock_s", self.clock_s, problem, remedy)
        return samples


@dataclass(frozen=True, kw_only=True)
class Excitation(ABC):
    """Base class of excitation signals, given as offsets from a plant's equilibrium input. Offsets
    `(T, m)` in physical units with `|u_i - u_eq,i| <= amplitude_i`; equal generators give equal
    signals.

    `amplitude` and `clock_s` None take the plant's own. Every channel gets a signal of its own.
    """

    amplitude: Amplitude = None
    clock_s: float | None = None

    def __post_init__(self) -> None:
        require_positive("excitation.amplitude", self.amplitude, "give it in the input's unit")
        require_positive("excitation.clock_s", self.clock_s, "give seconds")

    @property
    @abstractmethod
    def kind(self) -> str:
        """Name of the kind of excitation signal in results, such as `prbs`."""

    @abstractmethod
    def unit_signal(self, request: SignalRequest, rng: np.random.Generator) -> Inputs:
        """Generate an excitation signal of amplitude one, with values in [-1, 1]."""

    def signal(self, request: SignalRequest, rng: np.random.Generator) -> Inputs:
        """Generate an excitation signal in the physical units of the input."""
        own_request = self._apply_own_amplitude_and_clock(request)
        return self.unit_signal(own_request, rng) * np.array(own_request.amplitude)

    def _apply_own_amplitude_and_clock(self, request: SignalRequest) -> SignalRequest:
        """Replace the plant's default amplitude and holding time by the excitation's own, where the
        excitation sets them."""
        amplitude = request.amplitude if self.amplitude is None else self.amplitude
        if isinstance(amplitude, int | float):
            amplitudes = (float(amplitude),) * request.inputs
        else:
            amplitudes = tuple(amplitude)
        problem = f"one number or one per input is needed, and the plant has {request.inputs}"
        remedy = "give one number for all, or one for each"
        require(
            len(amplitudes) == request.inputs, "excitation.amplitude", amplitudes, problem, remedy
        )
        return replace(
            request,
            amplitude=amplitudes,
            clock_s=request.clock_s if self.clock_s is None else self.clock_s,
        )


def check_frequency_band(low_hz: float | None, high_hz: float | None, name: str = "") -> None:
    """Raise `BadRequest` for a frequency band whose ends are not positive and in increasing
    order."""
    require_positive(f"excitation.{name}low_hz", low_hz, "give hertz, or null")
    require_positive(f"excitation.{name}high_hz", high_hz, "give hertz, or null")
    ordered = low_hz is None or high_hz is None or low_hz < high_hz
    problem = f"not below {name}high_hz = {high_hz}"
    remedy = "swap them"
    require(ordered, f"excitation.{name}low_hz", low_hz, problem, remedy)


@dataclass(frozen=True, kw_only=True)
class PRBS(Excitation):
    """Excitation signal: pseudo-random binary sequence, which switches between two levels. `u in
    {-A, +A}`: a maximum-length shift register of `register_bits` bits, clocked every `clock_s`.

    Period `2^bits - 1` clocks with a flat spectrum up to about `0.44 / clock_s`. Each channel
    starts the register elsewhere. Two levels show a static input nonlinearity at two points only:
    its slopes are not identifiable.
    """

    kind = "prbs"

    register_bits: int

    def __post_init__(self) -> None:
        super().__post_init__()
        bits = self.register_bits
        problem = "a register has 2 to 32 bits"
        remedy = "use 9 or so"
        require(2 <= bits <= 32, "excitation.register_bits", bits, problem, remedy)

    def unit_signal(self, request: SignalRequest, rng: np.random.Generator) -> Inputs:
        hold = request.clock_period_samples
        columns = []
        for _ in range(request.inputs):
            start = rng.integers(0, 2, self.register_bits)
            start[0] |= not start.any()  # the all-zero register never moves
            bits, _ = scipy.signal.max_len_seq(
                self.register_bits, state=start, length=-(-request.samples // hold)
            )
            levels = np.repeat(2.0 * bits - 1.0, hold)
            columns.append(levels[: request.samples])
        return np.stack(columns, axis=1)


@dataclass(frozen=True, kw_only=True)
class APRBS(Excitation):
    """Excitation signal: amplitude-modulated pseudo-random sequence, with random levels and holding
    times. Levels uniform in `[-A, A]`, each held for a whole number of clocks uniform in `1 ..
    longest_hold_clocks`.

    A multilevel signal visits the whole input range, so the slopes of a static input nonlinearity
    can be identified.
    """

    kind = "aprbs"

    longest_hold_clocks: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(
            1, "excitation.longest_hold_clocks", self.longest_hold_clocks, "use 5 or so"
        )

    def unit_signal(self, request: SignalRequest, rng: np.random.Generator) -> Inputs:
        clock = request.clock_period_samples
        columns = []
        most = -(-request.samples // clock)  # levels, if each were held for one clock
        for _ in range(request.inputs):
            holds = clock * rng.integers(1, self.longest_hold_clocks + 1, most)
            levels = np.repeat(rng.uniform(-1.0, 1.0, most), holds)
            columns.append(levels[: request.samples])
        return np.stack(columns, axis=1)
