"""MAT files of version 7.3 and spreadsheets, as their own libraries write them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssm_study.data.readers import mat_hdf5
from ssm_study.data.readers.mat import MatReader
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

TIMES = 0.01 * np.arange(200)
U = np.repeat([0.0, 1.0, -1.0, 0.5], 50)
IMPULSE_RESPONSE = 0.2 * 0.8 ** np.arange(40)
RESPONSE = np.convolve(U, IMPULSE_RESPONSE)
Y = RESPONSE[:200]
COMPLEX = [("real", "f8"), ("imag", "f8")]


def hdf5_log(folder: Path) -> Path:
    """A file as MATLAB writes it with -v7.3: column vectors, a struct, a matrix, text, an object, a
    complex vector, an empty variable."""
    h5py = pytest.importorskip("h5py")
    path = folder / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name: str, values: np.ndarray, kind: str, **attributes: object) -> None:
            data = file.create_dataset(name, data=values.T)
            data.attrs["MATLAB_class"] = np.bytes_(kind)
            for title, value in attributes.items():
                data.attrs[title] = value

        put("t", TIMES[:, None], "double")
        single = U[:, None].astype(np.float32)
        put("u", single, "single")
        both = np.stack([U, Y], axis=1)
        put("data", both, "double")
        characters = np.array([[72, 105]], dtype=np.uint16)
        put("note", characters, "char", MATLAB_int_decode=2)
        no_date = np.zeros((1, 6), dtype=np.uint32)
        put("stamp", no_date, "datetime", MATLAB_object_decode=3)
        empty = np.zeros((1, 2), dtype=np.uint64)
        put("nothing", empty, "double", MATLAB_empty=1)
        parts = np.zeros((200, 1), dtype=COMPLEX)
        put("z", parts, "double")
        structure = file.create_group("log")
        structure.attrs["MATLAB_class"] = np.bytes_("struct")
        put("log/y", Y[:, None], "double")
        file.create_group("#refs#")
    content = path.read_bytes()
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" ")
    path.write_bytes(header + content[512:])
    return path


def test_a_file_of_version_7_3_is_read(tmp_path: Path) -> None:
    path = hdf5_log(tmp_path)
    signals = {"input": "u", "output": "log.y", "time": "t"}
    source = RecordedData(path=str(path), **signals)
    (piece,), remark = source.read_pieces(path)
    assert piece.step_s == pytest.approx(0.01)
    actual = piece.u[:, 0]
    np.testing.assert_array_equal(actual, U)
    actual = piece.y[:, 0]
    np.testing.assert_array_equal(actual, Y)
    table = MatReader().read_columns(path, ["data:1", "data:2"])
    second_column = table.columns["data:2"]
    np.testing.assert_array_equal(second_column, Y)
    skipped = MatReader().read_all_columns(path).skipped
    expected = {
        "note": "is text, not real numbers",
        "stamp": "is an object, not real numbers",
        "z": "is complex, not real numbers",
    }
    assert skipped == expected
    assert "step 0.01 s" in remark


def test_a_file_of_version_7_3_is_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = hdf5_log(tmp_path)
    signals = {"input": "note", "output": "log.y"}
    source = RecordedData(path=str(path), step_s=0.01, **signals)
    with pytest.raises(BadRequest, match="is text, not real numbers"):
        source.read_pieces(path)
    with pytest.raises(ValueError, match="holds more than 0 MiB"):
        mat_hdf5.parse_mat_hdf5(path, 100)
    content = path.read_bytes()
    path.write_bytes(content[:2000])
    with pytest.raises(BadRequest, match="not a complete MAT file"):
        source.read_pieces(path)
    modules = __import__("sys").modules
    monkeypatch.setitem(modules, "h5py", None)
    with pytest.raises(BadRequest, match="save it with -v7, or pip install h5py"):
        source.read_pieces(path)


def test_a_workbook_is_read(tmp_path: Path) -> None:
    """Times as cells of the spreadsheet's own kind, a row of units, an empty cell."""
    pytest.importorskip("openpyxl")
    times = pd.date_range("2026-01-01", periods=200, freq="1min")
    measured: list[object] = list(Y)
    measured[100] = None
    heads = ["time", "u", "y"]
    units = ["", "V", "rpm"]
    rows = [heads, units]
    rows += [list(row) for row in zip(times, U, measured, strict=True)]
    path = tmp_path / "log.xlsx"
    table = pd.DataFrame(rows, dtype=object)
    table.to_excel(path, header=False, index=False)
    recorded_data = RecordedData(path=str(path), input="u", output="y")
    pieces, remark = recorded_data.read_pieces(path)
    first, second = pieces
    assert len(first) == 100
    assert len(second) == 99
    assert first.step_s == 60.0
    actual = second.y[:, 0]
    expected = Y[101:]
    np.testing.assert_allclose(actual, expected)
    assert "clock time (dates)" in remark
