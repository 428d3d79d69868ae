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

COLUMNS = {"u": np.linspace(-1, 1, 40), "y": np.sin(np.arange(40.0))}
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
        savemat(path, COLUMNS, format="4" if suffix == ".4.mat" else "5")
    else:
        channels = tuple(Channel(name=name, unit="V") for name in COLUMNS)
        columns = list(COLUMNS.values())
        values = np.stack(columns, axis=1)
        time_s = np.arange(40.0)
        signal_group = SignalGroup(topic="/log", time_s=time_s, channels=channels, values=values)
        groups = (signal_group,)
        write_mcap(path, groups, {})
    return path.read_bytes()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[bytes, Path]]:
    folder = tmp_path_factory.mktemp("fuzz")
    cache: dict[str, bytes] = {}
    return lambda suffix: (
        cache.setdefault(suffix, whole(suffix, folder)),
        folder / f"fuzzed{suffix}",
    )


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
    assert all(np.isfinite(column).all() for column in columns)


edits = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "insert", "delete"]),
        st.floats(0, 1),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=4,
)


def edited(content: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    for kind, where, extra in changes:
        largest = max(len(content) - 1, 0)
        at = int(where * largest)
        if kind == "flip" and content:
            content = content[:at] + bytes([content[at] ^ (1 << extra[0] % 8)]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + extra + content[at:]
        else:
            content = content[:at] + content[at + len(extra) :]
    return content


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".4.mat", ".parquet", ".mcap"])
def test_the_sound_file_is_read(sound, suffix: str) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(suffix)
    path.write_bytes(content)
    columns = read_table(path, WANTED).columns
    actual = columns["y"]
    np.testing.assert_array_equal(actual, COLUMNS["y"])


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".4.mat", ".parquet", ".mcap"])
@given(changes=edits)
@example(
    changes=[("flip", 0.8269672421898115, b"\x01")]
)  # a schema whose refusal by protobuf has two lines
def test_damaged_files(sound, suffix: str, changes: list[tuple[str, float, bytes]]) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(suffix)
    path.write_bytes(edited(content, changes))
    read_or_refuse(path)


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".4.mat", ".parquet", ".mcap"])
@given(content=st.binary(max_size=400))
def test_arbitrary_bytes(sound, suffix: str, content: bytes) -> None:  # type: ignore[no-untyped-def]
    _, path = sound(suffix)
    path.write_bytes(content)
    read_or_refuse(path)


@given(
    cells=st.lists(
        st.lists(
            st.one_of(st.floats(), st.text(max_size=6), st.integers()), min_size=1, max_size=4
        ),
        max_size=12,
    )
)
def test_csv_of_arbitrary_cells(sound, cells: list[list[object]]) -> None:  # type: ignore[no-untyped-def]
    _, path = sound(".csv")
    text = io.StringIO()
    longest = max((len(row) for row in cells), default=0)
    padded = [[*row, *[None] * (longest - len(row))] for row in cells]
    table = pd.DataFrame(padded)
    table.to_csv(text, index=False, header=False)
    path.write_text(
        "u,y\n" + text.getvalue().replace("\0", ""), encoding="utf-8", errors="surrogatepass"
    )
    read_or_refuse(path)


@given(changes=edits)
def test_no_damaged_recording_gives_other_numbers(
    sound, changes: list[tuple[str, float, bytes]]
) -> None:  # type: ignore[no-untyped-def]
    content, path = sound(".mcap")
    path.write_bytes(edited(content, changes))
    try:
        (group,), _ = read_mcap(path)
    except BadRequest:
        return
    actual = group.values[:, 1]
    np.testing.assert_array_equal(actual, COLUMNS["y"])


def test_a_library_that_answers_in_lines_is_quoted_in_one() -> None:
    refusal = BadRequest(
        "path",
        "a.mcap",
        'damaged (no such type:\n  "Dat" (did you mean\n  "Data"))',
        "record it again",
    )
    assert (
        str(refusal)
        == 'path = a.mcap: damaged (no such type: "Dat" (did you mean "Data")); record it again.'
    )
