"""Picture of the coverage (tolerated model error divided by the measured one) in each frequency
band."""

import re
from typing import Any

import numpy as np

from ssm_study import style
from ssm_study.api.pictures.margin import InputScale, amplitude_text
from ssm_study.api.pictures.picture import (
    DASH_CYCLE,
    EmptyPictureError,
    GuideLine,
    Picture,
    PicturePanel,
    Series,
)
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.robustness.coverage_spectra import AveragedSpectrum, MismatchSpectrum
from ssm_study.robustness.coverage_table import CoverageRow, coverage_table
from ssm_study.synthesis.measured_discs_run import disc_weights

AMPLITUDE = re.compile(r"input of rms \S+")
ANGLE = re.compile(r"\d+\.\d+(?=( to \S+)? rad/sample)")
HIGHEST = 100.0  # a band that is covered so often says no more than "far"


def coverage_picture(
    design: Design, spectra: ModelErrorSpectra, step_s: float, input_scale: InputScale | None = None
) -> Picture:
    """Picture of the coverage (tolerated model error divided by the measured one) in each frequency
    band.

    Bands in which the record shows no error are left out; crosses are bands without excitation,
    where noise counts as error. With `input_scale`, amplitudes are printed in physical units.
    Raises `EmptyPictureError` without a certificate or without a measured model error.
    """
    part = design.extra_certificates.get(MeasuredDiscs.part)
    if not isinstance(part, MeasuredDiscs):
        raise EmptyPictureError("It is not proved how large a model error these gains tolerate.")
    missing = spectra.insufficient_records_reason(part.centre)
    if missing is not None:
        raise EmptyPictureError(f"Nothing is covered: {missing}.")
    weights = disc_weights(part)
    table = coverage_table(spectra, weights, part.centre, part.kappa)
    rows = [row for row in table if row.need]
    if not rows:
        raise EmptyPictureError("The records show no model error in any band.")
    labels = printed_record_names(spectra, input_scale)
    series = _coverage_curves(rows, part.kappa, step_s, labels)
    requirements = spectra.requirements(part.centre)
    need, where = weights.largest_required_radius(requirements)
    coverage = part.kappa / need
    band = next((row for row in rows if row.decides), None)
    if band is not None and np.isclose(band.need, need, rtol=1e-6):
        dot = _smallest_coverage_dot(band, part.kappa, step_s)
        series.append(dot)
    verdict = "covered" if coverage >= 1 else "not covered"
    deciding = smallest_coverage_record_text(where, labels, step_s)
    title = f"Coverage {_format_coverage(coverage)}, {verdict}; decided by: {deciding}"
    guide_line = GuideLine(y=1.0, dashed=False, name="1: below, not covered")
    rules = (guide_line,)
    all_series = tuple(series)
    panel = PicturePanel(
        x_label="Frequency (Hz)",
        y_label="Proved over measured error (–)",
        series=all_series,
        rules=rules,
        log_x=True,
        log_y=True,
        height=1.6,
    )
    return Picture(title=title, panels=(panel,), wide=True)


def printed_record_names(
    spectra: ModelErrorSpectra, input_scale: InputScale | None
) -> dict[str, str]:
    """Printed name of each record, with the amplitude of the record's input in physical units."""
    record_spectra: list[MismatchSpectrum | AveragedSpectrum] = [
        *spectra.repeating,
        *spectra.averaged,
    ]
    record_spectra += spectra.sines
    return {
        spectrum.name: amplitude_text(spectrum.amplitude, input_scale)
        for spectrum in record_spectra
        if AMPLITUDE.fullmatch(spectrum.name)
    }


def smallest_coverage_record_text(requirement: str, labels: dict[str, str], step_s: float) -> str:
    """Text that names, in physical units, the record and frequency band where the ratio of
    tolerated to measured model error is smallest."""
    record, _, place = requirement.partition(", ")
    turn_s = 2 * np.pi * step_s
    hertz_per_angle = 1 / turn_s
    in_hertz = ANGLE.sub(lambda angle: f"{float(angle[0]) * hertz_per_angle:.3g}", place)
    words = in_hertz.replace("rad/sample", "Hz")
    words = words.replace("around 0 Hz", "the lowest frequencies")
    return f"{labels.get(record, record)}, {words}" if words else labels.get(record, record)


def _coverage_curves(
    rows: list[CoverageRow], kappa: float, step_s: float, labels: dict[str, str]
) -> list[Series]:
    """Curves of the coverage (tolerated over measured model error) by frequency band, one for each
    record."""
    records = list(dict.fromkeys(row.record for row in rows))
    series = []
    for i, record in enumerate(records):
        own = [row for row in rows if row.record == record]
        colour = style.CYCLE[i % len(style.CYCLE)]
        look: dict[str, Any] = {"colour": colour}
        dash_number = i % len(DASH_CYCLE)
        look["dashes"] = DASH_CYCLE[dash_number]
        label = labels.get(record, record)
        series += _record_coverage_curve(own, kappa, step_s, label, look)
    return series


def _record_coverage_curve(
    rows: list[CoverageRow], kappa: float, step_s: float, name: str, look: dict[str, Any]
) -> list[Series]:
    """Curve of the coverage (tolerated over measured model error) of one record by frequency
    band."""
    frequencies = [row.frequency for row in rows]
    angles = np.array(frequencies)
    turn_s = 2 * np.pi * step_s
    hertz = angles / turn_s
    shares = [kappa / row.need for row in rows]
    times = np.minimum(shares, HIGHEST)
    darkness = [row.is_dark for row in rows]
    is_dark = np.array(darkness)
    is_drawn = hertz > 0
    lit = Series(x=hertz[is_drawn], y=times[is_drawn], name=name, **look)
    dark = is_dark & is_drawn
    if not dark.any():
        return [lit]
    series = Series(
        x=hertz[dark],
        y=times[dark],
        mark="crosses",
        colour=look["colour"],
        name="no input power: noise counts",
    )
    return [lit, series]


def _smallest_coverage_dot(band: CoverageRow, kappa: float, step_s: float) -> Series:
    """Dot at the frequency band with the smallest ratio of tolerated to measured model error."""
    turn_s = 2 * np.pi * step_s
    hertz = band.frequency / turn_s
    coverage = [kappa / band.need]
    y = np.array(coverage)
    at_hertz = np.array([hertz])
    return Series(x=at_hertz, y=y, mark="point", colour=style.INK, name=f"decides, {hertz:.3g} Hz")


def _format_coverage(coverage: float) -> str:
    """Text of a coverage (tolerated model error relative to the measured one), rounded down to two
    digits."""
    return f"{np.floor(100 * coverage) / 100:.2f}"
