"""The premise of `measured_discs`, as records show it: how far the plant is from its model, by
frequency.

A disc with two references bounds the mismatch `e = y - m` of the model's output m for the input u:

    sum |e - c m|^2  <=  kappa^2 sum ( floor^2 |m|^2 + |W m|^2 + |V u|^2 )

m bounds e where the model speaks, u where it is silent. An `Item` is one piece of one record's
spectrum for which this must hold at `kappa = 1`: a band, a group of neighbouring bands, the total.
Where an input repeats, what does not repeat is noise: of two periods `D_1, D_2` of `e - c m` the
product `Re(D_1 conj D_2)` is the power that repeats, without bias. Below the largest amplitude only
what exceeds `SURE` standard errors counts, in totals whatever repeats. Where nothing repeats, noise
counts as mismatch. Source: docs/theory.md, "Measured discs".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.models.metrics import free_run
from ssm_study.models.structured import Model
from ssm_study.robustness.mismatch import (
    ANGLES,
    EXCITED,
    MOVING,
    QUIET,
    Mismatch,
    bands_of,
    unscored,
)
from ssm_study.robustness.return_to_rest import SURE, is_return, swing
from ssm_study.signals import Trajectories, Trajectory, repetition
from ssm_study.systems import StateSpace

GROUPS = (2, 4, 8, 16)  # neighbouring bands that are also covered together
TOTAL = "in total"
INTEGRATES = (
    "the model integrates, so inputs of finite energy give outputs that have none, and no disc "
    "around them bounds a mismatch"
)
NOT_AT_REST = (
    "the plant does not come to rest by itself at rest input, so no record bounds its mismatch"
)
EMPTY = "no record moves the model's output, so nothing is known of the mismatch"
NO_MISMATCH = "the records show no mismatch at all, so there is nothing to compare the proof with"
Powers = Float[np.ndarray, "L"]


@dataclass(frozen=True, kw_only=True)
class MismatchSpectrum:
    """Line spectra of one record: angles (rad/sample), model output, input, and e in one or two
    periods.

    `sides` is 2 for a line that stands for a conjugate pair, 1 for the mean and for pi. Of a record
    whose input does not repeat there is one period, and its "lines" are the bins of Welch's
    estimate, in which powers stand in place of transforms.
    """

    name: str
    amplitude: float
    angles: Powers
    sides: Powers
    model: Complex[np.ndarray, "2 L p"]
    error: Complex[np.ndarray, "2 L p"]
    input_power: Powers
    noise: Powers

    def deviation(self, centre: float) -> Complex[np.ndarray, "2 L p"]:
        """Both periods of `e - c m`."""
        return self.error - centre * self.model

    @property
    def model_power(self) -> Powers:
        return _power(self.model[1])


@dataclass(frozen=True, kw_only=True)
class AveragedSpectrum:
    """Welch's powers of a record that does not repeat; `cross` is that of e with the model's
    output, real part.

    `drawn` is the noise's share of e's power, and `sure` the factor by which an average may be off:
    zero and one in open loop, where noise counts as mismatch.
    """

    name: str
    amplitude: float
    angles: Powers
    model_power: Powers
    error_power: Powers
    cross: Powers
    input_power: Powers
    drawn: Powers
    sure: Powers

    def deviation_power(self, centre: float) -> Powers:
        """Power of `e - c m` in each bin beyond its noise."""
        power = self.error_power - 2 * centre * self.cross + centre**2 * self.model_power
        return self.sure * np.maximum(power - self.sure * self.drawn, 0.0)


@dataclass(frozen=True, kw_only=True)
class Item:
    """One requirement on the weights: `seen <= sum over lines of (X model + Y input)` at its
    angles.

    X is `floor^2 + |W|^2` and Y `|V|^2`. `dark`: its input has next to no power here, so noise is
    part of what is seen. `is_band`: one band of the record, no group of bands, mean or total.
    """

    record: str
    place: str
    is_band: bool
    angles: Powers
    model_power: Powers
    input_power: Powers
    seen: float
    dark: bool

    @property
    def where(self) -> str:
        """Record and place in its spectrum, in words."""
        return f"{self.record}, {self.place}"


@dataclass(frozen=True, kw_only=True)
class Weights:
    """`floor`, `W = [A_W, B_W; C_W, D_W]` on the model's output and V likewise on the input, one
    channel each.

    Stable, with poles and zeros inside the circle.
    """

    floor: float
    output: Float[np.ndarray, "v v"]
    input: Float[np.ndarray, "v2 v2"]

    def on_output(self, angles: Powers) -> Powers:
        """`floor^2 + |W|^2`."""
        return self.floor**2 + squared_gain(self.output, angles)

    def on_input(self, angles: Powers) -> Powers:
        """`|V|^2`."""
        return squared_gain(self.input, angles)

    def need(self, items: Sequence[Item]) -> tuple[float, str]:
        """The least kappa at which every item holds, and where it is needed; infinite where a
        reference vanishes."""
        needs = [(self.need_of_item(item), item.where) for item in items]
        return max(needs, default=(0.0, ""))

    def need_of_item(self, item: Item) -> float:
        """The least kappa at which this item holds."""
        if item.seen <= 0:
            return 0.0
        reference = self.reference_power(item)
        return float(np.sqrt(item.seen / reference)) if reference > 0 else float("inf")

    def reference_power(self, item: Item) -> float:
        """`sum over the item's lines of (X model + Y input)`."""
        of_output = self.on_output(item.angles) @ item.model_power
        return float(of_output + self.on_input(item.angles) @ item.input_power)


def squared_gain(weight: Float[np.ndarray, "v v"], angles: Powers) -> Powers:
    """`|C (e^{jw} - A)^{-1} B + D|^2` of a filter of one channel, `[A, B; C, D]`."""
    order = len(weight) - 1
    b = weight[:order, order:]
    c = weight[order:, :order]
    shifted = np.exp(1j * angles)[:, None, None] * np.eye(order) - weight[:order, :order]
    state = np.linalg.solve(shifted, np.broadcast_to(b, (len(angles), order, 1)))
    response = (c @ state)[:, 0, 0] + weight[-1, -1]
    return np.asarray(np.abs(response) ** 2)


@dataclass(frozen=True, kw_only=True)
class Premise:
    """Mismatch spectra of all records; `reason` is the sentence that says why nothing can be
    covered, None where it can."""

    repeating: tuple[MismatchSpectrum, ...]
    averaged: tuple[AveragedSpectrum, ...]
    reason: str | None = None

    def items(self, centre: float) -> list[Item]:
        """Every requirement around this centre; the largest repeating record counts without
        doubt."""
        largest = max((record.amplitude for record in self.repeating), default=0.0)
        items = list[Item]()
        for record in self.repeating:
            items += repeating_items(record, centre, sure=record.amplitude == largest)
        for averaged in self.averaged:
            items += averaged_items(averaged, centre)
        return items

    def missing(self, centre: float) -> str | None:
        """Why these records are no premise around this centre; None where they are one."""
        if self.reason is not None:
            return self.reason
        items = self.items(centre)
        if not any(item.model_power.sum() > 0 for item in items):
            return EMPTY
        return None if any(item.seen > 0 for item in items) else NO_MISMATCH


def measure_premise(
    model: Model,
    validation: Trajectories,
    mismatch: Mismatch,
    start_up_samples: int = 0,
    trials: Trajectories = (),
) -> Premise:
    """The premise of the records by which `mismatch` was measured, or the reason why there is
    none."""
    reason = None
    if not mismatch.rests:
        reason = NOT_AT_REST
    elif model.linear.spectral_radius >= 1:
        reason = INTEGRATES
    opened = [*validation, *(r for r in trials if not r.closed_loop and not is_return(r))]
    runs = [_Run.of(model, record, start_up_samples) for record in opened]
    driven = [run for run in runs if run.u.any()]
    periodic = [run for run in driven if run.period is not None]
    noise = _noise_of(periodic) if periodic else None
    closed = [record for record in trials if record.closed_loop]
    loops = [_Run.of(model, record, unscored(record, start_up_samples)) for record in closed]
    moving = [run for run in loops if run.u.any() and swing(run.e + run.m) > MOVING]
    averaged = [_averaged(run, None) for run in driven] if noise is None else []
    return Premise(
        repeating=tuple(_spectrum(run, noise) for run in periodic) if noise is not None else (),
        averaged=tuple(averaged + [_averaged(run, (noise,)) for run in moving]),
        reason=reason,
    )


def repeating_items(record: MismatchSpectrum, centre: float, *, sure: bool) -> list[Item]:
    """Bands, groups of bands and the total of a record with two periods.

    The mean is one more line of the band at zero: an input whose mean is next to nothing has no
    disc of its own there, and what friction adds to the mean comes from the lines around it.
    """
    first, second = record.deviation(centre)
    repeats = record.sides * (first * second.conj()).real.sum(axis=1)
    measured = record.sides * (_power(first) + _power(second)) / 2
    noise = record.sides * record.noise
    variance = record.sides * (noise * record.noise / 2 + record.noise * np.maximum(repeats, 0.0))
    bands = np.concatenate([[0], bands_of(len(record.angles))[0]])
    powers = [record.input_power[bands == b] for b in range(len(ANGLES))]
    has_lines = np.array([len(power) > 0 for power in powers])  # a short period has few lines
    drive = np.array([power.mean() if len(power) else 0.0 for power in powers])
    dark = drive < EXCITED * drive[has_lines].mean()

    def item(
        lines: np.ndarray,
        place: str,
        *,
        doubtful: bool,
        unexcited: bool = False,
        is_band: bool = False,
    ) -> Item:
        error = SURE * np.sqrt(variance[lines].sum()) if doubtful else 0.0
        seen = measured[lines].sum() if unexcited else repeats[lines].sum() - error
        return Item(
            record=record.name,
            place=place,
            is_band=is_band,
            angles=record.angles[lines],
            model_power=(record.sides * record.model_power)[lines],
            input_power=(record.sides * record.input_power)[lines],
            seen=max(float(seen), 0.0),
            dark=unexcited,
        )

    items = list[Item]()
    for b in np.flatnonzero(has_lines):
        place = f"around {ANGLES[b]:.2f} rad/sample"
        unexcited = bool(dark[b])
        lines = bands == b
        items.append(item(lines, place, doubtful=not sure, unexcited=unexcited, is_band=True))
    for size in GROUPS:
        for start in range(0, len(ANGLES), size):
            ends = ANGLES[[start, min(start + size, len(ANGLES)) - 1]]
            place = f"{ends[0]:.2f} to {ends[1]:.2f} rad/sample"
            lines = (bands >= start) & (bands < start + size)
            if not lines.any():
                continue
            unexcited = bool(dark[start : start + size].all())
            items.append(item(lines, place, doubtful=not sure, unexcited=unexcited))
    return [*items, item(bands >= 0, TOTAL, doubtful=False)]


def averaged_items(record: AveragedSpectrum, centre: float) -> list[Item]:
    """Bins and the total of a record that does not repeat."""
    seen = record.deviation_power(centre)
    dark = record.input_power < EXCITED * record.input_power.mean()
    items = list[Item]()
    for k, angle in enumerate(record.angles):
        items.append(
            Item(
                record=record.name,
                place=f"around {angle:.2f} rad/sample",
                is_band=True,
                angles=record.angles[k : k + 1],
                model_power=record.model_power[k : k + 1],
                input_power=record.input_power[k : k + 1],
                seen=float(seen[k]),
                dark=bool(dark[k]),
            )
        )
    total = Item(
        record=record.name,
        place=TOTAL,
        is_band=False,
        angles=record.angles,
        model_power=record.model_power,
        input_power=record.input_power,
        seen=float(seen.sum()),
        dark=False,
    )
    return [*items, total]


def running_sum(
    weights: Weights,
    centre: float,
    kappa: float,
    u: Float[np.ndarray, "T m"],
    m: Float[np.ndarray, "T p"],
    e: Float[np.ndarray, "T p"],
) -> Float[np.ndarray, "T"]:
    """`sum to T of |e - c m|^2 - kappa^2 (floor^2 |m|^2 + |W m|^2 + |V u|^2)`, filters at zero
    before the record."""
    deviation = ((e - centre * m) ** 2).sum(axis=1)
    reference = weights.floor**2 * (m**2).sum(axis=1)
    reference += (filtered(weights.output, m) ** 2).sum(axis=1)
    reference += (filtered(weights.input, u) ** 2).sum(axis=1)
    return np.asarray(np.cumsum(deviation - kappa**2 * reference))


def filtered(
    weight: Float[np.ndarray, "v v"], signal: Float[np.ndarray, "T c"]
) -> Float[np.ndarray, "T c"]:
    """The filter of one channel applied to each channel, from rest."""
    order = len(weight) - 1
    system = StateSpace(
        a=weight[:order, :order],
        b=weight[:order, order:],
        c=weight[order:, :order],
        d=weight[order:, order:],
    )
    columns = [system.simulate(signal[:, [i]])[0] for i in range(signal.shape[1])]
    return np.concatenate(columns, axis=1)


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One record: scaled input, the model's output m, what it misses; `period` samples repeat from
    `start`, twice."""

    name: str
    u: Float[np.ndarray, "T m"]
    m: Float[np.ndarray, "T p"]
    e: Float[np.ndarray, "T p"]
    start: int
    period: int | None

    @classmethod
    def of(cls, model: Model, record: Trajectory, start_up_samples: int) -> "_Run":
        simulated = free_run(model, record, start_up_samples)
        scored = slice(start_up_samples, None)
        repeated = repetition(record.u[scored])
        return cls(
            name=f"input of rms {np.sqrt((model.scale.scaled_input(record.u) ** 2).mean()):.2g}",
            u=model.scale.scaled_input(record.u)[scored],
            m=model.scale.scaled_output(simulated)[scored],
            e=((record.y - simulated) / model.scale.output_scale)[scored],
            start=repeated[0] if repeated else 0,
            period=repeated[1] if repeated else None,
        )

    def periods(self, signal: Float[np.ndarray, "T c"]) -> Complex[np.ndarray, "2 L c"]:
        """The transforms of both periods."""
        assert self.period is not None
        pieces = signal[self.start : self.start + 2 * self.period]
        return np.asarray(np.fft.rfft(pieces.reshape(2, self.period, -1), axis=1))


def _power(spectrum: Complex[np.ndarray, "L c"]) -> Powers:
    return np.asarray((np.abs(spectrum) ** 2).sum(axis=1))


def _noise_of(records: Sequence[_Run]) -> Float[np.ndarray, "F"]:
    """Noise power of a sample in each band, from what does not repeat: the median over the
    records."""
    powers = []
    for run in records:
        first, second = run.periods(run.e)
        half = _power(first - second) / 2
        bands, lines = bands_of(len(half))
        sums = np.bincount(bands, weights=half[1:], minlength=len(ANGLES))
        powers.append(sums / lines / float(run.period or 1))
    return np.asarray(np.median(powers, axis=0))


def _spectrum(run: _Run, noise: Float[np.ndarray, "F"]) -> MismatchSpectrum:
    assert run.period is not None
    angles = 2 * np.pi * np.arange(run.period // 2 + 1) / run.period
    alone = np.isclose(angles, 0.0) | np.isclose(angles, np.pi)
    return MismatchSpectrum(
        name=run.name,
        amplitude=float(np.sqrt((run.u**2).mean())),
        angles=angles,
        sides=np.where(alone, 1.0, 2.0),
        model=run.periods(run.m),
        error=run.periods(run.e),
        input_power=_power(run.periods(run.u)[1]),
        noise=run.period * np.interp(angles, ANGLES, noise),
    )


def _averaged(run: _Run, in_loop: tuple[Float[np.ndarray, "F"] | None] | None) -> AveragedSpectrum:
    """Welch's powers; `in_loop` holds the noise that records in open loop show, None without
    any."""
    segment = 2 * (len(ANGLES) - 1)
    even = max(min(segment, len(run.u)) // 2 * 2, 2)
    powers = [
        scipy.signal.csd(a, b, nperseg=even, detrend=False, axis=0)[1].real.sum(axis=1)
        for a, b in ((run.m, run.m), (run.e, run.e), (run.e, run.m), (run.u, run.u))
    ]
    model_power, error_power, cross, input_power = (len(run.u) * power for power in powers)
    angles = np.linspace(0, np.pi, len(model_power))
    drawn = np.zeros(len(angles))
    sure = 1.0
    if in_loop is not None:
        sides = np.where((angles > 0) & (angles < np.pi), 2.0, 1.0)
        white = np.quantile(error_power[1:-1], QUIET) / 2
        known = in_loop[0]
        drawn = sides * (white if known is None else len(run.u) * np.interp(angles, ANGLES, known))
        sure = 1 + SURE * float(np.sqrt(1.06 * len(angles) / len(run.u)))
    return AveragedSpectrum(
        name=run.name,
        amplitude=float(np.sqrt((run.u**2).mean())),
        angles=angles,
        model_power=model_power,
        error_power=error_power,
        cross=cross,
        input_power=input_power,
        drawn=drawn,
        sure=np.full(len(angles), sure),
    )
