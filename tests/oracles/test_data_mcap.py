"""MCAP: what is written is read back bit for bit, by our reader and by the reference reader
Foxglove builds on."""

import resource
from pathlib import Path

import numpy as np
import pytest
import zstandard
from google.protobuf import descriptor_pb2
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.data.readers.mcap import McapReader
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel


def group(topic: str, values: np.ndarray, step_s: float = 0.01) -> SignalGroup:
    numbers = range(values.shape[1])
    channels = tuple(Channel(name=f"signal_{k}", unit="rad/s") for k in numbers)
    time_s = np.arange(len(values)) * step_s
    return SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values)


SHAPES = st.tuples(st.integers(1, 20), st.integers(1, 20))


@given(values=arrays(np.float64, SHAPES, elements=st.floats(width=64)))
def test_every_double_survives(
    values: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    groups = (group("/output", values),)
    write_mcap(path, groups, {"plant": "DCMotor"})
    (back,), metadata = read_mcap(path)
    read_back = np.ascontiguousarray(back.values).tobytes()
    assert read_back == values.tobytes()
    assert metadata == {"plant": "DCMotor"}


def test_groups_units_and_times_survive(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((500, 1))
    signal_group = group("/input", white_noise)
    white_noise = rng.standard_normal((300, 4))
    groups = (signal_group, group("/states/true", white_noise, 0.02))
    write_mcap(tmp_path / "a.mcap", groups, {"plant": "DCMotor", "seed": "0"})
    back, metadata = read_mcap(tmp_path / "a.mcap")
    for wanted, found in zip(groups, back, strict=True):
        assert wanted.topic == found.topic
        assert wanted.channels == found.channels
        np.testing.assert_array_equal(wanted.values, found.values)
        np.testing.assert_allclose(found.time_s, wanted.time_s, atol=0.5e-9)
    assert metadata["seed"] == "0"


def test_the_reference_reader_agrees(tmp_path: Path) -> None:
    """Schemas decode, log times are the sampling clock's, messages come in order of time."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((50, 3))
    signal_group = group("/output", values)
    groups = (signal_group, group("/input", -values))
    write_mcap(tmp_path / "a.mcap", groups, {})
    with (tmp_path / "a.mcap").open("rb") as stream:
        decoder_factories = [DecoderFactory()]
        reader = make_reader(stream, validate_crcs=True, decoder_factories=decoder_factories)
        messages = list(reader.iter_decoded_messages(log_time_order=False))
        summary = reader.get_summary()
        schemas = summary.schemas.values()
        names = {schema.name for schema in schemas}
    assert names == {"ssm_study.Output", "ssm_study.Input"}
    times = [message.log_time for _, _, message, _ in messages]
    assert times == sorted(times)
    outputs = [
        (m.log_time, d.signal_0, d.signal_2) for _, c, m, d in messages if c.topic == "/output"
    ]
    expected = [(10_000_000 * k, values[k, 0], values[k, 2]) for k in range(50)]
    assert outputs == expected


def test_groups_below_one_name_share_their_messages(tmp_path: Path) -> None:
    """On one clock: read back as they were given, by the reference reader as fields."""
    rng = np.random.default_rng(4)
    groups = [
        group(f"/case_{i}/{name}", rng.standard_normal((400, 1)))
        for i in (0, 1)
        for name in ("input", "output")
    ]
    white_noise = rng.standard_normal((400, 40))
    late = group("/case_1/late", white_noise, 0.02)  # on a clock of its own
    write_mcap(tmp_path / "a.mcap", (*groups[:2], *groups[2:], late), {})
    mcap = read_mcap(tmp_path / "a.mcap")
    back = {one.topic: one for one in mcap[0]}
    for wanted in (*groups, late):
        assert back[wanted.topic].channels == wanted.channels
        assert len(back) == 5
        actual = back[wanted.topic].values
        np.testing.assert_array_equal(actual, wanted.values)
        actual = back[wanted.topic].time_s
        np.testing.assert_allclose(actual, wanted.time_s, atol=0.5e-9)
    with (tmp_path / "a.mcap").open("rb") as stream:
        decoder_factories = [DecoderFactory()]
        reader = make_reader(stream, validate_crcs=True, decoder_factories=decoder_factories)
        seen = [d for _, c, _, d in reader.iter_decoded_messages() if c.topic == "/case_0"]
        summary = reader.get_summary()
        signals = summary.channels.values()
        channels = {c.topic: c.metadata for c in signals}
    expected = list(groups[1].values[:, 0])
    assert [d.output.signal_0 for d in seen] == expected
    expected = {"/case_0", "/case_1/input", "/case_1/output", "/case_1/late"}
    assert set(channels) == expected
    assert channels["/case_0"]["unit.input.signal_0"] == "rad/s"
    names = [
        "/case_0.output.signal_0",
        "/case_0/input.signal_0",
    ]  # as Foxglove plots them, and as topic.field
    columns = McapReader().read(tmp_path / "a.mcap", names).columns
    actual = [columns[name] for name in names]
    expected = [groups[1].values[:, 0], groups[0].values[:, 0]]
    np.testing.assert_array_equal(actual, expected)


def test_groups_below_one_name_take_half_the_bytes_of_topics_apart(tmp_path: Path) -> None:
    values = np.random.default_rng(4).standard_normal((400, 1))
    sizes = []
    for topic in ("/case_0/{}", "/{}_alone"):
        names = [topic.format(name) for name in ("input", "output", "measured", "estimate")]
        groups = tuple(group(name, values) for name in names)
        write_mcap(tmp_path / "b.mcap", groups, {})
        st_size = (tmp_path / "b.mcap").stat().st_size
        sizes.append(st_size)
    upper_limit = sizes[1] / 2
    assert sizes[0] < upper_limit


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((2000, 3))
    groups = (group("/output", values),)
    metadata = {"plant": "DCMotor"}
    write_mcap(tmp_path / "a.mcap", groups, metadata)
    return tmp_path / "a.mcap"


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.99, 0.9999])
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
    positions = rng.integers(0, 8 * len(whole), 300)
    for position in positions:
        damaged = bytearray(whole)
        damaged[position // 8] ^= 1 << (position % 8)
        recording.write_bytes(damaged)
        try:
            (found,), metadata = read_mcap(recording)
        except BadRequest:
            refused += 1
            continue
        np.testing.assert_array_equal(found.values, true.values)
        assert metadata == about
        assert found.channels == true.channels
        np.testing.assert_array_equal(found.time_s, true.time_s)
    assert refused > 200  # the rest hit the index at the end, which is not needed to read


def test_a_name_that_is_no_identifier_is_refused() -> None:
    time_s = np.arange(2.0)
    channel = Channel(name="a b", unit="V")
    channels = (channel,)
    signal_group_values = np.ones((2, 1))
    with pytest.raises(BadRequest, match="unique identifier"):
        SignalGroup(topic="/y", time_s=time_s, channels=channels, values=signal_group_values)


def test_an_existing_recording_is_replaced_whole_or_not_at_all(recording: Path) -> None:
    before = recording.read_bytes()
    signal_group = group("/a", np.ones((2, 1)))
    other_group = group("/a", np.ones((2, 1)))
    groups = (signal_group, other_group)
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
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (10_000, hard)
    )  # bytes of a file: writes beyond fail as on a full disk
    try:
        groups = (group("/output", values),)
        with pytest.raises(OSError, match="File too large"):
            write_mcap(tmp_path / "a.mcap", groups, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not (tmp_path / "a.mcap").exists()
    output = capfd.readouterr()
    assert output == ("", "")


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    """A few kilobytes that would unpack to a gigabyte: what the chunk claims does not matter, its
    frame says it."""
    zstd_compressor = zstandard.ZstdCompressor()
    press = zstd_compressor.compressobj(size=2**30)
    blocks = [press.compress(bytes(2**20)) for _ in range(2**10)]
    packed = b"".join([*blocks, press.flush()])
    for claimed in (2**30, 100):
        path = tmp_path / f"{claimed}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, use_chunking=False)
            writer.start()
            chunk = records.Chunk("zstd", packed, 0, 0, 0, claimed)
            chunk.write(builder := RecordBuilder())
            file.write(builder.end())
            writer.finish()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(BadRequest, match="unpacks to more than 256 MiB; split the recording"):
            read_mcap(path)
        ru_maxrss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        difference = ru_maxrss - before
        assert difference < 2**17  # kilobytes


def logged(writer: Writer, topic: str, field: dict[str, object], contents: list[bytes]) -> None:
    """A topic of another program's: messages of one field or none, or of other messages with a
    double each."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{topic}.proto", package="theirs", syntax="proto3"
    )
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


def test_topics_of_others_without_numbers_are_passed_over(tmp_path: Path) -> None:
    """A message without fields, and a list of messages, of which no sample has a number."""
    number, point = (b"\x09" + np.float64(x).tobytes() for x in (2.5, 7.0))
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        speed = {"name": "speed", "type": 1, "label": 1}
        logged(writer, "Speed", speed, [number] * 3)
        logged(writer, "Ping", {}, [b""] * 3)
        listed = {"name": "points", "type": 11, "label": 3, "type_name": ".theirs.Point"}
        paths = [(b"\x0a\x09" + point) * k for k in (1, 2, 0)]
        logged(writer, "Path", listed, paths)
        writer.finish()
    (found,), _ = read_mcap(tmp_path / "a.mcap")
    assert found.topic == "/Speed"
    expected = [[2.5]] * 3
    assert found.values.tolist() == expected
