"""Checks that the files in a run's folder are complete and unchanged, have checksums, and are the
only ones."""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from ssm_study.durable import read_json_with_digest, read_limited_bytes
from ssm_study.engine.records import RECORD
from ssm_study.engine.stages import Stage
from ssm_study.engine.store import MANIFEST, damaged_files
from ssm_study.study import trials
from ssm_study.study.findings import CheckedClaim, Claims, UncheckedValues
from ssm_study.study.run_files import CONFIGURATION, OVERRIDES, RunFiles
from ssm_study.study.stages.catalogue import STAGES
from ssm_study.study.stages.dataset import DATASET
from ssm_study.study.stages.free_run import SCORE
from ssm_study.study.stages.model import MODEL

BESIDES = (".hydra/", "attempts/", "csv/", "tensorboard/")  # the last two: logs of the training
LOGS_OF_A_RUN = ("traceback.txt",)
PICTURES_AND_LOGS = frozenset({".log", ".png", ".pdf", ".svg", ".out", ".err", ".ckpt"})
# Of an export; the latter two kinds only in a folder of its own.
CODE = frozenset({".c", ".h", ".onnx"})
BESIDE_CODE = frozenset({".json", ".py"})
STAGES_OF_A_BASELINE = (DATASET, MODEL, SCORE)
MADE_OF_RUNS = "made from runs; ssm-study gather, report and export make them anew"
NOT_REPEATED = "training is not repeated (see ssm-study reproduce)"
NOT_CHOSEN_AGAIN = "the gains are checked; that these settings chose them is not"


def check_files(run: RunFiles) -> Claims:
    """Check that every file of a run exists, has a stored checksum and is unchanged."""
    path = run.path / MANIFEST
    manifest = read_json_with_digest(read_limited_bytes(path)) if path.is_file() else None
    damaged = damaged_files(run.path, manifest) if manifest else [MANIFEST]
    changed = f"changed since: {', '.join(damaged)}"
    observation = changed if damaged else "as they were written"
    yield CheckedClaim(claim="files", holds=not damaged, found=observation)
    if not (run.path / CONFIGURATION).is_file():
        yield CheckedClaim(claim=CONFIGURATION, holds=False, found="is absent")
        return
    sealed_names = set(manifest["files"]) if manifest else set()
    yield from find_foreign_or_absent_files(run, sealed_names)
    yield from list_files_not_checked(run)


def find_foreign_or_absent_files(run: RunFiles, sealed: set[str]) -> Iterator[CheckedClaim]:
    """Failed checks for files of a run that are missing, have no checksum, or should not be
    there."""
    needed = {CONFIGURATION, "model.json", "validation.mcap", "test.mcap", "excitation.mcap"}
    stages: tuple[Stage[Any], ...] = STAGES_OF_A_BASELINE
    if run.has_certifiable_model:
        needed |= {"certificate.json", "evidence.json"}
        stages = (*STAGES, trials.TRIALS)
    present = {CONFIGURATION, *result_file_names(run.path)} - {MANIFEST, RECORD}
    written = {CONFIGURATION, OVERRIDES}
    for stage in stages:
        written.update(stage.files)
    if run.specification.loop.comparison is None:
        written.discard("comparison.csv")
    absent = {name for name in needed if not (run.path / name).is_file()}
    wrong = {
        "is absent": absent,
        "is not sealed": present - sealed,
        "no stage of such a run writes it": sealed - written,
    }
    for observation, names in wrong.items():
        for name in sorted(names):
            yield CheckedClaim(claim=name, holds=False, found=observation)


def result_file_names(folder: Path) -> set[str]:
    """Names of the files in a run folder that count as results of the run."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    names = [path.relative_to(folder).as_posix() for path in paths]
    return {name for name in names if not is_auxiliary_file(name)}


def is_auxiliary_file(name: str) -> bool:
    """Whether a file in a run folder is no result of the run, such as a log, a checkpoint or a
    figure. Also a trace, exported code, Hydra's files, files of an earlier attempt, and names that
    begin with a dot."""
    path = PurePosixPath(name)
    if path.name.startswith(".") or name.startswith(BESIDES):
        return True
    is_log_of_arrays = name.startswith("logs/") and path.suffix == ".parquet"
    is_exported = path.suffix in CODE or ("/" in name and path.suffix in BESIDE_CODE)
    is_picture_or_log = path.suffix in PICTURES_AND_LOGS or path.name in LOGS_OF_A_RUN
    return is_log_of_arrays or is_exported or is_picture_or_log


def list_files_not_checked(run: RunFiles) -> Iterator[UncheckedValues]:
    """List files of a run, and values in these files, that no check recomputes, each with the
    reason."""
    yield UncheckedValues(
        {"runs.parquet, runs.csv, report.html, figures and exports": MADE_OF_RUNS}
    )
    repeated = ("training_curve.json, choice.json", "certificate.json seconds, solver_status")
    reasons = dict.fromkeys(repeated, NOT_REPEATED)
    yield UncheckedValues(reasons | {OVERRIDES: "the configuration alone says what ran"})
    yield UncheckedValues({f"{CONFIGURATION} training, model.starts, model.draws": NOT_REPEATED})
    if run.has_certifiable_model:
        yield UncheckedValues(
            {f"{CONFIGURATION} synthesis, but its method and rates": NOT_CHOSEN_AGAIN}
        )
    if run.specification.loop.comparison is not None:
        yield UncheckedValues({"comparison.csv": "its loops are not kept"})
    if isinstance(run.specification.refine, int):
        reason = "its loops are made again; that these designs were chosen is not"
        yield UncheckedValues({trials.TRIED: reason})
