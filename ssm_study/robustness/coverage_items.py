"""Inequalities that a disc of model errors must satisfy for one record: per frequency band, group
of bands, and in total.

Below the largest amplitude only what exceeds `SURE` standard errors counts, in totals whatever
repeats; where nothing repeats, noise counts as mismatch. Source: docs/trust.md, "Covered".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from ssm_study.robustness.bands import ANGLES, assign_lines_to_bands, line_powers
from ssm_study.robustness.coverage_spectra import AveragedSpectrum, MismatchSpectrum, Powers
from ssm_study.robustness.record_errors import EXCITED
from ssm_study.robustness.return_to_rest import SURE
from ssm_study.robustness.single_sines import SineMismatch

GROUPS = (2, 4, 8, 16)  # neighbouring bands that are also covered together
TOTAL = "in total"

LineSelection = Bool[np.ndarray, "L"]
BandSelection = Bool[np.ndarray, "F"]


@dataclass(frozen=True, kw_only=True)
class DiscRequirement:
    """Inequality that a disc of model errors must satisfy to contain the error in one frequency
    range of a record. It is `seen <= sum over lines of (X model + Y input)` at its angles.

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
    def label(self) -> str:
        """Name of the record and of the frequency range in which the disc must contain the model
        error."""
        return f"{self.record}, {self.place}"


@dataclass(frozen=True, kw_only=True)
class PeriodicErrorPower:
    """Power of the model error in a record with two equal periods, at each spectral line, measured
    from the centre of a disc. Powers of `e - c m` in its lines.

    `repeats` is the product of both periods, `measured` their mean power, noise included,
    `variance` that of `repeats`. `bands` holds the band of each line; `dark` says of each band
    whether the input has next to no power in it, and `has_lines` whether any line lies in it (a
    short period has few).
    """

    record: MismatchSpectrum
    repeats: Powers
    measured: Powers
    variance: Powers
    bands: Int[np.ndarray, "L"]
    dark: BandSelection
    has_lines: BandSelection

    @classmethod
    def from_record(cls, record: MismatchSpectrum, centre: float) -> "PeriodicErrorPower":
        """Powers of model error and noise at each spectral line of a record with two equal periods.
        The mean belongs to no band: friction leaves an offset that no disc bounds, since it stays
        where model and input have come to rest. Source: docs/trust.md, "Covered"."""
        first, second = record.error_minus_centre(centre)
        sides = record.sides
        product = (first * second.conj()).real
        repeating_power = product.sum(axis=1)
        repeats = sides * repeating_power
        noise = sides * record.noise
        of_noise = noise * record.noise / 2
        of_product = record.noise * np.maximum(repeats, 0.0)
        variance = sides * (of_noise + of_product)
        line_bands, _ = assign_lines_to_bands(len(record.angles))
        bands = np.concatenate([[-1], line_bands])
        powers = [record.input_power[bands == band] for band in range(len(ANGLES))]
        has_lines = np.array([len(power) > 0 for power in powers])
        mean_powers = [power.mean() if len(power) else 0.0 for power in powers]
        drive = np.array(mean_powers)
        both_periods = line_powers(first) + line_powers(second)
        measured = sides * both_periods / 2
        dark = drive < EXCITED * drive[has_lines].mean()
        return cls(
            record=record,
            repeats=repeats,
            measured=measured,
            variance=variance,
            bands=bands,
            dark=dark,
            has_lines=has_lines,
        )

    def error_power_at_lines(
        self, lines: LineSelection, *, is_doubtful: bool, is_unexcited: bool = False
    ) -> float:
        """Power of the model error over several spectral lines, with noise subtracted where the
        noise power is known."""
        if is_unexcited:
            measured = self.measured[lines]
            return float(measured.sum())
        error = 0.0
        if is_doubtful:
            variance = self.variance[lines].sum()
            error = SURE * np.sqrt(variance)
        repeats = self.repeats[lines].sum()
        return max(float(repeats - error), 0.0)

    def requirement_at_lines(
        self,
        lines: LineSelection,
        range_label: str,
        *,
        is_doubtful: bool,
        is_unexcited: bool = False,
        is_band: bool = False,
    ) -> DiscRequirement:
        """Inequality that a disc must satisfy to contain the model error at several spectral lines
        together."""
        record = self.record
        measured_power = self.error_power_at_lines(
            lines, is_doubtful=is_doubtful, is_unexcited=is_unexcited
        )
        model_power = record.sides * record.model_power
        input_power = record.sides * record.input_power
        return DiscRequirement(
            record=record.name,
            place=range_label,
            is_band=is_band,
            angles=record.angles[lines],
            model_power=model_power[lines],
            input_power=input_power[lines],
            seen=measured_power,
            dark=is_unexcited,
        )


def requirements_from_periods(
    record: MismatchSpectrum, centre: float, *, has_no_doubt: bool
) -> list[DiscRequirement]:
    """Inequalities that a disc must satisfy to contain the model error in a record with two equal
    periods. In a `has_no_doubt` record everything that repeats counts."""
    powers = PeriodicErrorPower.from_record(record, centre)
    items = list[DiscRequirement]()
    for band in np.flatnonzero(powers.has_lines):
        place = f"around {ANGLES[band]:.2f} rad/sample"
        lines = powers.bands == band
        is_dark = bool(powers.dark[band])
        item = powers.requirement_at_lines(
            lines, place, is_doubtful=not has_no_doubt, is_unexcited=is_dark, is_band=True
        )
        items.append(item)
    for size in GROUPS:
        items += _requirements_from_band_groups(powers, size, is_doubtful=not has_no_doubt)
    every_line = powers.bands >= 0
    total = powers.requirement_at_lines(every_line, TOTAL, is_doubtful=False)
    return [*items, total]


def _requirements_from_band_groups(
    powers: PeriodicErrorPower, bands_per_group: int, *, is_doubtful: bool
) -> list[DiscRequirement]:
    """Inequalities that a disc must satisfy to contain the model error in groups of neighbouring
    frequency bands."""
    items = list[DiscRequirement]()
    for start in range(0, len(ANGLES), bands_per_group):
        end = start + bands_per_group
        lines = (powers.bands >= start) & (powers.bands < end)
        if not lines.any():
            continue
        last = min(end, len(ANGLES)) - 1
        place = f"{ANGLES[start]:.2f} to {ANGLES[last]:.2f} rad/sample"
        dark_bands = powers.dark[start:end]
        is_dark = bool(dark_bands.all())
        item = powers.requirement_at_lines(
            lines, place, is_doubtful=is_doubtful, is_unexcited=is_dark
        )
        items.append(item)
    return items


def requirement_from_sine(record: MismatchSpectrum, centre: float) -> DiscRequirement:
    """Inequality that a disc must satisfy to contain the model error in a single-sine record, at
    the sine's frequency."""
    powers = PeriodicErrorPower.from_record(record, centre)
    without_mean = record.input_power[1:]
    strongest = 1 + int(without_mean.argmax())
    lines = np.arange(len(record.angles))
    line = lines == strongest
    angle = float(record.angles[strongest])
    place = f"one sine at {angle:.2f} rad/sample"
    return powers.requirement_at_lines(line, place, is_doubtful=True, is_band=True)


def requirement_from_measured_sine(sine: SineMismatch, centre: float) -> DiscRequirement | None:
    """Inequality that a disc must satisfy to contain the model error in a single-sine test of a
    finished design; None if the powers are not stored. With `D = e - c m` of both periods,

        Re(D_1 conj D_2) = error - 2 c cross + c^2 model

    of which three standard errors of the noise are left out, as in a record of a sine.
    """
    if sine.error_power is None or sine.cross_power is None:
        return None
    assert sine.model_power is not None
    assert sine.noise_power is not None
    cross = 2 * centre * sine.cross_power
    at_centre = centre**2 * sine.model_power
    repeats = sine.error_power - cross + at_centre
    of_noise = sine.noise_power**2 / 2
    of_product = sine.noise_power * max(repeats, 0.0)
    variance = of_noise + of_product
    standard_error = float(np.sqrt(variance))
    seen = repeats - SURE * standard_error
    record = f"input of rms {sine.amplitude:.2g}"
    place = f"one sine at {sine.angle:.2f} rad/sample"
    angles = np.array([sine.angle])
    model_powers = np.array([sine.model_power])
    return DiscRequirement(
        record=record,
        place=place,
        is_band=True,
        angles=angles,
        model_power=model_powers,
        input_power=np.ones(1),
        seen=max(seen, 0.0),
        dark=False,
    )


def requirements_from_averaged_spectrum(
    record: AveragedSpectrum, centre: float
) -> list[DiscRequirement]:
    """Inequalities that a disc must satisfy to contain the model error in a record whose input does
    not repeat: one per frequency bin, and one in total."""
    measured_power = record.error_power_about_centre(centre)
    mean_input_power = record.input_power.mean()
    dark = record.input_power < EXCITED * mean_input_power
    items = list[DiscRequirement]()
    for k, angle in enumerate(record.angles):
        bin_of_record = slice(k, k + 1)
        item = DiscRequirement(
            record=record.name,
            place=f"around {angle:.2f} rad/sample",
            is_band=True,
            angles=record.angles[bin_of_record],
            model_power=record.model_power[bin_of_record],
            input_power=record.input_power[bin_of_record],
            seen=float(measured_power[k]),
            dark=bool(dark[k]),
        )
        items.append(item)
    total = DiscRequirement(
        record=record.name,
        place=TOTAL,
        is_band=False,
        angles=record.angles,
        model_power=record.model_power,
        input_power=record.input_power,
        seen=float(measured_power.sum()),
        dark=False,
    )
    return [*items, total]
