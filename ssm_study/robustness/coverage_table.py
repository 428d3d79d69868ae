"""Table of the coverage by frequency: the disc radius that each band of the records needs, and the
radius that is proved.

`coverage_table(premise, weights, centre, kappa)` has one row for every band of every record. Of a
run, `recorded_error_spectra` (`study/stages/synthesis.py`) gives the premise and the certificate
the rest: `certificate_weights(part)`, `part.centre`, `part.kappa` with `part =
design.extra_certificates["coverage"]` (`synthesis/measured_discs_run.py`). Source: docs/theory.md,
"Measured discs".
"""

from dataclasses import dataclass

import numpy as np

from ssm_study.robustness.coverage import Premise, Weights
from ssm_study.robustness.coverage_items import Item


@dataclass(frozen=True, kw_only=True)
class CoverageBand:
    """Row of the coverage table: measured and proved disc radius in one frequency band of one
    record. The disc is around `c m`.

    `record` names the record by its input's rms; `frequency` is the band's middle in rad/sample.
    `measured` is the deviation `|e - c m|` that the record shows and `proved_radius` the largest
    one that the proof allows, both over the model's output `|m|` in that band; both are None where
    the model's output has no power. `need` is the kappa at which the disc just holds the record;
    the band is covered where it is at most the proved kappa. `is_dark`: the input has next to no
    power there, so noise counts as mismatch. `decides`: the band with the largest need of all.
    """

    record: str
    frequency: float
    measured: float | None
    proved_radius: float | None
    need: float
    is_dark: bool
    decides: bool


def coverage_table(
    premise: Premise, weights: Weights, centre: float, kappa: float
) -> list[CoverageBand]:
    """Rows with the proved and the needed disc radius in every frequency band of every record, in
    the order of frequency.

    Groups of bands, means and totals have no row, so the largest `need` of the rows may be smaller
    than the need that `coverage` is taken over.
    """
    bands = [item for item in premise.requirements(centre) if item.is_band]
    needs = [weights.required_radius(band) for band in bands]
    largest = max(needs, default=0.0)
    rows = []
    for band, need in zip(bands, needs, strict=True):
        decides = need > 0 and need == largest
        rows.append(_band_row(band, weights, kappa, need, decides=decides))
    return rows


def _band_row(
    band: Item, weights: Weights, kappa: float, need: float, *, decides: bool
) -> CoverageBand:
    """Row of the coverage table for one frequency band."""
    model_power = float(band.model_power.sum())
    measured = None
    proved_radius = None
    if model_power > 0:
        measured = float(np.sqrt(band.seen / model_power))
        reference_power = weights.reference_power(band)
        proved_radius = kappa * float(np.sqrt(reference_power / model_power))
    return CoverageBand(
        record=band.record,
        frequency=float(band.angles.mean()),
        measured=measured,
        proved_radius=proved_radius,
        need=need,
        is_dark=band.dark,
        decides=decides,
    )
