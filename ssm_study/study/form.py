"""Checks of the form of a run's files, apart from the numbers in them."""

import codecs
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ssm_study.certificates.certificate import Infeasible
from ssm_study.columns import Column
from ssm_study.durable import open_regular_file
from ssm_study.loop.regulation import IdentifiedPlant
from ssm_study.study.findings import CheckedClaim, Claims, UncheckedValues
from ssm_study.study.loop_recordings import NOISE_FREE
from ssm_study.study.recording_labels import TOPICS_BY_FILE, find_foreign_contents
from ssm_study.study.recordings import RecordedCases
from ssm_study.study.run_files import RunFiles
from ssm_study.table.columns import find_declaration

ERRORS = ("error_message", "error_type", "failure_transient")
BEFORE = "fit_test_before_reduction_percent"
LONGEST_REASON = 400  # characters: ours have 200
TEXTS = (".json", ".yaml", ".csv")
INFINITIES = ("inf", "-inf")  # texts in a record, which JSON has no numbers for
TYPES: dict[str, tuple[type, ...]] = {
    "string": (str,),
    "Int64": (int,),
    "Float64": (float, int),
    "boolean": (bool,),
}


def check_form(run: RunFiles) -> Claims:
    """Check the form of a run's files: types of recorded values, unknown entries, links."""
    yield from _symbolic_link_failures(run.path)
    yield from _byte_order_mark_failures(run.path)
    yield from _foreign_content_failures(run.path)
    for name in ERRORS:
        if run.record.get(name) is not None:
            observation = "stands in the record of a run that did not fail"
            yield CheckedClaim(claim=name, holds=False, found=observation)
    for name, value in run.record.items():
        column = find_declaration(name)
        if column is None or column.is_pattern:  # those of one pattern may differ in kind
            continue
        if not has_declared_type(column, value):
            observation = f"is a {type(value).__name__}, not a {column.kind}"
            yield CheckedClaim(claim=f"{name} kind", holds=False, found=observation)
    yield from _check_unreduced_fit(run)
    if run.has_certifiable_model:
        yield from _check_reason_texts(run)
    if run.can_close_loop:
        yield from _check_settling_bands(run)


def has_declared_type(column: Column, value: Any) -> bool:
    """Whether a recorded value is null or of the type that its table column declares."""
    if value is None or column.kind is None:
        return True
    if column.kind == "Float64" and value in INFINITIES:
        return True
    is_truth = isinstance(value, bool)
    return is_truth == (column.kind == "boolean") and isinstance(value, TYPES[column.kind])


def _symbolic_link_failures(folder: Path) -> Iterator[CheckedClaim]:
    """Failed checks for symbolic links in a run folder, one for each link."""
    links = [path for path in sorted(folder.rglob("*")) if path.is_symlink()]
    for path in links:
        name = path.relative_to(folder).as_posix()
        yield CheckedClaim(claim=name, holds=False, found="is a link, and no file of this run")


def _byte_order_mark_failures(folder: Path) -> Iterator[CheckedClaim]:
    """Failed checks for text files of a run that begin with a byte order mark, one for each
    file."""
    for path in sorted(folder.rglob("*")):
        if path.suffix not in TEXTS or path.is_symlink() or not path.is_file():
            continue
        with open_regular_file(path) as stream:
            begins = stream.read(4)
        if begins.startswith((codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            name = path.relative_to(folder).as_posix()
            yield CheckedClaim(claim=name, holds=False, found="begins with a byte order mark")


def _foreign_content_failures(folder: Path) -> Iterator[CheckedClaim]:
    """Failed checks for recordings with signals or attachments that no run writes, one for each
    file."""
    for path in sorted(folder.glob("*.mcap")):
        if path.name not in TOPICS_BY_FILE or path.is_symlink():
            continue  # another file is a failed claim by its name
        foreign = find_foreign_contents(path)
        if foreign:
            observation = f"no run writes there: {', '.join(foreign[:5])}"
            yield CheckedClaim(claim=f"{path.name} contents", holds=False, found=observation)


def _check_unreduced_fit(run: RunFiles) -> Iterator[CheckedClaim]:
    """Check that the fits before and after model reduction are equal where no state was removed."""
    before = run.record.get(BEFORE)
    requested = run.specification.configuration["model"].get("order")
    if not run.has_certifiable_model or run.model.order != requested or before is None:
        return
    fit = run.record.get("fit_test_percent")
    same = False
    if isinstance(fit, float) and isinstance(before, float):
        same = abs(before - fit) <= 1e-6 * max(1.0, abs(fit))
    yield CheckedClaim(claim=BEFORE, holds=same, found=f"nothing was reduced, and the fit is {fit}")


def _check_reason_texts(run: RunFiles) -> Claims:
    """Check that the recorded reason for a missing certificate is a single short line."""
    for label, part in run.design.certificates_by_name.items():
        if not isinstance(part, Infeasible):
            continue
        is_sentence = part.reason.isprintable() and len(part.reason) <= LONGEST_REASON
        claim = f"certificate.{label} reason"
        if not is_sentence:
            yield CheckedClaim(claim=claim, holds=False, found="is no sentence of one line")
        else:
            yield UncheckedValues({claim: "words, which decide nothing"})


def _check_settling_bands(run: RunFiles) -> Claims:
    """Check that each recording of a closed loop states the settling band of its plant."""
    if run.missing_log_reason:
        claim = "closed_loop_model.mcap settling_band"
        yield UncheckedValues({claim: run.missing_log_reason})
        return
    twin = IdentifiedPlant.from_model(run.model, run.data.inputs, run.data.outputs)
    for name in ("closed_loop.mcap", NOISE_FREE, "closed_loop_model.mcap"):
        path = run.path / name
        if not path.is_file():
            continue
        plant = twin if name == "closed_loop_model.mcap" else run.plant
        stored = RecordedCases.from_file(path).settling_band
        same = abs(stored - plant.settling_band) <= 1e-9 * abs(plant.settling_band)
        observation = f"{stored}, and the plant's is {plant.settling_band}"
        yield CheckedClaim(claim=f"{name} settling_band", holds=same, found=observation)
