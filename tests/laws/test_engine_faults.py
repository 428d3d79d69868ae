"""The disk fails at the n-th operation, or is full: old or new version whole, and a second try
succeeds."""

import builtins
import errno
import io
import os
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ssm_study.durable import read_json_with_digest, write_json_atomically
from ssm_study.engine.records import RECORD, read_record
from ssm_study.engine.runs import Run, execute_run
from ssm_study.engine.settings import digest_of_value
from ssm_study.engine.store import Store, read_intact_manifest
from ssm_study.table.gather import PARQUET, gather


class FailingDisk:
    """Counts every operation that can meet a full or broken disk and lets the n-th fail."""

    def __init__(self, nth: int, code: int) -> None:
        self.left = nth
        self.code = code
        self.failed = ""

    def count(self, operation: str) -> None:
        self.left -= 1
        if self.left == 0:
            self.failed = operation
            raise OSError(self.code, os.strerror(self.code))

    @contextmanager
    def inserted(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        with monkeypatch.context() as patch:
            for name in ("fsync", "replace", "rename", "mkdir"):
                patch.setattr(os, name, self._counted(name, getattr(os, name)))
            patch.setattr(io, "open", self._opening(io.open))
            patch.setattr(builtins, "open", self._opening(builtins.open))
            yield

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*arguments: Any, **options: Any) -> Any:
            self.count(name)
            return real(*arguments, **options)

        return operation

    def _opening(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
            if not set(mode) & set("wxa+"):
                return real(file, mode, *arguments, **options)
            self.count("open")
            stream = real(file, mode, *arguments, **options)
            return TornStream(stream, self)

        return operation


class TornStream:
    """A stream whose failing write leaves half of what it was given."""

    def __init__(self, stream: Any, disk: FailingDisk) -> None:
        self._stream = stream
        self._disk = disk

    def write(self, content: Any) -> int:
        try:
            self._disk.count("write")
        except OSError:
            self._stream.write(content[: len(content) // 2])
            raise
        return int(self._stream.write(content))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __enter__(self) -> "TornStream":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()


def fail_at_every_operation(
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    prepare: Callable[[int], None],
    act: Callable[[int], None],
    judge: Callable[[int], None],
) -> set[str]:
    """Let operation n = 1, 2, 3, ... of `act` fail until it meets no fault; `judge` after each."""
    failed: set[str] = set()
    for nth in range(1, 400):
        prepare(nth)
        disk = FailingDisk(nth, code)
        try:
            with disk.inserted(monkeypatch):
                act(nth)
        except OSError as error:
            if error.errno != code:
                raise
        judge(nth)
        if not disk.failed:
            return failed
        failed.add(disk.failed)
    raise AssertionError("the operations never came to an end")


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_an_atomic_write_is_old_or_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    path = tmp_path / "record.json"
    old = {"status": "running"}
    new = {"status": "ok"}

    def judge(_: int) -> None:
        content = path.read_bytes()
        assert content in (b'{\n "status": "running"\n}\n', b'{\n "status": "ok"\n}\n')
        entries = tmp_path.iterdir()
        names = [entry.name for entry in entries]
        assert names == ["record.json"]

    def prepare(_: int) -> None:
        write_json_atomically(path, old)

    failed = fail_at_every_operation(
        monkeypatch, code, prepare, lambda _: write_json_atomically(path, new), judge
    )
    expected = {"open", "write", "fsync", "replace"}
    assert failed == expected


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_stage_is_whole_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def compute(folder: Path) -> None:
        (folder / "inner").mkdir()
        a_path = folder / "inner" / "a.json"
        a_path.write_text("12345")
        (folder / "b.bin").write_bytes(bytes(1000))

    def act(nth: int) -> None:
        store = Store(tmp_path / f"{nth}")
        store.stage_result("model", digest_of_value(1), {}, compute)

    def judge(nth: int) -> None:
        store = Store(tmp_path / f"{nth}")
        model_path = tmp_path / f"{nth}" / "model"
        for folder in (model_path).glob("[!.]*"):
            assert read_intact_manifest(folder) is not None
        stage = store.stage_result("model", digest_of_value(1), {}, compute)
        a_path = stage.path / "inner" / "a.json"
        text = a_path.read_text()
        assert text == "12345"
        paths = stage.path.parent.iterdir()
        names = [path.name for path in paths]
        assert names == [stage.path.name]

    failed = fail_at_every_operation(monkeypatch, code, lambda _: None, act, judge)
    lower_limit = {"open", "write", "fsync", "mkdir", "rename"}
    assert failed >= lower_limit


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_run_is_never_half_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def work(run: Run) -> dict[str, float]:
        model_path = run.path / "model.json"
        model_path.write_text('{"a": 1}')
        return {"fit_test_percent": 90.0}

    def act(nth: int) -> None:
        execute_run(tmp_path / "study" / f"{nth}", {"seed": nth}, work)

    def judge(nth: int) -> None:
        folder = tmp_path / "study" / f"{nth}"
        record = read_record(folder)
        assert record is None or record["status"] in ("ok", "failed", "lost")
        if record is not None and record["status"] == "ok":
            assert read_intact_manifest(folder) is not None
        status = execute_run(folder, {"seed": nth}, work).status
        assert status == "ok"  # the same command finishes it
        assert read_intact_manifest(folder) is not None
        paths = folder.glob("*.tmp")
        assert not list(paths)

    fail_at_every_operation(monkeypatch, code, lambda _: None, act, judge)
    status = gather(tmp_path / "study")["status"]
    assert set(status) == {"ok"}


def test_a_failed_gathering_keeps_the_old_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pandas as pd

    a_path = tmp_path / "study" / "a"
    execute_run(a_path, {}, lambda _: {})
    gather(tmp_path / "study")
    b_path = tmp_path / "study" / "b"
    execute_run(b_path, {}, lambda _: {})

    def judge(_: int) -> None:
        table = pd.read_parquet(tmp_path / "study" / PARQUET)
        run = table["run"]
        assert run.to_list() in (["a"], ["a", "b"])

    def act(_: int) -> None:
        gather(tmp_path / "study")

    fail_at_every_operation(monkeypatch, errno.ENOSPC, lambda _: None, act, judge)


@contextmanager
def no_file_longer_than(size: int) -> Iterator[None]:
    """Limit the size of files as a full disk does, to writers in native code as well: a short
    write, then an error."""
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)


@pytest.mark.parametrize("size", [0, 1, 100, 700])
def test_files_that_cannot_grow_are_not_taken_for_finished(tmp_path: Path, size: int) -> None:
    def work(run: Run) -> dict[str, float]:
        store = Store(tmp_path / "store")
        stage = store.stage_result(
            "model",
            digest_of_value(1),
            {},
            lambda folder: (folder / "m").write_bytes(bytes(1200)) and None,
        )
        model_path = run.path / "model.json"
        m_path = stage.path / "m"
        model_path.write_bytes(m_path.read_bytes())
        return {"fit_test_percent": 90.0}

    folder = tmp_path / "study" / "run"
    with no_file_longer_than(size):
        try:
            outcome = execute_run(folder, {}, work).status
        except OSError:
            outcome = "raised"
    assert outcome in ("failed", "raised")
    paths = (tmp_path / "store" / "model").glob("[!.]*")
    assert not list(paths)
    status = execute_run(folder, {}, work).status
    assert status == "ok"
    actual = len((folder / "model.json").read_bytes())
    assert actual == 1200


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(folder)], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("mounting a small file system needs more rights")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_study_on_a_full_disk_is_finished_once_there_is_room(small_disk: Path) -> None:
    def work(run: Run) -> dict[str, float]:
        number = int(run.path.name)
        store = Store(small_disk / "store")
        stage = store.stage_result(
            "model",
            digest_of_value(number),
            {},
            lambda folder: (folder / "m").write_bytes(bytes([number]) * 9000) and None,
        )
        model_path = run.path / "model.json"
        m_path = stage.path / "m"
        model_path.write_bytes(m_path.read_bytes()[:1000])
        return {"fit_test_percent": float(number)}

    def command() -> list[str]:
        outcomes = []
        for number in range(6):
            try:
                status = execute_run(
                    small_disk / "study" / f"{number}", {"seed": number}, work
                ).status
                outcomes.append(status)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                outcomes.append("raised")
        return outcomes

    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(440_000))
    assert set(command()) - {"ok"}, "the disk was not full"
    for record in (small_disk / "study").glob(f"*/{RECORD}"):
        content = record.read_bytes()
        assert read_json_with_digest(content) is not None
    ballast.unlink()
    assert command() == ["ok"] * 6
    fit_test_percent = gather(small_disk / "study")["fit_test_percent"]
    expected = [float(n) for n in range(6)]
    assert fit_test_percent.to_list() == expected
