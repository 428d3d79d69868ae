"""MCAP: what is written is read back bit for bit, by our reader and by the reference reader
Foxglove builds on."""

import resource
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import zstandard
from google.protobuf import descriptor_pb2
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.reader import McapReader as McapReferenceReader
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.data.readers.mcap import McapReader
from ssm_study.data.readers.reader import read_table
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel


def group(topic: str, values: np.ndarray, step_s: float = 0.01) -> SignalGroup:
    numbers = range(values.shape[1])
    channels = tuple(Channel(name=f"signal_{k}", unit="rad/s") for k in numbers)
    samples = len(values)
    time_s = np.arange(samples) * step_s
    return SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values)


SIDE = st.integers(1, 20)
SHAPES = st.tuples(SIDE, SIDE)
DOUBLES = st.floats(width=64)
ARRAYS = arrays(np.float64, SHAPES, elements=DOUBLES)


@given(values=ARRAYS)
def test_every_double_survives(
    values: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    groups = (group("/output", values),)
    write_mcap(path, groups, {"plant": "DCMotor"})
    (back,), metadata = read_mcap(path)
    in_rows = np.ascontiguousarray(back.values)
    read_back = in_rows.tobytes()
    assert read_back == values.tobytes()
    assert metadata == {"plant": "DCMotor"}


def test_groups_units_and_times_survive(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((500, 1))
    inputs = group("/input", white_noise)
    white_noise = rng.standard_normal((300, 4))
    states = group("/states/true", white_noise, 0.02)
    groups = (inputs, states)
    path = tmp_path / "a.mcap"
    write_mcap(path, groups, {"plant": "DCMotor", "seed": "0"})
    back, metadata = read_mcap(path)
    for written, read in zip(groups, back, strict=True):
        assert written.topic == read.topic
        assert written.channels == read.channels
        np.testing.assert_array_equal(written.values, read.values)
        np.testing.assert_allclose(read.time_s, written.time_s, atol=0.5e-9)
    assert metadata["seed"] == "0"


def make_reference_reader(stream: IO[bytes]) -> McapReferenceReader:
    """The reference reader of a stream, with the decoder of protocol buffers."""
    decoder_factories = [DecoderFactory()]
    return make_reader(stream, validate_crcs=True, decoder_factories=decoder_factories)


def test_the_reference_reader_agrees(tmp_path: Path) -> None:
    """Schemas decode, log times are the sampling clock's, messages come in order of time."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((50, 3))
    outputs = group("/output", values)
    inputs = group("/input", -values)
    path = tmp_path / "a.mcap"
    write_mcap(path, (outputs, inputs), {})
    with path.open("rb") as stream:
        reader = make_reference_reader(stream)
        messages = list(reader.iter_decoded_messages(log_time_order=False))
        summary = reader.get_summary()
        schemas = summary.schemas.values()
        names = {schema.name for schema in schemas}
    assert names == {"ssm_study.Output", "ssm_study.Input"}
    times = [message.log_time for _, _, message, _ in messages]
    assert times == sorted(times)
    decoded_outputs = []
    for _, channel, message, decoded in messages:
        if channel.topic == "/output":
            row = (message.log_time, decoded.signal_0, decoded.signal_2)
            decoded_outputs.append(row)
    expected = [(10_000_000 * k, row[0], row[2]) for k, row in enumerate(values)]
    assert decoded_outputs == expected


IN_ONE_TOPIC = ("/case_0/input", "/case_0/output")
IN_ANOTHER_TOPIC = ("/case_1/input", "/case_1/output")


def test_groups_below_one_name_share_their_messages(tmp_path: Path) -> None:
    """On one clock: read back as they were given, by the reference reader as fields."""
    rng = np.random.default_rng(4)
    groups = []
    for topic in (*IN_ONE_TOPIC, *IN_ANOTHER_TOPIC):
        white_noise = rng.standard_normal((400, 1))
        groups.append(group(topic, white_noise))
    white_noise = rng.standard_normal((400, 40))
    late = group("/case_1/late", white_noise, 0.02)  # on a clock of its own
    path = tmp_path / "a.mcap"
    write_mcap(path, (*groups, late), {})
    read_groups, _ = read_mcap(path)
    back = {read.topic: read for read in read_groups}
    assert len(back) == 5
    for written in (*groups, late):
        read = back[written.topic]
        assert read.channels == written.channels
        np.testing.assert_array_equal(read.values, written.values)
        np.testing.assert_allclose(read.time_s, written.time_s, atol=0.5e-9)
    input_values = groups[0].values[:, 0]
    output_values = groups[1].values[:, 0]
    with path.open("rb") as stream:
        reader = make_reference_reader(stream)
        messages = list(reader.iter_decoded_messages())
        summary = reader.get_summary()
        channels = {channel.topic: channel for channel in summary.channels.values()}
    of_case_0 = [decoded for _, channel, _, decoded in messages if channel.topic == "/case_0"]
    decoded_outputs = [decoded.output.signal_0 for decoded in of_case_0]
    assert decoded_outputs == list(output_values)
    expected = {"/case_0", "/case_1/input", "/case_1/output", "/case_1/late"}
    assert set(channels) == expected
    metadata = channels["/case_0"].metadata
    assert metadata["unit.input.signal_0"] == "rad/s"
    # As Foxglove plots them, and as topic.field.
    names = ["/case_0.output.signal_0", "/case_0/input.signal_0"]
    columns = McapReader().read_columns(path, names).columns
    actual = [columns[name] for name in names]
    expected = [output_values, input_values]
    np.testing.assert_array_equal(actual, expected)


SIGNALS = ("input", "output", "measured", "estimate")


def test_groups_below_one_name_take_half_the_bytes_of_topics_apart(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    values = rng.standard_normal((400, 1))
    path = tmp_path / "b.mcap"
    sizes = []
    for topic in ("/case_0/{}", "/{}_alone"):
        names = [topic.format(name) for name in SIGNALS]
        groups = tuple(group(name, values) for name in names)
        write_mcap(path, groups, {})
        size = path.stat().st_size
        sizes.append(size)
    in_one_topic, in_topics_apart = sizes
    assert in_one_topic < in_topics_apart / 2


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((2000, 3))
    groups = (group("/output", values),)
    metadata = {"plant": "DCMotor"}
    write_mcap(tmp_path / "a.mcap", groups, metadata)
    return tmp_path / "a.mcap"


SHARES = [0.0, 0.001, 0.3, 0.7, 0.99, 0.9999]


@pytest.mark.parametrize("share", SHARES)
def test_a_truncated_recording_is_refused(recording: Path, share: float) -> None:
    whole = recording.read_bytes()
    kept_bytes = int(share * len(whole))
    recording.write_bytes(whole[:kept_bytes])
    with pytest.raises(BadRequest, match=r"path = .*record it again\.$"):
        read_mcap(recording)


def test_no_flipped_bit_changes_a_number_silently(recording: Path) -> None:
    whole = recording.read_bytes()
    (true,), about = read_mcap(recording)
    rng = np.random.default_rng(3)
    refused = 0
    bits = 8 * len(whole)
    positions = rng.integers(0, bits, 300)
    for position in positions:
        damaged = bytearray(whole)
        byte, bit = divmod(position, 8)
        damaged[byte] ^= 1 << bit
        recording.write_bytes(damaged)
        try:
            (read,), metadata = read_mcap(recording)
        except BadRequest:
            refused += 1
            continue
        np.testing.assert_array_equal(read.values, true.values)
        assert metadata == about
        assert read.channels == true.channels
        np.testing.assert_array_equal(read.time_s, true.time_s)
    assert refused > 200  # the rest hit the index at the end, which is not needed to read


def test_a_name_that_is_no_identifier_is_refused() -> None:
    time_s = np.arange(2.0)
    channel = Channel(name="a b", unit="V")
    signals = {"channels": (channel,), "values": np.ones((2, 1))}
    with pytest.raises(BadRequest, match="unique identifier"):
        SignalGroup(topic="/y", time_s=time_s, **signals)


def test_an_existing_recording_is_replaced_whole_or_not_at_all(recording: Path) -> None:
    before = recording.read_bytes()
    ones = np.ones((2, 1))
    groups = (group("/a", ones), group("/a", ones))
    with pytest.raises(BadRequest, match="share a topic"):
        write_mcap(recording, groups, {})
    assert recording.read_bytes() == before


def test_a_full_disk_is_the_systems_own_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Known as a fault of the machine, so that the same command tries again; and it fills no
    terminal."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((4000, 2))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Bytes of a file: writes beyond fail as on a full disk.
    small = (10_000, hard)
    resource.setrlimit(resource.RLIMIT_FSIZE, small)
    try:
        groups = (group("/output", values),)
        with pytest.raises(OSError, match="File too large"):
            write_mcap(tmp_path / "a.mcap", groups, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not (tmp_path / "a.mcap").exists()
    output = capfd.readouterr()
    assert output == ("", "")


def largest_memory_kib() -> int:
    """The most memory that this process has held."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_maxrss


def write_chunk(path: Path, packed: bytes, claimed: int) -> None:
    """A recording of one packed chunk that claims this size."""
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        chunk = records.Chunk("zstd", packed, 0, 0, 0, claimed)
        builder = RecordBuilder()
        chunk.write(builder)
        file.write(builder.end())
        writer.finish()


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    """A few kilobytes that would unpack to a gigabyte: what the chunk claims does not matter, its
    frame says it."""
    zstd_compressor = zstandard.ZstdCompressor()
    press = zstd_compressor.compressobj(size=2**30)
    zeros = bytes(2**20)
    blocks = [press.compress(zeros) for _ in range(2**10)]
    blocks.append(press.flush())
    packed = b"".join(blocks)
    words = "unpacks to more than 256 MiB; split the recording"
    for claimed in (2**30, 100):
        path = tmp_path / f"{claimed}.mcap"
        write_chunk(path, packed, claimed)
        before = largest_memory_kib()
        with pytest.raises(BadRequest, match=f"^path = .*{words}"):
            read_mcap(path)
        with pytest.raises(BadRequest, match=rf"^data\.path = .*{words}"):
            read_table(path, {"u": ""})
        difference = largest_memory_kib() - before
        assert difference < 2**17


def logged(writer: Writer, topic: str, field: dict[str, object], contents: list[bytes]) -> None:
    """A topic of another program's: messages of one field or none, or of other messages with a
    double each."""
    names = {"name": f"{topic}.proto", "package": "theirs"}
    file = descriptor_pb2.FileDescriptorProto(syntax="proto3", **names)
    point = file.message_type.add(name="Point")
    point.field.add(name="x", number=1, type=1, label=1)
    whole = file.message_type.add(name=topic)
    if field:
        whole.field.add(number=1, **field)
    file_descriptor_set = descriptor_pb2.FileDescriptorSet(file=[file])
    data = file_descriptor_set.SerializeToString()
    schema = writer.register_schema(f"theirs.{topic}", "protobuf", data)
    channel = writer.register_channel(f"/{topic}", "protobuf", schema)
    for k, content in enumerate(contents):
        writer.add_message(channel, k, content, k)


DOUBLE_FIELD = b"\x09"
SPEED = {"name": "speed", "type": 1, "label": 1}
POINTS = {"name": "points", "type": 11, "label": 3, "type_name": ".theirs.Point"}


def encode_double(value: float) -> bytes:
    """A message with one number."""
    return DOUBLE_FIELD + np.float64(value).tobytes()


def test_topics_of_others_without_numbers_are_passed_over(tmp_path: Path) -> None:
    """A message without fields, and a list of messages, of which no sample has a number."""
    number = encode_double(2.5)
    point = encode_double(7.0)
    listed_point = b"\x0a\x09" + point
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        logged(writer, "Speed", SPEED, [number] * 3)
        logged(writer, "Ping", {}, [b""] * 3)
        lists = [listed_point, listed_point * 2, b""]
        logged(writer, "Path", POINTS, lists)
        writer.finish()
    (read,), _ = read_mcap(path)
    assert read.topic == "/Speed"
    expected = [[2.5]] * 3
    assert read.values.tolist() == expected
