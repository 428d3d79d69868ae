"""Our MAT reader against scipy's, on everything scipy writes and on the benchmark's own files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import loadmat, savemat

from ssm_study.data.readers.mat import NotAMatFile, parse

KINDS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", ">f8"]


@given(
    kind=st.sampled_from(KINDS),
    shape=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    compressed=st.booleans(),
    data=st.data(),
)
def test_version_5(
    tmp_path_factory: pytest.TempPathFactory, kind: str, shape: tuple[int, int], compressed: bool, data: st.DataObject
) -> None:
    matrix = data.draw(arrays(np.dtype(kind), shape))
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    savemat(path, {"matrix_1": matrix, "b": np.arange(3.0)}, do_compression=compressed)
    mine, theirs = parse(path.read_bytes()), loadmat(path)
    assert list(mine) == ["matrix_1", "b"]
    np.testing.assert_array_equal(mine["matrix_1"], theirs["matrix_1"])
    np.testing.assert_array_equal(mine["b"], theirs["b"])


@given(kind=st.sampled_from(["f8", "f4", "i4", "i2", "u2", "u1"]), data=st.data())
def test_version_4(tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject) -> None:
    matrix = data.draw(arrays(np.dtype(kind), (3, 2)))
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    savemat(path, {"x": matrix, "c": np.ones(2) * 1j, "s": "text", "y": np.arange(4.0)}, format="4")
    mine, theirs = parse(path.read_bytes()), loadmat(path)
    np.testing.assert_array_equal(mine["x"], theirs["x"])
    np.testing.assert_array_equal(mine["y"], theirs["y"])
    assert (mine["c"], mine["s"]) == ("complex", "text")


def test_what_is_no_matrix_is_named(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"s": {"f": 1.0}, "c": np.array(["ab", 1.0], dtype=object), "t": "text", "z": 1j})
    assert parse((tmp_path / "a.mat").read_bytes()) == {
        "s": "a struct",
        "c": "a cell array",
        "t": "text",
        "z": "complex",
    }


@pytest.mark.data
@pytest.mark.parametrize("name", ["DATA_EMPS", "DATA_EMPS_PULSES"])
def test_the_servo_files(benchmark_data: Path, name: str) -> None:
    path = benchmark_data / "emps" / f"{name}.mat"
    mine, theirs = parse(path.read_bytes()), loadmat(path)
    for variable in ("t", "vir", "qm", "kp"):
        np.testing.assert_array_equal(mine[variable], theirs[variable])


@pytest.mark.parametrize("content", [b"", b"MATLAB 7.3 MAT-file" + bytes(200), b"\x89HDF\r\n" + bytes(100), b"x" * 200])
def test_refused(content: bytes) -> None:
    with pytest.raises(NotAMatFile):
        parse(content)
