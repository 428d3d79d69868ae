"""Files that are replaced atomically, protected by a digest, and locked. A reader finds either the
old or the new version, complete. Writes survive kills and full disks; locks end with the
process."""

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
    """Write a file atomically, so that readers see either the old or the new content. A temporary
    file beside it (never in TMPDIR) is flushed and renamed, then the folder is flushed.

    Raises `OSError` with the old version untouched and no temporary left behind. Without `durable`
    the file survives every kill but no power loss: for files that are synchronised later, or that
    count as absent when damaged.
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
        flush_to_disk(path.parent)


def write_json_atomically(path: Path, value: Any, durable: bool = True) -> None:
    """Write a value atomically as strict JSON (no NaN), one key per line."""
    write_atomically(path, json_bytes(value), durable)


def link_or_copy_file(source: Path, target: Path) -> None:
    """Create a second file with the same content, by a clone or a hard link if possible, else by a
    copy.

    Both are only ever replaced as a whole; writing into one in place breaks the checksums of both,
    which is noticed.
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
    """Serialise a value as strict, indented JSON text in UTF-8, the form in which files with a
    digest are written."""
    strict: dict[str, Any] = {"allow_nan": False, "ensure_ascii": False}
    if isinstance(value, dict) and value and CONTAINERS.isdisjoint(map(type, value.values())):
        # The same text five times as fast: with an indent Python's encoder works, without one that
        # in C.
        flat = json.dumps(value, separators=(",\n ", ": "), **strict)
        text = f"{{\n {flat[1:-1]}\n}}"
    else:
        text = json.dumps(value, indent=1, **strict)
    return f"{text}\n".encode("utf-8", "surrogatepass")


def flush_to_disk(path: Path) -> None:
    """Force the content of a file or folder to disk with `fsync`. For a folder, renames in it
    become durable if its file system supports that."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:  # some network file systems know no fsync of a folder
        if not path.is_dir() or error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def open_regular_file(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; raises `OSError` for a pipe or a device, which may never
    end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is no plain file", str(path))
    return os.fdopen(descriptor, "rb")


def read_limited_bytes(path: Path, max_bytes: int = LARGEST) -> bytes:
    """Read a whole file as bytes; raises `OSError` for a pipe, a device, or a file larger than
    `max_bytes` bytes."""
    with open_regular_file(path) as stream:
        if os.fstat(stream.fileno()).st_size > max_bytes:
            raise OSError(errno.EFBIG, f"is larger than {max_bytes >> 20} MiB", str(path))
        return stream.read()


def read_json(path: Path) -> Any:
    """Read the content of a JSON file, which must be a regular file of limited size."""
    return json.loads(read_limited_bytes(path))


def sha256_of_file(path: Path) -> str:
    """SHA-256 digest of a file in hexadecimal digits, read block by block."""
    with open_regular_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def add_digest(body: dict[str, Any]) -> dict[str, Any]:
    """Copy of a JSON object with its own SHA-256 digest added under the key `sha256`.
    `read_json_with_digest` then notices a flipped bit in the text."""
    return {**body, "sha256": _sha256_of_body(body)}


def read_json_with_digest(content: bytes) -> dict[str, Any] | None:
    """Read a JSON object that carries its own SHA-256 digest; None if a byte was changed since it
    was written."""
    try:
        value = json.loads(content)
        body = {key: item for key, item in value.items() if key != "sha256"}
        is_intact = content == json_bytes(value) and _sha256_of_body(body) == value["sha256"]
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        return None
    return body if is_intact else None


def _sha256_of_body(body: dict[str, Any]) -> str:
    """SHA-256 digest of the JSON text of an object, in hexadecimal digits."""
    text = json.dumps(
        body, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
    )
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


@contextmanager
def file_lock(path: Path, patience_s: float = math.inf) -> Iterator[bool]:
    """Context manager that tries to lock a file exclusively, and yields whether the lock was
    obtained in time.

    The system releases it when the process dies. It is a flock; on a file system that knows none
    it is a name of this machine, which excludes the processes of this machine.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Every opening is a lock of its own, also within one process; a program that is executed does
    # not inherit it.
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        with ExitStack() as exit_stack:
            yield _acquire_lock(descriptor, patience_s, exit_stack)
    finally:
        # Releases the flock; the file stays: who removes it may remove a lock that another holds.
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether a living process holds the exclusive lock on a file."""
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
        _raise_unless_locks_unsupported(error)
        with ExitStack() as exit_stack:
            return not _acquire_socket_lock(descriptor, exit_stack)
    finally:
        os.close(descriptor)


def _acquire_lock(descriptor: int, patience_s: float, exit_stack: ExitStack) -> bool:
    """Lock an open file within a time limit, and return whether that succeeded. A socket name that
    stands for the lock is released when `exit_stack` closes."""
    try:
        if math.isinf(patience_s):
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # waits in the kernel, without polling
            return True
        return _retry_until_deadline(lambda: _try_file_lock(descriptor), patience_s)
    except OSError as error:
        _raise_unless_locks_unsupported(error)
    return _retry_until_deadline(lambda: _acquire_socket_lock(descriptor, exit_stack), patience_s)


def _retry_until_deadline(attempt: Callable[[], bool], patience_s: float) -> bool:
    """Call a function repeatedly until success or a time limit; return whether the call
    succeeded."""
    deadline = time.monotonic() + patience_s
    while not attempt():
        if time.monotonic() >= deadline:
            return False
        time.sleep(POLL_S)
    return True


def _try_file_lock(descriptor: int) -> bool:
    """Try once, without waiting, to lock an open file; return whether that succeeded."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _raise_unless_locks_unsupported(error: OSError) -> None:
    """Raise an error of the operating system again unless it says that the file system does not
    support locks."""
    if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
        raise error


def _acquire_socket_lock(descriptor: int, exit_stack: ExitStack) -> bool:
    """Lock a file through an abstract socket name, for file systems that do not support locks, and
    return whether that succeeded.

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
    exit_stack.callback(name.close)
    return True


def refuse_symbolic_link(folder: Path) -> None:
    """Raise `BadRequest` for a folder that is a symbolic link, since files written into it would
    land elsewhere."""
    problem = "is a link, and the program does not write through links"
    require(not folder.is_symlink(), "folder", folder, problem, "remove the link")
