"""Files that are replaced atomically, sealed with a digest, and locked. Old version whole or new
version whole: writes that survive kills and full disks, locks that die with us."""

import errno
import hashlib
import io
import json
import math
import os
import secrets
import shutil
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ssm_study.refusal import require

try:
    import fcntl
except ModuleNotFoundError as absent:
    raise ImportError("ssm-study runs on Linux and macOS, on Windows in WSL") from absent

PATIENCE_S = 1.0  # for a lock that readers hold for an instant, in `is_locked`
POLL_S = 0.02  # between two attempts to obtain a lock
LARGEST = 2**27  # bytes of a file that is read at once
CONTAINERS = frozenset({dict, list, tuple})
FICLONE = 0x40049409  # Linux: two files share their blocks until one of them is written to


def write_atomically(path: Path, content: bytes, durable: bool = True) -> None:
    """Write a file so that a reader sees the old or the new content, never a part. Replace `path`
    by `content`: temporary file beside it (never TMPDIR), fsync, rename, fsync of the folder.

    Raises `OSError` with the old version untouched and no temporary left behind. Not `durable`:
    survives every kill but not a power loss; for what is synchronised later, or counts as absent
    when it is damaged.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(content)
            stream.flush()
            if durable:
                # Before the rename: a new name never leads to missing content.
                os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        # The rename itself: without it the old name may come back after a power loss.
        sync(path.parent)


def write_json_atomically(path: Path, value: Any, durable: bool = True) -> None:
    """Write a value as strict JSON (no NaN), one key per line, in the manner of
    `write_atomically`."""
    write_atomically(path, json_bytes(value), durable)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file's content a second name, by a hard link or a copy. `target` has the content of
    `source`, sharing its bytes where the file system can: cloned, else linked.

    Both are only ever replaced as a whole; whoever writes into one in place breaks the sums of
    both, and that is seen.
    """
    target.unlink(missing_ok=True)
    try:
        with source.open("rb") as original, target.open("xb") as clone:
            fcntl.ioctl(clone.fileno(), FICLONE, original.fileno())
    except OSError:
        target.unlink(missing_ok=True)
        try:
            os.link(source, target)
        except OSError:  # another file system, or one without links
            shutil.copyfile(source, target)


def json_bytes(value: Any) -> bytes:
    """Serialise a value as the canonical JSON text of a sealed object. `unsealed` knows no
    other."""
    strict: dict[str, Any] = {"allow_nan": False, "ensure_ascii": False}
    if isinstance(value, dict) and value and CONTAINERS.isdisjoint(map(type, value.values())):
        # The same text five times as fast: with an indent Python's encoder works, without one that
        # in C.
        flat = json.dumps(value, separators=(",\n ", ": "), **strict)
        text = f"{{\n {flat[1:-1]}\n}}"
    else:
        text = json.dumps(value, indent=1, **strict)
    return f"{text}\n".encode("utf-8", "surrogatepass")


def sync(path: Path) -> None:
    """Flush a file to the disk. `fsync` of a file; of a folder, renames in it become durable
    where its file system can do that."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:  # some network file systems know no fsync of a folder
        if not path.is_dir() or error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def open_regular_file(path: Path) -> io.BufferedReader:
    """Open a regular file for reading. For reading; raises `OSError` for a pipe or a device,
    which may never end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is no plain file", str(path))
    return os.fdopen(descriptor, "rb")


def contents(path: Path, most: int = LARGEST) -> bytes:
    """Read a whole file as bytes. The whole file; raises `OSError` as
    `open_regular_file`, and for one of more than `most` bytes before any are read."""
    with open_regular_file(path) as stream:
        if os.fstat(stream.fileno()).st_size > most:
            raise OSError(errno.EFBIG, f"is larger than {most >> 20} MiB", str(path))
        return stream.read()


def sha256_of_file(path: Path) -> str:
    """Hexadecimal digest, read block by block."""
    with open_regular_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sealed(body: dict[str, Any]) -> dict[str, Any]:
    """Add to a JSON object its own `sha256`. `unsealed` then notices a flipped bit in the text
    itself."""
    return {**body, "sha256": _body_digest(body)}


def unsealed(content: bytes) -> dict[str, Any] | None:
    """Read a sealed JSON object and check its digest. The sealed object that
    `write_json_atomically` wrote as `content`; None if a single byte differs from that."""
    try:
        value = json.loads(content)
        body = {key: item for key, item in value.items() if key != "sha256"}
        is_intact = content == json_bytes(value) and _body_digest(body) == value["sha256"]
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        return None
    return body if is_intact else None


def _body_digest(body: dict[str, Any]) -> str:
    text = json.dumps(
        body, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
    )
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


@contextmanager
def locked(path: Path, patience_s: float = math.inf) -> Iterator[bool]:
    """Hold the exclusive lock on `path`, waiting for it. Yields whether it was obtained.

    The system releases it when the process dies. It is a flock; on a file system that knows none
    it is a name of this machine, which excludes the processes of this machine.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Every opening is a lock of its own, also within one process; a program that is executed does
    # not inherit it.
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        with ExitStack() as held_name:
            yield _obtain(descriptor, patience_s, held_name)
    finally:
        # Releases the flock; the file stays: who removes it may remove a lock that another holds.
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock on `path`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return False
    try:
        # Shared: readers do not exclude each other.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError as error:
        if isinstance(error, BlockingIOError):
            return True
        _refuse_other_than_missing_locks(error)
        with ExitStack() as held_name:
            return not _take_name(descriptor, held_name)
    finally:
        os.close(descriptor)


def _obtain(descriptor: int, patience_s: float, held_name: ExitStack) -> bool:
    """Lock an open file within a time limit. Try for `patience_s` to lock the open file; a name
    is held until `held_name` is closed."""
    try:
        if math.isinf(patience_s):
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # waits in the kernel, without polling
            return True
        return _poll(lambda: _try_flock(descriptor), patience_s)
    except OSError as error:
        _refuse_other_than_missing_locks(error)
    return _poll(lambda: _take_name(descriptor, held_name), patience_s)


def _poll(attempt: Callable[[], bool], patience_s: float) -> bool:
    deadline = time.monotonic() + patience_s
    while not attempt():
        if time.monotonic() >= deadline:
            return False
        time.sleep(POLL_S)
    return True


def _try_flock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _refuse_other_than_missing_locks(error: OSError) -> None:
    """Raise the error again unless it says that the file system does not support locks."""
    if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
        raise error


def _take_name(descriptor: int, held_name: ExitStack) -> bool:
    """Acquire a lock by name if no living process has it, where the file system does not support
    locks.

    The name is an address of Linux' abstract sockets: it lies in no file system and goes when its
    process dies. On another system nobody can have it.
    """
    if not sys.platform.startswith("linux"):
        return True
    file = os.fstat(descriptor)
    name = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        name.bind(f"\0ssm-study-{file.st_dev:x}-{file.st_ino:x}")
    except OSError as error:
        name.close()
        if error.errno == errno.EADDRINUSE:
            return False
        raise
    held_name.callback(name.close)
    return True


def refuse_link(folder: Path) -> None:
    """Refuse a folder that is a symbolic link. Raise `BadRequest` for a folder that is a link:
    what is written into it lands elsewhere."""
    problem = "is a link to another place, where nothing is written"
    require(not folder.is_symlink(), "folder", folder, problem, "remove the link")
