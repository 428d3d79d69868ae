"""A stage is a pure function of its key: computed once, kept under that key, checked to the last
bit on reading."""

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
from ssm_study.durable import contents, locked, sealed, sha256_of_file, sync, unsealed
from ssm_study.engine.records import storable
from ssm_study.engine.settings import digest
from ssm_study.engine.stages import Compute, Facts, StageOutput, StageResult, Stages, measure_key
from ssm_study.refusal import require

MANIFEST = "manifest.json"
ABANDONED_S = 7 * 24 * 3600.0  # without a change: what another node left is then nobody's
# What a computation may save to go on from; checked by itself, of the same key by its place.
CHECKPOINT = "last.ckpt"


@dataclass(frozen=True)
class Store(Stages):
    """`root/<stage>/<key>/` holds the files of one stage and `manifest.json` with the SHA-256 of
    each.

    A folder under its final name is complete: it was written as `.tmp-*` beside, synchronised, and
    renamed. Only one process computes a key at a time (flock). Where the lock does not reach from
    node to node, two may compute the same content: the first rename wins.
    """

    root: Path

    def measured(self, kept: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:
        """From their sealed file beside its folder, or measured into it."""
        key = measure_key(kept, before)
        path = kept.result.path.with_name(f"{kept.result.path.name}.{key[:16]}.json")
        found = unsealed(contents(path)) if path.is_file() else None
        if found is None or found["key"] != key:
            worked = time.process_time()
            measured = kept.stage.measure(kept.value, *(one.value for one in before))
            found = {
                "key": key,
                "facts": {name: storable(name, value) for name, value in measured.items()},
            }
            found["processor_seconds"] = time.process_time() - worked
            # A damaged one is measured again.
            durable.write_json_atomically(path, sealed(found), durable=False)
        facts: Facts = found["facts"]
        return facts

    def keyed(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:
        """The stage's folder, computed by `compute(folder)` if it is not there or no longer intact.

        Whatever `compute` raises is raised; nothing half-written is ever seen under the final name.
        """
        if found := self.find(name, key):
            return found
        with locked(self.root / ".locks" / f"{name}-{key}.lock"):
            if found := self.find(name, key):  # another process was faster
                return found
            folder = self.folder(name, key)
            if folder.exists():  # damaged, or placed since by a node beyond our lock
                if found := self.find(name, key):
                    return found
                aside = self.root / ".corrupt" / f"{name}-{folder.name}-{secrets.token_hex(4)}"
                aside.parent.mkdir(parents=True, exist_ok=True)
                folder.rename(aside)
            return self._compute(name, key, note, compute)

    def find(self, name: str, key: str) -> StageResult | None:
        """The intact stage of this key, or None; a damaged one counts as absent."""
        folder = self.folder(name, key)
        manifest = intact_manifest(folder)
        # The name holds 32 of its 64 digits only.
        if manifest is None or manifest.get("key") != key:
            return None
        return StageResult(
            path=folder, key=key, seconds=manifest["seconds"], reused=True, name=name
        )

    def folder(self, name: str, key: str) -> Path:
        is_plain = name.replace("_", "").replace("-", "").isalnum()
        require(is_plain, "stage", name, "not a plain name", "use letters and digits")
        return self.root / name / key[:32]

    def _compute(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:
        final = self.folder(name, key)
        temporary = final.with_name(f".tmp-{final.name}-{node()}-{secrets.token_hex(4)}")
        # Beside its final name: a rename cannot leave the file system.
        temporary.mkdir(parents=True)
        _take_over(temporary, final)
        try:
            started = time.perf_counter()
            worked = time.process_time()
            compute(temporary)
            seconds = time.perf_counter() - started
            times = {"seconds": seconds, "processor_seconds": time.process_time() - worked}
            seal_folder(temporary, note | {"key": key} | times)
            try:
                # Atomic: under its final name a stage is whole or not there.
                temporary.rename(final)
            except OSError:
                if intact_manifest(final) is None:
                    raise
                # Someone placed the same result without our lock: theirs is as good.
                shutil.rmtree(temporary)
            sync(final.parent)  # only now does the stage survive a power loss
        except (Exception, SystemExit):
            shutil.rmtree(temporary, ignore_errors=True)
            raise  # Ctrl-C and kills leave the folder: the next attempt takes its checkpoint over
        return StageResult(path=final, key=key, seconds=seconds, reused=False, name=name)


def node() -> str:
    """This machine, in file names: its locks hold here, and may not reach others."""
    return digest(socket.gethostname())[:8]


def _take_over(temporary: Path, final: Path) -> None:
    """Clear up after the killed; what they had saved to go on from (`CHECKPOINT`) moves to their
    successor.

    Another node may be at work beyond our lock: its folder stays for `ABANDONED_S`, and what it
    saved is copied.
    """
    for leftover in final.parent.glob(f".tmp-{final.name}-*"):
        if leftover == temporary:
            continue
        foreign = leftover.name.rsplit("-", 2)[1] not in (node(), final.name)
        for saved in leftover.rglob(CHECKPOINT):
            heir = temporary / saved.relative_to(leftover)
            heir.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # its owner has finished
                shutil.copyfile(saved, heir) if foreign else saved.replace(heir)
        if not foreign or time.time() - leftover.stat().st_mtime > ABANDONED_S:
            # Under the lock, so nobody is at work there.
            shutil.rmtree(leftover, ignore_errors=True)


def seal_folder(
    folder: Path, note: dict[str, Any], leave_out: frozenset[str] = frozenset()
) -> None:
    """Write `manifest.json` (the note, sizes and SHA-256 sums, and its own), then make the whole
    folder durable.

    `leave_out` names entries directly in `folder` that may change later; they are synchronised, not
    sealed. A manifest that was cut short seals nothing, so it needs no replacing; what makes the
    folder count comes after it (the rename of a stage, the record of a run).
    """
    paths = sorted(path for path in folder.rglob("*") if path.relative_to(folder) != Path(MANIFEST))
    files = {
        path.relative_to(folder).as_posix(): {
            "sha256": sha256_of_file(path),
            "bytes": path.stat().st_size,
        }
        for path in paths
        if path.is_file() and path.relative_to(folder).parts[0] not in leave_out
    }
    stamp = datetime.now(UTC).isoformat(timespec="seconds")
    made = {"made_utc": stamp, "host": socket.gethostname(), "pid": os.getpid()}
    (folder / MANIFEST).write_bytes(durable.json_bytes(sealed(note | made | {"files": files})))
    there = [path for path in paths if path.is_dir() or path.is_file()]
    # The file system commits them together; more than 8 gain nothing.
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(sync, [*there, folder / MANIFEST, folder]))


def intact_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of `folder` if it and every file it lists are as they were written, else
    None."""
    try:
        manifest = unsealed(contents(folder / MANIFEST))
    except OSError:
        return None
    return manifest if manifest is not None and not damaged_files(folder, manifest) else None


def damaged_files(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Names listed in the manifest whose file is missing, shorter, longer or different."""

    def is_same(path: Path, facts: dict[str, Any]) -> bool:
        with suppress(OSError):
            return (
                path.stat().st_size == facts["bytes"] and sha256_of_file(path) == facts["sha256"]
            )  # cheap one first
        return False

    return [name for name, facts in manifest["files"].items() if not is_same(folder / name, facts)]
