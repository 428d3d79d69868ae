"""MCAP recordings: one protobuf message per sample, one topic per signal group, log times from the sampling clock.

Read back to the same numbers: every checksum is verified, so a flipped bit is an error and not a number.
"""

import json
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from numbers import Real
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import zstandard
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from google.protobuf import descriptor_pb2
from google.protobuf.internal.encoder import TagBytes
from google.protobuf.message import DecodeError
from jaxtyping import Float, Int, UInt8
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap_protobuf.decoder import DecoderFactory

from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel

CHUNK_BYTES = 65536  # limits what a crash loses, see the measurements in docs/data.md
METADATA_NAME = "ssm-study"
NANOSECONDS = 1_000_000_000
LARGEST = 2**28  # bytes of a recording, unpacked: what a reader may ask of the memory
RECORD = struct.Struct("<BQ")  # head of a record: kind and size
HEAD = np.dtype(
    [("kind", "u1"), ("size", "<u8"), ("channel", "<u2"), ("number", "<u4"), ("logged", "<u8"), ("at", "<u8")]
)
Messages = tuple[int, Int[np.ndarray, "_"], list[bytes]]  # of a channel, in order: log times in ns, contents
DOUBLE = 1  # the wire type of eight bytes
# What the MCAP, compression and protobuf libraries were seen to raise on damaged files.
DAMAGE = (McapError, DecodeError, zstandard.ZstdError, zlib.error, struct.error, ValueError, EOFError, RuntimeError,
          KeyError, TypeError, OverflowError, MemoryError)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SignalGroup:
    """Signals sampled together: `values (T, c)` of the `channels`, at `time_s (T,)`, under one topic such as `/output`.

    Times are kept to the nanosecond. Channel names must be identifiers, for they become protobuf fields.
    """

    topic: str
    time_s: Float[np.ndarray, "T"]
    channels: tuple[Channel, ...]
    values: Float[np.ndarray, "T c"]
    metadata: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape, found = (len(self.time_s), len(self.channels)), self.values.shape
        require(found == shape, f"{self.topic} (values)", found, f"expected {shape}", "match them")
        names = [channel.name for channel in self.channels]
        problem = "must be a unique identifier of letters, digits and underscores"
        for name in names:
            good = name.isidentifier() and name.isascii() and names.count(name) == 1
            require(good, f"{self.topic} (channel)", name, problem, "rename it")
        times, problem = self.time_s, "times must be finite, increasing and not negative"
        clock = np.isfinite(times).all() and (np.diff(times) > 0).all() and (times >= 0).all()
        require(bool(clock), f"{self.topic} (time_s)", times, problem, "use the sampling clock")


def write_mcap(path: Path, groups: tuple[SignalGroup, ...], metadata: dict[str, str]) -> None:
    """Write the groups to a new file at `path`, beside it first and moved there when complete.

    Foxglove shows each group as a topic with a schema; units stand in the channel metadata as `unit.<signal>`, the
    file's own `metadata` (plant, seed, ...) in a metadata record. Raises `BadRequest` for two groups on one topic.
    """
    topics = [group.topic for group in groups]
    require(len(set(topics)) == len(topics), "topics", topics, "two groups share a topic", "name them apart")
    temporary = path.with_name(f".{path.name}.part")
    options = MCAPWriteOptions(
        compression=MCAPCompression.Zstd,
        compression_threads=0,
        chunk_size=CHUNK_BYTES,
        calculate_chunk_crcs=True,
        calculate_data_section_crc=True,
        calculate_summary_section_crc=True,
    )
    context = foxglove.Context()
    queue: list[tuple[int, int, bytes]] = []
    with foxglove.open_mcap(temporary, allow_overwrite=True, context=context, writer_options=options) as writer:
        writer.write_metadata(METADATA_NAME, metadata)
        channels = [_open_channel(context, group) for group in groups]
        for index, group in enumerate(groups):
            times = np.rint(group.time_s * NANOSECONDS).astype(np.int64).tolist()
            queue += [(time, index, message) for time, message in zip(times, _encoded(group.values), strict=True)]
        for time, index, message in sorted(queue, key=lambda item: item[:2]):  # by log time, as players expect
            channels[index].log(message, log_time=time)
    temporary.replace(path)


def _open_channel(context: foxglove.Context, group: SignalGroup) -> foxglove.Channel:
    """A topic whose schema is one message of doubles, field numbers in channel order."""
    words = "".join(ch if ch.isalnum() else " " for ch in group.topic).split()
    message = "".join(word[0].upper() + word[1:] for word in words)
    file = descriptor_pb2.FileDescriptorProto(name=f"{message}.proto", package="ssm_study", syntax="proto3")
    fields, kind = file.message_type.add(name=message).field, descriptor_pb2.FieldDescriptorProto
    for number, channel in enumerate(group.channels, start=1):
        fields.add(name=channel.name, number=number, type=kind.TYPE_DOUBLE, label=kind.LABEL_OPTIONAL)
    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    schema = foxglove.Schema(name=f"ssm_study.{message}", encoding="protobuf", data=data)
    about = {f"unit.{c.name}": c.unit for c in group.channels} | group.metadata
    return foxglove.Channel(group.topic, schema=schema, message_encoding="protobuf", context=context, metadata=about)


def _layout(channels: int) -> tuple[UInt8[np.ndarray, "b"], Int[np.ndarray, "k"]]:
    """A message of zeros, each double behind its tag, and where the bytes of the doubles lie: of a fixed size."""
    message, at = b"", list[int]()
    for number in range(1, channels + 1):
        message += TagBytes(number, DOUBLE)
        at += range(len(message), len(message) + 8)
        message += bytes(8)
    return np.frombuffer(message, np.uint8), np.array(at)


def _encoded(values: Float[np.ndarray, "T c"]) -> list[bytes]:
    """The protobuf messages of all rows, encoded at once."""
    message, at = _layout(values.shape[1])
    rows = np.tile(message, (len(values), 1))
    rows[:, at] = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
    whole, size = rows.tobytes(), len(message)
    return [whole[k : k + size] for k in range(0, len(whole), size)]


def read_mcap(path: Path) -> tuple[tuple[SignalGroup, ...], dict[str, str]]:
    """The signal groups of a recording (topics of protobuf or JSON messages, their number fields) and its metadata.

    Raises `BadRequest` for a file that is missing, truncated or damaged, or that holds no numbers.
    """
    require(path.is_file(), "path", path, "no such file", "check the spelling")
    try:
        return _read(path)
    except BadRequest:
        raise
    except DAMAGE as error:
        problem = f"not a complete MCAP recording ({type(error).__name__}: {error})"
        raise BadRequest("path", path, problem, "record it again") from error


def _read(path: Path) -> tuple[tuple[SignalGroup, ...], dict[str, str]]:
    found: dict[type, list[Any]] = defaultdict(list)
    for record in _records(path):
        found[type(record)].append(record)
    schemas = {schema.id: schema for schema in found[records.Schema]}
    topics: dict[int, tuple[records.Channel, list[Messages]]] = {one.id: (one, []) for one in found[records.Channel]}
    for messages in found[tuple]:
        topics[messages[0]][1].append(messages)
    own = [record.metadata for record in found[records.Metadata] if record.name == METADATA_NAME]
    metadata = {key: value for one in own for key, value in one.items()}
    require(found[records.DataEnd], "path", path, "the data section has no end", "record it again")
    counted, promised = (
        sum(len(one[2]) for one in found[tuple]),
        {one.message_count for one in found[records.Statistics]},
    )
    problem = f"{max(promised, default=0)} messages promised, {counted} found"
    require(promised <= {counted}, "path", path, problem, "record it again")
    groups = [_group(*topic, schemas.get(topic[0].schema_id)) for topic in topics.values() if topic[1]]
    numeric = tuple(group for group in groups if group is not None)
    require(len(numeric) > 0, "path", path, "holds no topic with number fields", "record the signals as numbers")
    return numeric, metadata


class _Sequential(StreamReader):
    """Passes over the index of messages, which only a player needs."""

    def _read_record(self, opcode: int, length: int) -> records.McapRecord | None:
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


def _records(path: Path) -> Iterator[records.McapRecord | Messages]:
    """Of the file and of its chunks, messages together; `BadRequest` before more than `LARGEST` bytes are unpacked."""
    unpacked = 0
    with path.open("rb") as stream:
        reader = _Sequential(stream, emit_chunks=True, validate_crcs=True, record_size_limit=path.stat().st_size)
        for record in reader.records:
            if isinstance(record, records.Message):
                yield record.channel_id, np.array([record.log_time]), [record.data]
            elif not isinstance(record, records.Chunk):
                yield record
            if not isinstance(record, records.Chunk):
                continue
            packed = record.compression == "zstd"  # its frame says how much it unpacks to, whatever the chunk claims
            unpacked += max(record.uncompressed_size, zstandard.frame_content_size(record.data) if packed else 0)
            remedy = "split the recording"
            require(unpacked <= LARGEST, "path", path, f"unpacks to more than {LARGEST >> 20} MiB", remedy)
            yield from _unpacked(record)


def _unpacked(chunk: records.Chunk) -> Iterator[records.McapRecord | Messages]:
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    data, start = stream.read(length), 0
    messages: list[tuple[int, int]] = []
    while start < length:  # the library takes each message field by field, which is twenty times slower
        opcode, size = RECORD.unpack_from(data, start)
        end = start + RECORD.size + size
        if opcode == Opcode.MESSAGE:
            messages.append((start, end))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = records.Schema if opcode == Opcode.SCHEMA else records.Channel
            yield kind.read(ReadDataStream(BytesIO(data[start + RECORD.size : end])))
        start = end
    if start > length or any(end - start < HEAD.itemsize for start, end in messages):
        raise ValueError("a record is longer than its chunk, or a message shorter than its head")
    heads = np.frombuffer(b"".join([data[start : start + HEAD.itemsize] for start, _ in messages]), HEAD)
    for channel in np.unique(heads["channel"]):
        of_it = np.flatnonzero(heads["channel"] == channel)
        contents = [data[messages[k][0] + HEAD.itemsize : messages[k][1]] for k in of_it.tolist()]
        yield int(channel), heads["logged"][of_it].astype(np.int64), contents


def _group(channel: records.Channel, messages: list[Messages], schema: records.Schema | None) -> SignalGroup | None:
    """The number fields of one topic; None if it has none."""
    contents = [content for _, _, some in messages for content in some]
    decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
    names: list[str] = []
    if decode is not None:
        names, values = _protobuf(decode, contents)
    elif channel.message_encoding == "json":
        names, values = _columns([json.loads(content) for content in contents])
    if not names:
        return None
    return SignalGroup(
        topic=channel.topic,
        time_s=np.concatenate([times for _, times, _ in messages]) / NANOSECONDS,
        channels=tuple(Channel(name=name, unit=channel.metadata.get(f"unit.{name}", "")) for name in names),
        values=values,
        metadata={k: v for k, v in channel.metadata.items() if not k.startswith("unit.")},
    )


def _protobuf(decode: Any, contents: list[bytes]) -> tuple[list[str], Float[np.ndarray, "T c"]]:
    """All rows at once where every message is laid out as this project writes it, one by one otherwise."""
    names = [f.name for f in decode(contents[0]).DESCRIPTOR.fields]
    message, at = _layout(len(names))
    if {len(content) for content in contents} == {len(message)}:
        rows = np.frombuffer(b"".join(contents), np.uint8).reshape(len(contents), -1)
        if (np.delete(rows, at, axis=1) == np.delete(message, at)).all():
            return names, np.ascontiguousarray(rows[:, at]).view("<f8").astype(np.float64)
    return _columns([{name: getattr(one, name) for name in names} for one in map(decode, contents)])


def _columns(messages: list[dict[str, Any]]) -> tuple[list[str], Float[np.ndarray, "T c"]]:
    """Fields that are a number in the first message, and must be in all others."""
    require(all(isinstance(m, dict) for m in messages), "path", "message", "not an object with fields", "log fields")
    names = [name for name, value in messages[0].items() if isinstance(value, Real) and not isinstance(value, bool)]
    for k, message in enumerate(messages):
        for name in names:
            value = message.get(name)
            require(isinstance(value, Real), name, value, f"no number in message {k}", "log a number")
    return names, np.array([[float(m[name]) for name in names] for m in messages]).reshape(len(messages), len(names))
