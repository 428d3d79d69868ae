"""Signals that make a system show itself: the interface, and the two the study trains on."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import max_len_seq

from ssm_study.refusal import require

Amplitude = float | tuple[float, ...] | list[float] | None


@dataclass(frozen=True, kw_only=True)
class Request:
    """`samples` every `step_s`, offsets up to `amplitude (m,)` from equilibrium, levels held at least `clock_s`."""

    samples: int
    step_s: float
    amplitude: tuple[float, ...]
    clock_s: float

    @property
    def inputs(self) -> int:
        return len(self.amplitude)


class Excitation(ABC):
    """`|u_i - u_eq,i| <= amplitude_i`: offsets `(T, m)` in physical units; equal generators give equal signals.

    `amplitude` and `clock_s` None take the plant's own. Every channel gets a signal of its own.
    """

    amplitude: Amplitude
    clock_s: float | None

    @property
    @abstractmethod
    def kind(self) -> str:
        """The name under which records file it."""

    @abstractmethod
    def unit_signal(self, request: Request, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
        """The signal for amplitude one: values in [-1, 1]."""

    def signal(self, request: Request, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
        asked = self._asked(request)
        return self.unit_signal(asked, rng) * np.array(asked.amplitude)

    def _asked(self, request: Request) -> Request:
        """The request with this excitation's own amplitude and clock in place of the plant's."""
        amplitude = request.amplitude if self.amplitude is None else self.amplitude
        given = (float(amplitude),) * request.inputs if isinstance(amplitude, int | float) else tuple(amplitude)
        require(
            len(given) == request.inputs,
            "excitation.amplitude",
            given,
            f"one number or one per input is needed, and the plant has {request.inputs}",
            "give as many",
        )
        clock_s = request.clock_s if self.clock_s is None else self.clock_s
        return Request(samples=request.samples, step_s=request.step_s, amplitude=given, clock_s=clock_s)


def check_common(amplitude: Amplitude, clock_s: float | None) -> None:
    """Refuse an amplitude or a clock that is not positive and finite."""
    given = [amplitude] if isinstance(amplitude, int | float) else list(amplitude or [])
    for value in given:
        require(
            0 < value < np.inf,
            "excitation.amplitude",
            value,
            "must be positive and finite",
            "give it in the input's unit",
        )
    require(
        clock_s is None or 0 < clock_s < np.inf,
        "excitation.clock_s",
        clock_s,
        "must be positive and finite",
        "give seconds",
    )


def clock_samples(clock_s: float, step_s: float) -> int:
    """Whole samples in a clock period; at least one."""
    samples = round(clock_s / step_s)
    require(
        samples >= 1,
        "excitation.clock_s",
        clock_s,
        f"shorter than half the sampling time of {step_s:g} s",
        "hold each level for at least one sample",
    )
    return samples


@dataclass(frozen=True, kw_only=True)
class PRBS(Excitation):
    """`u in {-A, +A}`: a maximum-length shift register of `register_bits` bits, clocked every `clock_s`.

    Period `2^bits - 1` clocks with a flat spectrum up to about `0.44 / clock_s`. Each channel starts the register
    elsewhere. Two levels show a static input nonlinearity at two points only: its slopes are not identifiable.
    """

    kind = "prbs"

    register_bits: int
    amplitude: Amplitude = None
    clock_s: float | None = None

    def __post_init__(self) -> None:
        check_common(self.amplitude, self.clock_s)
        bits = self.register_bits
        require(2 <= bits <= 32, "excitation.register_bits", bits, "a register has 2 to 32 bits", "use 9 or so")

    def unit_signal(self, request: Request, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
        hold = clock_samples(request.clock_s, request.step_s)
        clocks = -(-request.samples // hold)
        columns = []
        for _ in range(request.inputs):
            start = rng.integers(0, 2, self.register_bits)
            start[0] |= not start.any()  # the all-zero register never moves
            bits, _ = max_len_seq(self.register_bits, state=start, length=clocks)
            columns.append(np.repeat(2.0 * bits - 1.0, hold)[: request.samples])
        return np.stack(columns, axis=1)


@dataclass(frozen=True, kw_only=True)
class APRBS(Excitation):
    """Levels uniform in `[-A, A]`, each held for a whole number of clocks uniform in `1 .. longest_hold_clocks`.

    A multilevel signal visits the whole input range, so the slopes of a static input nonlinearity can be identified.
    """

    kind = "aprbs"

    longest_hold_clocks: int
    amplitude: Amplitude = None
    clock_s: float | None = None

    def __post_init__(self) -> None:
        check_common(self.amplitude, self.clock_s)
        longest = self.longest_hold_clocks
        require(longest >= 1, "excitation.longest_hold_clocks", longest, "must be at least one", "use 5 or so")

    def unit_signal(self, request: Request, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
        clock = clock_samples(request.clock_s, request.step_s)
        most = -(-request.samples // clock)
        columns = []
        for _ in range(request.inputs):
            holds = clock * rng.integers(1, self.longest_hold_clocks + 1, most)
            columns.append(np.repeat(rng.uniform(-1.0, 1.0, most), holds)[: request.samples])
        return np.stack(columns, axis=1)
