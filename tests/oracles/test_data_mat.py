"""Our MAT reader against scipy's, on everything scipy writes and on the benchmark's own files."""

import struct
from pathlib import Path

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import loadmat, savemat

from ssm_study.data.look import look
from ssm_study.data.readers.mat import MatReader, parse_mat_file
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

KINDS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", ">f8"]


SHAPE = st.tuples(st.integers(0, 5), st.integers(0, 5))


@given(kind=st.sampled_from(KINDS), shape=SHAPE, compressed=st.booleans(), data=st.data())
def test_version_5(
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    shape: tuple[int, int],
    compressed: bool,
    data: st.DataObject,
) -> None:
    entries = arrays(np.dtype(kind), shape)
    matrix = data.draw(entries)
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    b = np.arange(3.0)
    savemat(path, {"matrix_1": matrix, "b": b}, do_compression=compressed)
    mine = parse_mat_file(path)
    theirs = loadmat(path)
    expected = ["matrix_1", "b"]
    assert list(mine) == expected
    np.testing.assert_array_equal(mine["matrix_1"], theirs["matrix_1"])
    np.testing.assert_array_equal(mine["b"], theirs["b"])


@given(kind=st.sampled_from(["f8", "f4", "i4", "i2", "u2", "u1"]), data=st.data())
def test_version_4(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    entries = arrays(np.dtype(kind), (3, 2))
    matrix = data.draw(entries)
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    c = np.ones(2) * 1j
    e = scipy.sparse.eye_array(2, format="csc")
    others = {"c": c, "s": "text", "e": e}
    y = np.arange(4.0)
    savemat(path, {"x": matrix, **others, "y": y}, format="4")
    mine = parse_mat_file(path)
    np.testing.assert_array_equal(mine["x"], matrix)
    expected = [np.arange(4.0)]
    np.testing.assert_array_equal(mine["y"], expected)
    expected = ["complex", "text", "a sparse matrix"]
    assert [mine[name] for name in others] == expected


def test_version_4_of_another_byte_order(tmp_path: Path) -> None:
    """`x = [1; 2]` of a machine whose greatest byte is first, and of a VAX, whose numbers are not
    read."""
    cases = ((1000, [1.0, 2.0]), (2000, None))
    for order, numbers in cases:
        header = struct.pack(">5i", order, 2, 1, 0, 2)
        two_doubles = struct.pack(">2d", 1.0, 2.0)
        content = header + b"x\0" + two_doubles
        (tmp_path / "a.mat").write_bytes(content)
        if numbers is None:
            with pytest.raises(BadRequest, match=r"not a complete MAT file: .*byte ordering"):
                MatReader().read(tmp_path / "a.mat", ["x"])
        else:
            table = MatReader().read(tmp_path / "a.mat", ["x"])
            columns = table.columns
            actual = columns["x"]
            np.testing.assert_array_equal(actual, numbers)


def test_what_is_no_matrix_is_named(tmp_path: Path) -> None:
    s = {"f": 1.0}
    c = np.array(["ab", 1.0], dtype=object)
    savemat(tmp_path / "a.mat", {"s": s, "c": c, "t": "text", "z": 1j})
    values = parse_mat_file(tmp_path / "a.mat")
    expected = {"c{1}": "text", "t": "text", "z": "complex"}
    refusals = {name: value for name, value in values.items() if isinstance(value, str)}
    assert refusals == expected
    assert values["s.f"] == 1.0
    assert values["c{2}"] == 1.0


def test_an_object_that_cannot_be_read_is_skipped_by_name(tmp_path: Path) -> None:
    """Old objects (iddata) by their fields; a string, table or timeseries of a new class is an
    element without shape, written here by hand."""
    u = np.arange(30.0)
    record = [(u[:, None], 0.1)]
    fields = np.array(record, dtype=[("InputData", "O"), ("Ts", "O")])
    iddata = scipy.io.matlab.MatlabObject(fields, "iddata")
    m = np.ones((30, 2))
    savemat(tmp_path / "a.mat", {"z": iddata, "u": u, "m": m})

    def element(kind: int, data: bytes) -> bytes:
        padding = b"\0" * (-len(data) % 8)
        return struct.pack("<II", kind, len(data)) + data + padding

    flags = element(6, struct.pack("<II", 17, 0))
    class_of_object = element(1, b"MCOS")
    name_of_class = element(1, b"timeseries")
    opaque = flags + element(1, b"tt") + class_of_object + name_of_class
    with (tmp_path / "a.mat").open("ab") as stream:
        stream.write(element(14, opaque))
    table = MatReader().read(tmp_path / "a.mat", ["z.InputData", "u", "m:2"])
    actual = table.columns["z.InputData"]
    np.testing.assert_array_equal(actual, u)
    with pytest.raises(BadRequest, match=r"\(variable\) = tt: is an object"):
        MatReader().read(tmp_path / "a.mat", ["tt"])
    contents = MatReader().read_all_columns(tmp_path / "a.mat")
    columns = list(contents.columns)
    expected = ["z.InputData", "u", "m:1", "m:2"]
    assert columns == expected
    expected = {"tt", "z.Ts"}
    assert set(contents.skipped) == expected


@pytest.mark.data
@pytest.mark.parametrize("name", ["DATA_EMPS", "DATA_EMPS_PULSES"])
def test_the_servo_files(benchmark_data: Path, name: str) -> None:
    path = benchmark_data / "emps" / f"{name}.mat"
    mine = parse_mat_file(path)
    theirs = loadmat(path)
    for variable in ("t", "vir", "qm", "kp"):
        np.testing.assert_array_equal(mine[variable], theirs[variable])


NO_MATRICES = [b"", b"MATLAB 7.3 MAT-file" + bytes(200), b"\x89HDF\r\n" + bytes(100), b"x" * 200]


@pytest.mark.parametrize("content", NO_MATRICES)
def test_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(
        BadRequest, match=r"a\.mat: not a complete MAT file: .*; save it again with -v7"
    ):
        MatReader().read(tmp_path / "a.mat", ["x"])


def test_the_sampling_time_that_an_object_states(tmp_path: Path) -> None:
    """`Ts` of iddata, in its unit; a step_s that contradicts it is refused; two that differ are no
    sampling time."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 1))
    running_sum = np.cumsum(u, axis=0)
    log = {"InputData": u, "OutputData": running_sum, "Ts": 20.0}
    path = tmp_path / "log.mat"
    fields: dict[str, object] = {"path": str(path), "input": "id.InputData"}
    fields["output"] = "id.OutputData"
    cases = (("seconds", 20.0), ("milliseconds", 0.02), ("", 20.0))
    for unit, step_s in cases:
        with_unit = log | {"TimeUnit": unit}
        scipy.io.savemat(path, {"id": with_unit})
        recorded_data = RecordedData(**fields)
        pieces, remark = recorded_data.read_pieces(path)
        assert pieces[0].step_s == pytest.approx(step_s)
        assert f"its Ts is {step_s:g} s" in remark
    recorded_data = RecordedData(**fields, step_s=0.1)
    with pytest.raises(BadRequest, match=r"the times of log.mat show 20 s"):
        recorded_data.read_pieces(path)
    other = log | {"Ts": 1.0}
    scipy.io.savemat(path, {"id": log, "other": other})
    recorded_data = RecordedData(**(fields | {"output": "other.OutputData"}))
    with pytest.raises(BadRequest, match="the sampling time is unknown"):
        recorded_data.read_pieces(path)


def tagged(kind: int, data: bytes) -> bytes:
    """Data element of a MATLAB 5 file: tag, data, padding to eight bytes."""
    padding = b"\0" * (-len(data) % 8)
    return struct.pack("<II", kind, len(data)) + data + padding


def test_contents_of_objects_are_no_column(tmp_path: Path) -> None:
    """MATLAB stores them as a nameless matrix of bytes, longer than any signal."""
    path = tmp_path / "a.mat"
    u = np.arange(30.0)
    savemat(path, {"u": u, "y": 2.0 * u})
    flags = tagged(6, struct.pack("<II", 9, 0))
    shape = tagged(5, struct.pack("<ii", 1, 256))
    numbers = tagged(2, bytes(range(256)))
    nameless = flags + shape + tagged(1, b"") + numbers
    parts = [tagged(6, struct.pack("<II", 17, 0))]
    parts += [tagged(1, word) for word in (b"out", b"MCOS", b"timeseries")]
    with path.open("ab") as stream:
        stream.write(tagged(14, nameless))
        stream.write(tagged(14, b"".join(parts)))
    contents = MatReader().read_all_columns(path)
    assert list(contents.columns) == ["u", "y"]
    assert "class timeseries (save x = out.Data instead)" in contents.skipped["out"]


def test_an_object_alone_is_refused_with_what_to_save(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"note": "text"})
    parts = [tagged(6, struct.pack("<II", 17, 0))]
    parts += [tagged(1, word) for word in (b"out", b"MCOS", b"timetable")]
    with path.open("ab") as stream:
        stream.write(tagged(14, b"".join(parts)))
    with pytest.raises(BadRequest, match=r"save x = out\.Variables instead"):
        look(path)


def test_the_structs_of_a_recorder_are_read_by_number(tmp_path: Path) -> None:
    """A capture of dSPACE ControlDesk has one struct for the clock, an array for the signals."""
    path = tmp_path / "a.mat"
    signals = np.empty((1, 2), dtype=[("Name", "O"), ("Data", "O")])
    u = np.repeat([0.0, 1.0, 3.0], 10)
    y = np.cumsum(u)
    signals[0, 0] = ("Plant/In", u)
    signals[0, 1] = ("Plant/Out", y)
    clock = 0.01 * np.arange(30)
    savemat(path, {"capture": {"X": {"Data": clock}, "Y": signals}})
    table = MatReader().read(path, ["capture.Y(2).Data"])
    np.testing.assert_array_equal(table.columns["capture.Y(2).Data"], y)
    text = str(look(path, input="capture.Y(1).Data", output="capture.Y(2).Data"))
    assert "capture.Y(1).Data is Plant/In, capture.Y(2).Data is Plant/Out" in text
    assert "clock capture.X.Data (no unit: seconds); step 0.01 s" in text
