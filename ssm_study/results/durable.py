"""Old version whole or new version whole: writes that survive kills and full disks, locks that die with us."""

import errno
import fcntl
import hashlib
import json
import os
import secrets
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

BLOCK_BYTES = 1 << 20
SYNCED_AT_ONCE = 8


def write_atomically(path: Path, content: bytes, durable: bool = True) -> None:
    """Replace `path` by `content`: temporary file beside it (never TMPDIR), fsync, rename, fsync of the folder.

    Raises `OSError` with the old version untouched and no temporary left behind. Not `durable`: survives every kill but
    not a power loss; for what is synchronised later, or counts as absent when it is damaged.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(content)
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_folder(path.parent)


def write_json_atomically(path: Path, value: Any, durable: bool = True) -> None:
    """As `write_atomically`; the text is strict JSON (no NaN), one key per line."""
    write_atomically(path, json_bytes(value), durable)


def json_bytes(value: Any) -> bytes:
    """The one text of a sealed object: `unsealed` knows no other."""
    return (json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode("utf-8", "surrogatepass")


def sync_folder(folder: Path) -> None:
    """Make renames inside `folder` durable, where the file system can do that (some network ones cannot)."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def sync_together(paths: Iterable[Path]) -> None:
    """Make many files and folders durable at once: their file system then commits them together, not one by one."""
    with ThreadPoolExecutor(SYNCED_AT_ONCE) as pool:
        for _ in pool.map(lambda path: sync_folder(path) if path.is_dir() else sync_file(path), paths):
            pass


def sync_file(path: Path) -> None:
    """`fsync` of a file or folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of_file(path: Path) -> str:
    """Hexadecimal digest, read block by block."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def sealed(body: dict[str, Any]) -> dict[str, Any]:
    """`body` with its own `sha256`, so that a flipped bit in the JSON text itself is noticed by `unsealed`."""
    return {**body, "sha256": _body_digest(body)}


def unsealed(content: bytes) -> dict[str, Any] | None:
    """The sealed object that `write_json_atomically` wrote as `content`; None if a single byte differs from that."""
    try:
        value = json.loads(content)
        body = {key: item for key, item in value.items() if key != "sha256"}
        same = content == json_bytes(value) and _body_digest(body) == value["sha256"]
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        return None
    return body if same else None


def _body_digest(body: dict[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the exclusive flock on `path`, waiting for it; the system lets go of it when the process dies."""
    descriptor = _open_lock(path)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def locked_or_none(path: Path, patience_s: float = 1.0) -> Iterator[bool]:
    """Try for the exclusive flock on `path`; yields whether it was obtained.

    The patience covers readers, who hold it for an instant in `is_locked`.
    """
    descriptor = _open_lock(path)
    try:
        yield _try_lock(descriptor, patience_s)
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether a living process holds the flock on `path`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _open_lock(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)


def _try_lock(descriptor: int, patience_s: float) -> bool:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.02)
