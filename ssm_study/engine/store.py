"""Store of stage results, each computed once, stored under a key, and checked bit by bit when
read."""

import errno
import os
import secrets
import shutil
import socket
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ssm_study import durable
from ssm_study.durable import (
    add_digest,
    file_lock,
    flush_to_disk,
    read_json_with_digest,
    read_limited_bytes,
    sha256_of_file,
)
from ssm_study.engine.records import storable_value
from ssm_study.engine.settings import digest_of_value
from ssm_study.engine.stages import Compute, Facts, StageOutput, StageResult, Stages, columns_key
from ssm_study.refusal import require

MANIFEST = "manifest.json"
ABANDONED_S = 7 * 24 * 3600.0  # without a change: what another node left is then nobody's
# What a computation may save to go on from; checked by itself, of the same key by its place.
CHECKPOINT = "last.ckpt"


@dataclass(frozen=True)
class Store(Stages):
    """Folder with stored results of computing steps (stages), so that equal steps are computed only
    once. `root/<stage>/<key>/` holds the files of one stage and `manifest.json` with the SHA-256
    digest of each.

    A folder under its final name is complete: it was written as `.tmp-*` beside, synchronised, and
    renamed. Only one process computes a key at a time (flock). Where the lock does not reach from
    node to node, two may compute the same content: the first rename wins.
    """

    root: Path

    def stage_columns(self, output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:
        """Table columns of a computing step (stage), read from a stored file, or else computed and
        stored.

        A damaged file is measured again.
        """
        key = columns_key(output, before)
        folder = output.result.path
        path = folder.with_name(f"{folder.name}.{key[:16]}.json")
        stored = read_json_with_digest(read_limited_bytes(path)) if path.is_file() else None
        if stored is not None and stored["key"] == key:
            facts: Facts = stored["facts"]
            return facts
        started = time.process_time()
        columns = output.stage.measure(output.value, *(earlier.value for earlier in before))
        facts = {name: storable_value(name, value) for name, value in columns.items()}
        seconds = time.process_time() - started
        body = {"key": key, "facts": facts, "processor_seconds": seconds}
        durable.write_json_atomically(path, add_digest(body), durable=False)
        return facts

    def stage_result(
        self, name: str, key: str, note: dict[str, Any], compute: Compute
    ) -> StageResult:
        """Result of the computing step (stage) with a given key, computed if it is missing or
        damaged in the store. `compute(folder)` computes it.

        Whatever `compute` raises is raised; nothing half-written is ever seen under the final name.
        """
        if intact := self.find_stage(name, key):
            return intact
        with file_lock(self.root / ".locks" / f"{name}-{key}.lock"):
            if intact := self.find_stage(name, key):  # another process was faster
                return intact
            folder = self.stage_folder(name, key)
            if folder.exists():  # damaged, or placed since by a node beyond our lock
                if intact := self.find_stage(name, key):
                    return intact
                corrupt = self.root / ".corrupt" / f"{name}-{folder.name}-{secrets.token_hex(4)}"
                corrupt.parent.mkdir(parents=True, exist_ok=True)
                folder.rename(corrupt)
            return self._compute_stage(name, key, note, compute)

    def find_stage(self, name: str, key: str) -> StageResult | None:
        """Find the stored result of the computing step (stage) with a given key; None if it is
        missing or damaged."""
        folder = self.stage_folder(name, key)
        manifest = read_intact_manifest(folder)
        # The name holds 32 of its 64 digits only.
        if manifest is None or manifest.get("key") != key:
            return None
        seconds = manifest["seconds"]
        return StageResult(path=folder, key=key, seconds=seconds, reused=True, name=name)

    def stage_folder(self, name: str, key: str) -> Path:
        """Folder in which the result of the computing step (stage) with a given key is stored."""
        is_plain = name.replace("_", "").replace("-", "").isalnum()
        require(is_plain, "stage", name, "not a plain name", "use letters and digits")
        return self.root / name / key[:32]

    def _compute_stage(
        self, name: str, key: str, note: dict[str, Any], compute: Compute
    ) -> StageResult:
        """Compute a step (stage) of a run in a temporary folder, add checksums, and move the folder
        into the store."""
        final = self.stage_folder(name, key)
        temporary = final.with_name(f".tmp-{final.name}-{machine_name()}-{secrets.token_hex(4)}")
        # Beside its final name: a rename cannot leave the file system.
        temporary.mkdir(parents=True)
        _remove_abandoned_folders(temporary, final)
        try:
            started = time.perf_counter()
            processor_started = time.process_time()
            compute(temporary)
            seconds = time.perf_counter() - started
            processor_seconds = time.process_time() - processor_started
            times = {"seconds": seconds, "processor_seconds": processor_seconds}
            write_manifest(temporary, note | {"key": key} | times)
            _move_into_place(temporary, final)
        except (Exception, SystemExit) as error:
            failed_here = isinstance(error, OSError) and error.errno != errno.ENOENT
            if not temporary.is_dir() and not failed_here:
                # Somebody has removed it, and a library may say so in words of its own.
                raise FileNotFoundError(errno.ENOENT, "was removed", str(temporary)) from error
            shutil.rmtree(temporary, ignore_errors=True)
            raise  # Ctrl-C and kills leave the folder: the next attempt takes its checkpoint over
        return StageResult(path=final, key=key, seconds=seconds, reused=False, name=name)


def _move_into_place(temporary: Path, final: Path) -> None:
    """Rename the folder of a finished result to its final name in one step, so that the folder is
    complete or absent."""
    try:
        temporary.rename(final)
    except OSError:
        if read_intact_manifest(final) is None:
            raise
        # Someone placed the same result without our lock: theirs is as good.
        shutil.rmtree(temporary)
    flush_to_disk(final.parent)  # only now does the stage survive a power loss


def machine_name() -> str:
    """Name of this machine as it appears in file names. Locks of this machine are reliable here,
    those of others may not be."""
    return digest_of_value(socket.gethostname())[:8]


def _remove_abandoned_folders(temporary: Path, final: Path) -> None:
    """Remove the temporary folders that killed processes left. A checkpoint in them (`CHECKPOINT`)
    moves to the new folder, to continue from.

    Another node, which our lock does not reach, may still be at work: its folder stays for
    `ABANDONED_S`, and its checkpoint is copied.
    """
    for leftover in final.parent.glob(f".tmp-{final.name}-*"):
        if leftover == temporary:
            continue
        is_foreign = leftover.name.rsplit("-", 2)[1] not in (machine_name(), final.name)
        for checkpoint in leftover.rglob(CHECKPOINT):
            heir = temporary / checkpoint.relative_to(leftover)
            heir.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # its owner has finished
                shutil.copyfile(checkpoint, heir) if is_foreign else checkpoint.replace(heir)
        if not is_foreign or time.time() - leftover.stat().st_mtime > ABANDONED_S:
            # Under the lock, so nobody is at work there.
            shutil.rmtree(leftover, ignore_errors=True)


def write_manifest(
    folder: Path, note: dict[str, Any], leave_out: frozenset[str] = frozenset()
) -> None:
    """Write a manifest of a folder, with the sizes and SHA-256 digests of its files, and flush the
    folder to disk.

    `leave_out` names entries directly in `folder` that may change later; they are synchronised, not
    sealed. An incomplete manifest seals nothing, so it need not be written atomically: a folder
    counts only after the next step (the rename of a stage, the record of a run).
    """
    manifest = folder / MANIFEST
    paths = sorted(path for path in folder.rglob("*") if path != manifest)
    files = {}
    for path in paths:
        place = path.relative_to(folder)
        if path.is_file() and place.parts[0] not in leave_out:
            sums = {"sha256": sha256_of_file(path), "bytes": path.stat().st_size}
            files[place.as_posix()] = sums
    stamp = datetime.now(UTC).isoformat(timespec="seconds")
    process = {"made_utc": stamp, "host": socket.gethostname(), "pid": os.getpid()}
    manifest.write_bytes(durable.json_bytes(add_digest(note | process | {"files": files})))
    entries = [path for path in paths if path.is_dir() or path.is_file()]
    # The file system commits them together; more than 8 gain nothing.
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(flush_to_disk, [*entries, manifest, folder]))


def read_intact_manifest(folder: Path) -> dict[str, Any] | None:
    """Read the manifest of a folder; None if the manifest or a file that it lists was changed."""
    try:
        manifest = read_json_with_digest(read_limited_bytes(folder / MANIFEST))
    except OSError:
        return None
    if manifest is None or damaged_files(folder, manifest):
        return None
    return manifest


def damaged_files(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Names of files that a manifest lists and that are missing or differ in size or content."""

    def is_unchanged(path: Path, facts: dict[str, Any]) -> bool:
        """Whether a file still has the size and checksum that the manifest of its folder states."""
        with suppress(OSError):
            if path.stat().st_size != facts["bytes"]:  # the cheap one first
                return False
            return sha256_of_file(path) == facts["sha256"]
        return False

    files = manifest["files"]
    return [name for name, facts in files.items() if not is_unchanged(folder / name, facts)]
