"""Checkpoints that a full disk or a kill cannot destroy: the old version whole, or the new version whole."""

import hashlib
import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import CheckpointIO

SEAL_BYTES = hashlib.sha256().digest_size


class DurableCheckpointIO(CheckpointIO):
    """Write beside the target, fsync, `os.replace`, fsync the folder; read tensors and plain containers only.

    The SHA-256 of the content follows it: torch does not notice a flipped bit (and reads past the sum without a word).
    Lightning's own writer goes through TMPDIR; with that on another file system a full disk destroyed the old file.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:  # noqa: ARG002
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        beside, memory = target.with_name(f".{target.name}.tmp"), io.BytesIO()
        torch.save(checkpoint, memory)  # into a file it would hide a full disk behind an error of its own
        content = memory.getvalue()
        try:
            with beside.open("wb") as file:
                file.write(content + hashlib.sha256(content).digest())
                file.flush()
                os.fsync(file.fileno())
            beside.replace(target)
        except BaseException:
            with suppress(OSError):
                beside.unlink()
            raise
        _sync_folder(target.parent)

    def load_checkpoint(
        self, path: str | Path, map_location: Any | None = None, weights_only: bool | None = True
    ) -> dict[str, Any]:  # fmt: skip
        del weights_only  # never anything else: a checkpoint must not be able to run code
        whole = Path(path).read_bytes()
        content, seal = whole[:-SEAL_BYTES], whole[-SEAL_BYTES:]
        if hashlib.sha256(content).digest() != seal:
            raise ValueError("not what was written")
        return torch.load(io.BytesIO(content), map_location=map_location or "cpu", weights_only=True)

    def remove_checkpoint(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
