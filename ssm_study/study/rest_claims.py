"""Checks of the certificates of a saved controller design for a bilinear model."""

from collections.abc import Iterator
from pathlib import Path

from ssm_study.api.rest_design import CERTIFICATE, CHANNELS, MODEL, foreign_files
from ssm_study.certificates.bilinear_certificates import BilinearDesign, failed_bilinear_checks
from ssm_study.durable import read_json
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.stored import model_from_json
from ssm_study.refusal import BadRequest
from ssm_study.study.findings import CheckedClaim

LABELS = {CHANNELS: "names and units, which decide nothing"}
NO_FILES = (BadRequest, ValueError, KeyError, TypeError)


def check_rest_design(folder: Path) -> Iterator[CheckedClaim]:
    """Check every certificate of a saved design for a bilinear model again in exact arithmetic."""
    for name in foreign_files(folder):
        yield CheckedClaim(claim=name, holds=False, found="belongs to no saved bilinear design")
    try:
        model = model_from_json(read_json(folder / MODEL))
        content = read_json(folder / CERTIFICATE)
    except NO_FILES as error:
        yield CheckedClaim(claim=MODEL, holds=False, found=str(error))
        return
    if not isinstance(model, Bilinear):
        yield CheckedClaim(claim=MODEL, holds=False, found="has no products of input and state")
        return
    broken = failed_bilinear_checks(content, model)
    for sentence in broken:
        yield CheckedClaim(claim=CERTIFICATE, holds=False, found=sentence)
    if not broken:
        for label, part in BilinearDesign.from_json(content).parts.items():
            verdict = "certified" if part.certified else "not certified"
            yield CheckedClaim(claim=f"certificate.{label}", holds=True, found=verdict)
