"""Fuzzed files: whatever the bytes, a reader gives finite numbers of one length or one sentence;
never a traceback."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.io import savemat

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.data.readers.reader import Table, read_table
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

OUTPUT = np.sin(np.arange(40.0))
COLUMNS = {"u": np.linspace(-1, 1, 40), "y": OUTPUT}
WANTED = {"u": "", "y": ""}


def whole(suffix: str, folder: Path) -> bytes:
    path = folder / f"whole{suffix}"
    if suffix == ".csv":
        table = pd.DataFrame(COLUMNS)
        table.to_csv(path, index=False)
    elif suffix == ".parquet":
        table = pd.DataFrame(COLUMNS)
        table.to_parquet(path)
    elif suffix.endswith(".mat"):
        version = "4" if suffix == ".4.mat" else "5"
        savemat(path, COLUMNS, format=version)
    else:
        channels = tuple(Channel(name=name, unit="V") for name in COLUMNS)
        columns = list(COLUMNS.values())
        values = np.stack(columns, axis=1)
        time_s = np.arange(40.0)
        topic = {"topic": "/log", "channels": channels}
        signal_group = SignalGroup(time_s=time_s, values=values, **topic)
        write_mcap(path, (signal_group,), {})
    return path.read_bytes()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[bytes, Path]]:
    folder = tmp_path_factory.mktemp("fuzz")
    cache: dict[str, bytes] = {}

    def content_and_path(suffix: str) -> tuple[bytes, Path]:
        content = cache.setdefault(suffix, whole(suffix, folder))
        return content, folder / f"fuzzed{suffix}"

    return content_and_path


def read_or_refuse(path: Path) -> None:
    try:
        table = read_table(path, WANTED)
    except BadRequest as refusal:
        sentence = str(refusal)
    else:
        check(table)
        return
    assert "\n" not in sentence


def check(table: Table) -> None:
    u = table.columns["u"]
    expected = len(table.columns["y"])
    assert len(u) == expected
    columns = table.columns.values()
    is_finite = [np.isfinite(column).all() for column in columns]
    assert all(is_finite)


KINDS = st.sampled_from(["flip", "cut", "insert", "delete"])
PLACES = st.floats(0, 1)
EXTRAS = st.binary(min_size=1, max_size=8)
EDIT = st.tuples(KINDS, PLACES, EXTRAS)
Edits = list[tuple[str, float, bytes]]
edits = st.lists(EDIT, min_size=1, max_size=4)


def edited(content: bytes, changes: Edits) -> bytes:
    for kind, where, extra in changes:
        largest = max(len(content) - 1, 0)
        at = int(where * largest)
        if kind == "flip" and content:
            bit = 1 << extra[0] % 8
            flipped = bytes([content[at] ^ bit])
            content = content[:at] + flipped + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + extra + content[at:]
        else:
            end = at + len(extra)
            content = content[:at] + content[end:]
    return content


SUFFIXES = [".csv", ".mat", ".4.mat", ".parquet", ".mcap"]
every_suffix = pytest.mark.parametrize("suffix", SUFFIXES)


@every_suffix
def test_the_sound_file_is_read(sound, suffix: str) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(suffix)
    path.write_bytes(content)
    columns = read_table(path, WANTED).columns
    actual = columns["y"]
    np.testing.assert_array_equal(actual, COLUMNS["y"])


# A schema whose refusal by protobuf has two lines.
FLIP_IN_A_SCHEMA = ("flip", 0.8269672421898115, b"\x01")


@every_suffix
@given(changes=edits)
@example(changes=[FLIP_IN_A_SCHEMA])
def test_damaged_files(sound, suffix: str, changes: Edits) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(suffix)
    path.write_bytes(edited(content, changes))
    read_or_refuse(path)


@every_suffix
@given(content=st.binary(max_size=400))
def test_arbitrary_bytes(sound, suffix: str, content: bytes) -> None:  # type: ignore[no-untyped-def]
    _, path = sound(suffix)
    path.write_bytes(content)
    read_or_refuse(path)


CELL = st.one_of(st.floats(), st.text(max_size=6), st.integers())
ROW = st.lists(CELL, min_size=1, max_size=4)
ROWS = st.lists(ROW, max_size=12)


@given(cells=ROWS)
def test_csv_of_arbitrary_cells(sound, cells: list[list[object]]) -> None:  # type: ignore[no-untyped-def]
    _, path = sound(".csv")
    text = io.StringIO()
    lengths = [len(row) for row in cells]
    longest = max(lengths, default=0)
    padded = []
    for row in cells:
        missing = longest - len(row)
        padded.append(row + [None] * missing)
    table = pd.DataFrame(padded)
    table.to_csv(text, index=False, header=False)
    rows = text.getvalue().replace("\0", "")
    path.write_text("u,y\n" + rows, encoding="utf-8", errors="surrogatepass")
    read_or_refuse(path)


@given(changes=edits)
def test_no_damaged_recording_gives_other_numbers(sound, changes: Edits) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(".mcap")
    path.write_bytes(edited(content, changes))
    try:
        (group,), _ = read_mcap(path)
    except BadRequest:
        return
    actual = group.values[:, 1]
    np.testing.assert_array_equal(actual, COLUMNS["y"])


def test_a_library_that_answers_in_lines_is_quoted_in_one() -> None:
    damage = 'damaged (no such type:\n  "Dat" (did you mean\n  "Data"))'
    refusal = BadRequest("path", "a.mcap", damage, "record it again")
    assert (
        str(refusal)
        == 'path = a.mcap: damaged (no such type: "Dat" (did you mean "Data")); record it again.'
    )
