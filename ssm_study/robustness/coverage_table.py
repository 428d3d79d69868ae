"""Table by frequency of two disc radii: the one that contains the recorded model error, and the one
that the certificate proves.

`coverage_table(premise, weights, centre, kappa)` has one row for every band of every record. Of a
run, `recorded_error_spectra` (`study/stages/synthesis.py`) gives the premise and the certificate
the rest: `disc_weights(part)`, `part.centre`, `part.kappa` with `part =
design.extra_certificates["coverage"]` (`synthesis/measured_discs_run.py`). Source: docs/theory.md,
"Measured discs".
"""

from dataclasses import dataclass

import numpy as np

from ssm_study.robustness.coverage import DiscWeights, ModelErrorSpectra
from ssm_study.robustness.coverage_items import DiscRequirement


@dataclass(frozen=True, kw_only=True)
class CoverageRow:
    """Row of a table: recorded and proved size of the model error in one frequency band of one
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
    premise: ModelErrorSpectra, weights: DiscWeights, centre: float, kappa: float
) -> list[CoverageRow]:
    """Table rows, one for each frequency band of a record, with the disc radius that contains the
    measured model error and the radius that the certificate proves.

    Groups of bands, means and totals have no row, so the largest `need` of the rows may be smaller
    than the need that `coverage` is taken over.
    """
    bands = [item for item in premise.requirements(centre) if item.is_band]
    needs = [weights.required_radius(band) for band in bands]
    largest = max(needs, default=0.0)
    rows = []
    for band, need in zip(bands, needs, strict=True):
        decides = need > 0 and need == largest
        rows.append(_coverage_row(band, weights, kappa, need, is_deciding=decides))
    return rows


def _coverage_row(
    requirement: DiscRequirement,
    weights: DiscWeights,
    kappa: float,
    needed_radius: float,
    *,
    is_deciding: bool,
) -> CoverageRow:
    """Table row with the recorded and the proved size of the model error in one frequency band."""
    model_power = float(requirement.model_power.sum())
    measured = None
    proved_radius = None
    if model_power > 0:
        measured = float(np.sqrt(requirement.seen / model_power))
        reference_power = weights.reference_power(requirement)
        proved_radius = kappa * float(np.sqrt(reference_power / model_power))
    return CoverageRow(
        record=requirement.record,
        frequency=float(requirement.angles.mean()),
        measured=measured,
        proved_radius=proved_radius,
        need=needed_radius,
        is_dark=requirement.dark,
        decides=is_deciding,
    )
