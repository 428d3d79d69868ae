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
KIND = st.sampled_from(KINDS)
KINDS_OF_VERSION_4 = ["f8", "f4", "i4", "i2", "u2", "u1"]
KIND_OF_VERSION_4 = st.sampled_from(KINDS_OF_VERSION_4)
SIDE = st.integers(0, 5)
SHAPE = st.tuples(SIDE, SIDE)


@given(kind=KIND, shape=SHAPE, compressed=st.booleans(), data=st.data())
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
    variables = {"matrix_1": matrix, "b": b}
    savemat(path, variables, do_compression=compressed)
    ours = parse_mat_file(path)
    theirs = loadmat(path)
    assert list(ours) == list(variables)
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name])


@given(kind=KIND_OF_VERSION_4, data=st.data())
def test_version_4(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    dtype = np.dtype(kind)
    entries = arrays(dtype, (3, 2))
    matrix = data.draw(entries)
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    c = np.ones(2) * 1j
    e = scipy.sparse.eye_array(2, format="csc")
    others = {"c": c, "s": "text", "e": e}
    y = np.arange(4.0)
    variables = {"x": matrix, **others, "y": y}
    savemat(path, variables, format="4")
    ours = parse_mat_file(path)
    np.testing.assert_array_equal(ours["x"], matrix)
    expected = [np.arange(4.0)]
    np.testing.assert_array_equal(ours["y"], expected)
    kinds = [ours[name] for name in others]
    assert kinds == ["complex", "text", "a sparse matrix"]


def write_version_4(path: Path, byte_order: int) -> None:
    """Write `x = [1; 2]` as a machine of this byte order does."""
    header = struct.pack(">5i", byte_order, 2, 1, 0, 2)
    two_doubles = struct.pack(">2d", 1.0, 2.0)
    path.write_bytes(header + b"x\0" + two_doubles)


def test_version_4_of_another_byte_order(tmp_path: Path) -> None:
    """`x = [1; 2]` of a machine whose greatest byte is first, and of a VAX, whose numbers are not
    read."""
    path = tmp_path / "a.mat"
    write_version_4(path, 1000)
    columns = MatReader().read_columns(path, ["x"]).columns
    np.testing.assert_array_equal(columns["x"], [1.0, 2.0])
    write_version_4(path, 2000)
    words = r"not a complete MAT file: .*byte ordering"
    with pytest.raises(BadRequest, match=words):
        MatReader().read_columns(path, ["x"])


def test_what_is_no_matrix_is_named(tmp_path: Path) -> None:
    structure = {"f": 1.0}
    cells = np.array(["ab", 1.0], dtype=object)
    variables = {"s": structure, "c": cells, "t": "text", "z": 1j}
    path = tmp_path / "a.mat"
    savemat(path, variables)
    values = parse_mat_file(path)
    refusals = {name: value for name, value in values.items() if isinstance(value, str)}
    expected = {"c{1}": "text", "t": "text", "z": "complex"}
    assert refusals == expected
    assert values["s.f"] == 1.0
    assert values["c{2}"] == 1.0


def encode_element(kind: int, data: bytes) -> bytes:
    """One element of a MAT file, filled up to eight bytes."""
    size = len(data)
    header = struct.pack("<II", kind, size)
    padding = b"\0" * (-size % 8)
    return header + data + padding


def encode_opaque(name: bytes) -> bytes:
    """A variable that is a time series of the new class."""
    classes = struct.pack("<II", 17, 0)
    flags = encode_element(6, classes)
    class_of_object = encode_element(1, b"MCOS")
    name_of_class = encode_element(1, b"timeseries")
    opaque = flags + encode_element(1, name)
    opaque += class_of_object + name_of_class
    return encode_element(14, opaque)


def test_an_object_that_cannot_be_read_is_skipped_by_name(tmp_path: Path) -> None:
    """Old objects (iddata) by their fields; a string, table or timeseries of a new class is an
    element without shape, written here by hand."""
    u = np.arange(30.0)
    record = [(u[:, None], 0.1)]
    dtype = [("InputData", "O"), ("Ts", "O")]
    fields = np.array(record, dtype=dtype)
    iddata = scipy.io.matlab.MatlabObject(fields, "iddata")
    m = np.ones((30, 2))
    path = tmp_path / "a.mat"
    savemat(path, {"z": iddata, "u": u, "m": m})
    opaque = encode_opaque(b"tt")
    with path.open("ab") as stream:
        stream.write(opaque)
    table = MatReader().read_columns(path, ["z.InputData", "u", "m:2"])
    actual = table.columns["z.InputData"]
    np.testing.assert_array_equal(actual, u)
    words = r"\(variable\) = tt: is an object"
    with pytest.raises(BadRequest, match=words):
        MatReader().read_columns(path, ["tt"])
    contents = MatReader().read_all_columns(path)
    columns = list(contents.columns)
    expected = ["z.InputData", "u", "m:1", "m:2"]
    assert columns == expected
    expected = {"tt", "z.Ts"}
    assert set(contents.skipped) == expected


@pytest.mark.data
@pytest.mark.parametrize("name", ["DATA_EMPS", "DATA_EMPS_PULSES"])
def test_the_servo_files(benchmark_data: Path, name: str) -> None:
    path = benchmark_data / "emps" / f"{name}.mat"
    ours = parse_mat_file(path)
    theirs = loadmat(path)
    for variable in ("t", "vir", "qm", "kp"):
        expected = theirs[variable]
        np.testing.assert_array_equal(ours[variable], expected)


OF_VERSION_7_3 = b"MATLAB 7.3 MAT-file" + bytes(200)
HDF5_ALONE = b"\x89HDF\r\n" + bytes(100)
NO_MATRICES = [b"", OF_VERSION_7_3, HDF5_ALONE, b"x" * 200]


@pytest.mark.parametrize("content", NO_MATRICES)
def test_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    words = r"a\.mat: not a complete MAT file: .*; save it again with -v7"
    with pytest.raises(BadRequest, match=words):
        MatReader().read_columns(path, ["x"])


SAMPLING_TIMES = {"seconds": 20.0, "milliseconds": 0.02, "": 20.0}


def test_the_sampling_time_that_an_object_states(tmp_path: Path) -> None:
    """`Ts` of iddata, in its unit; a step_s that contradicts it is refused; two that differ are no
    sampling time."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 1))
    running_sum = np.cumsum(u, axis=0)
    log = {"InputData": u, "OutputData": running_sum}
    log["Ts"] = 20.0
    path = tmp_path / "log.mat"
    fields: dict[str, object] = {"path": str(path)}
    fields |= {"input": "id.InputData", "output": "id.OutputData"}
    for unit, step_s in SAMPLING_TIMES.items():
        with_unit = log | {"TimeUnit": unit}
        savemat(path, {"id": with_unit})
        recorded_data = RecordedData(**fields)
        pieces, remark = recorded_data.read_pieces(path)
        assert pieces[0].step_s == pytest.approx(step_s)
        assert f"its Ts is {step_s:g} s" in remark
    recorded_data = RecordedData(**fields, step_s=0.1)
    words = r"the times of log.mat show 20 s"
    with pytest.raises(BadRequest, match=words):
        recorded_data.read_pieces(path)
    other = log | {"Ts": 1.0}
    savemat(path, {"id": log, "other": other})
    fields["output"] = "other.OutputData"
    recorded_data = RecordedData(**fields)
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
    table = MatReader().read_columns(path, ["capture.Y(2).Data"])
    np.testing.assert_array_equal(table.columns["capture.Y(2).Data"], y)
    text = str(look(path, input="capture.Y(1).Data", output="capture.Y(2).Data"))
    assert "capture.Y(1).Data is Plant/In, capture.Y(2).Data is Plant/Out" in text
    assert "clock capture.X.Data (no unit: seconds); step 0.01 s" in text
