"""A stage is a pure function of its key: computed once, kept under that key, checked to the last bit on reading."""

import os
import secrets
import shutil
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ssm_study.refusal import require
from ssm_study.results.durable import (
    json_bytes,
    locked,
    sealed,
    sha256_of_file,
    sync_folder,
    sync_together,
    unsealed,
)
from ssm_study.results.keys import stage_key

MANIFEST = "manifest.json"
CHECKPOINT = "last.ckpt"  # what a computation may save to go on from; checked by itself, of the same key by its place

Compute = Callable[[Path], float | None]


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """The folder of a finished stage. `seconds` is what computing it took; `reused` if not in this call."""

    path: Path
    key: str
    seconds: float
    reused: bool
    name: str


class Stages(ABC):
    """What the line calls: `Store` computes and keeps, `PlannedStages` (plan.py) only notes what would be computed."""

    def stage(
        self, name: str, config: Any, upstream: Sequence[str], code_version: str, compute: Compute
    ) -> StageResult:
        """The stage of these inputs. Its files may be read inside a later `compute` only: a plan has no files."""
        key = stage_key(name, config, tuple(upstream), code_version)
        note = {"stage": name, "key": key, "upstream": list(upstream), "code_version": code_version}
        return self.keyed(name, key, note, compute)

    @abstractmethod
    def keyed(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:
        """The stage of this key; `note` says what the key was made of."""


@dataclass(frozen=True)
class Store(Stages):
    """`root/<stage>/<key>/` holds the files of one stage and `manifest.json` with the SHA-256 of each.

    A folder under its final name is complete: it was written as `.tmp-*` beside, synchronised, and renamed. Only one
    process computes a key at a time (flock). Should the lock fail (a network file system without one), two processes
    compute the same content and the first rename wins.
    """

    root: Path
    held: set[str] = field(default_factory=set, compare=False)

    def keyed(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:
        """The stage's folder, computed by `compute(folder)` if it is not there or no longer intact.

        Whatever `compute` raises is raised; nothing half-written is ever seen under the final name. It may return the
        seconds the stage took, where part of the work was done before.
        """
        if found := self.find(name, key):
            return found
        with nullcontext() if key in self.held else locked(self._lock(name, key)):
            if found := self.find(name, key):  # another process was faster
                return found
            self._set_damaged_aside(name, key)
            return self._compute(name, key, note, compute)

    @contextmanager
    def hold(self, name: str, keys: Iterable[str]) -> Iterator[None]:
        """Meanwhile these stages are computed through this very store alone; whoever else asks for one waits.

        It waits itself until nobody computes one of them; a holder that dies lets go. The order keeps two from waiting
        for each other.
        """
        with ExitStack() as locks:
            for key in sorted(keys):
                locks.enter_context(locked(self._lock(name, key)))
                self.held.add(key)
                locks.callback(self.held.discard, key)
            yield

    def _lock(self, name: str, key: str) -> Path:
        return self.root / ".locks" / f"{name}-{key}.lock"

    def find(self, name: str, key: str) -> StageResult | None:
        """The intact stage of this key, or None; a damaged one counts as absent."""
        folder = self.folder(name, key)
        manifest = intact_manifest(folder)
        if manifest is None or manifest.get("key") != key:
            return None
        return StageResult(path=folder, key=key, seconds=manifest["seconds"], reused=True, name=name)

    def folder(self, name: str, key: str) -> Path:
        require(
            name.replace("_", "").replace("-", "").isalnum(),
            "stage",
            name,
            "not a plain name",
            "use letters and digits",
        )
        return self.root / name / key[:32]

    def _compute(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:
        final = self.folder(name, key)
        temporary = final.with_name(f".tmp-{final.name}-{secrets.token_hex(4)}")
        temporary.mkdir(parents=True)
        _take_over(temporary, final)
        try:
            started, worked = time.perf_counter(), time.process_time()
            spent = compute(temporary)
            seconds = time.perf_counter() - started if spent is None else spent
            seal_folder(temporary, note | {"seconds": seconds, "processor_seconds": time.process_time() - worked})
            self._place(temporary, final)
        except (Exception, SystemExit):
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        return StageResult(path=final, key=key, seconds=seconds, reused=False, name=name)

    def _place(self, temporary: Path, final: Path) -> None:
        try:
            temporary.rename(final)
        except OSError:
            if intact_manifest(final) is None:
                raise
            shutil.rmtree(temporary)  # someone placed the same result without our lock: theirs is as good
        sync_folder(final.parent)

    def _set_damaged_aside(self, name: str, key: str) -> None:
        folder = self.folder(name, key)
        if folder.exists():
            aside = self.root / ".corrupt" / f"{name}-{folder.name}-{secrets.token_hex(4)}"
            aside.parent.mkdir(parents=True, exist_ok=True)
            folder.rename(aside)


def _take_over(temporary: Path, final: Path) -> None:
    """Clear up after the killed; what they had saved to go on from (`CHECKPOINT`) moves to their successor."""
    for leftover in final.parent.glob(f".tmp-{final.name}-*"):
        if leftover == temporary:
            continue
        for saved in leftover.rglob(CHECKPOINT):
            heir = temporary / saved.relative_to(leftover)
            heir.parent.mkdir(parents=True, exist_ok=True)
            saved.replace(heir)
        shutil.rmtree(leftover, ignore_errors=True)


def seal_folder(folder: Path, note: dict[str, Any], leave_out: frozenset[str] = frozenset()) -> None:
    """Write `manifest.json` (the note, sizes and SHA-256 sums, and its own), then make the whole folder durable.

    `leave_out` names entries directly in `folder` that may change later; they are synchronised, not sealed. A manifest
    that was cut short seals nothing, so it needs no replacing; what makes the folder count comes after it (the rename
    of a stage, the record of a run).
    """
    paths = sorted(path for path in folder.rglob("*") if path.relative_to(folder) != Path(MANIFEST))
    files = {
        path.relative_to(folder).as_posix(): {"sha256": sha256_of_file(path), "bytes": path.stat().st_size}
        for path in paths
        if path.is_file() and path.relative_to(folder).parts[0] not in leave_out
    }
    made = {
        "made_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
        "pid": os.getpid(),
    }
    (folder / MANIFEST).write_bytes(json_bytes(sealed(note | made | {"files": files})))
    sync_together([*(path for path in paths if path.is_dir() or path.is_file()), folder / MANIFEST, folder])


def intact_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of `folder` if it and every file it lists are as they were written, else None."""
    try:
        manifest = unsealed((folder / MANIFEST).read_bytes())
    except OSError:
        return None
    return manifest if manifest is not None and not damaged_files(folder, manifest) else None


def damaged_files(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Names listed in the manifest whose file is missing, shorter, longer or different."""
    return [name for name, facts in manifest["files"].items() if not _is_same(folder / name, facts)]


def _is_same(path: Path, facts: dict[str, Any]) -> bool:
    try:
        return path.stat().st_size == facts["bytes"] and sha256_of_file(path) == facts["sha256"]
    except OSError:
        return False
