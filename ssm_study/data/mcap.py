"""MCAP recordings with one protobuf message per sample and topic, and times from the sampling
clock.

Groups below one name on one clock share a topic: `/case_0/input` and `/case_0/output` are the
fields `input` and `output` of `/case_0`. A message takes 16 bytes of index and a head, so this
halves a recording and its time to write. Read back to the same groups and numbers: every checksum
is verified, so a flipped bit is an error and not a number.
"""

import json
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial, reduce
from io import BytesIO
from numbers import Real
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import zstandard
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from google.protobuf import descriptor_pb2
from google.protobuf.internal.encoder import TagBytes, _VarintBytes
from google.protobuf.message import DecodeError
from jaxtyping import Float, Int, UInt8
from mcap import records
from mcap.exceptions import McapError
from mcap_protobuf.decoder import DecoderFactory

from ssm_study.data.mcap_records import iterate_mcap_records
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel

CHUNK_BYTES = 65536  # limits what a crash loses
METADATA_NAME = "ssm-study"
NANOSECONDS = 1_000_000_000
Names = tuple[str, ...]  # of a field: its own, after that of the message it is in
DOUBLE = 1
WITHIN = 2  # the wire types of eight bytes and of a message within
# What the MCAP, compression and protobuf libraries were seen to raise on damaged files.
DAMAGE = (McapError, DecodeError, zstandard.ZstdError, zlib.error, struct.error, ValueError,
          EOFError, RuntimeError,
          KeyError, TypeError, OverflowError, MemoryError)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SignalGroup:
    """Signals of an MCAP recording that have common sampling times and are stored as one topic.
    `values (T, c)` of the `channels`, at `time_s (T,)`, under a topic such as `/output`.

    Times are kept to the nanosecond. Channel names must be identifiers, for they become protobuf
    fields.
    """

    topic: str
    time_s: Float[np.ndarray, "T"]
    channels: tuple[Channel, ...]
    values: Float[np.ndarray, "T c"]

    def __post_init__(self) -> None:
        expected = (len(self.time_s), len(self.channels))
        shape = self.values.shape
        problem = f"expected {expected}"
        remedy = "give values of that shape"
        require(shape == expected, f"{self.topic} (values)", shape, problem, remedy)
        names = [channel.name for channel in self.channels]
        problem = "must be a unique identifier of letters, digits and underscores"
        for name in names:
            is_identifier = name.isidentifier() and name.isascii()
            is_allowed = is_identifier and names.count(name) == 1
            remedy = "rename it"
            require(is_allowed, f"{self.topic} (channel)", name, problem, remedy)
        times = self.time_s
        problem = "times must be finite, increasing and not negative"
        is_finite = np.isfinite(times).all()
        increases = (np.diff(times) > 0).all()
        is_clock = is_finite and increases and (times >= 0).all()
        remedy = "use the sampling clock"
        require(bool(is_clock), f"{self.topic} (time_s)", times, problem, remedy)


def write_mcap(path: Path, groups: tuple[SignalGroup, ...], metadata: dict[str, str]) -> None:
    """Write groups of signals and metadata to a new MCAP file, which never exists half-written
    under its name.

    Foxglove shows topics with schemas, `/output.speed` or `/case_0.output.speed`; units stand in
    the channel metadata as `unit.<signal>` or `unit.<group>.<signal>`, the file's own `metadata`
    (plant, seed, ...) in a metadata record. Raises `BadRequest` for two groups on one topic.
    """
    topics = [group.topic for group in groups]
    problem = "two groups share a topic"
    remedy = "give each group its own topic"
    is_unique = len(set(topics)) == len(topics)
    require(is_unique, "topics", topics, problem, remedy)
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
    written = (
        BytesIO()
    )  # on a full disk Foxglove prints a line a message and its error does not say what it met
    with foxglove.open_mcap(written, context=context, writer_options=options) as writer:
        writer.write_metadata(METADATA_NAME, metadata)
        shared = _merge_topics(groups)
        channels = [_open_channel(context, topic, parts) for topic, parts in shared.items()]
        for index, parts in enumerate(shared.values()):
            nanoseconds = np.rint(parts[0].time_s * NANOSECONDS)
            times = nanoseconds.astype(np.int64).tolist()
            rows = zip(times, _encode_rows(parts), strict=True)
            queue += [(time, index, message) for time, message in rows]
        queue.sort(key=lambda item: item[:2])  # by log time, as players expect
        for time, index, message in queue:
            channels[index].log(message, log_time=time)
    temporary.write_bytes(written.getbuffer())
    temporary.replace(path)


def _merge_topics(groups: tuple[SignalGroup, ...]) -> dict[str, list[SignalGroup]]:
    """Merge MCAP topics that have the same parent name and the same times into one topic."""
    below: dict[str, list[SignalGroup]] = defaultdict(list)
    for group in groups:
        parent, _, _ = group.topic.rpartition("/")
        below[parent].append(group)
    topics: dict[str, list[SignalGroup]] = {}
    for parent, parts in below.items():
        names = [part.topic.rpartition("/")[2] for part in parts]
        is_named = all(name.isidentifier() for name in names)
        first_times = parts[0].time_s
        has_one_clock = all(np.array_equal(part.time_s, first_times) for part in parts)
        together = len(parts) > 1 and is_named and has_one_clock
        is_taken = any(group.topic == parent for group in groups)
        if parent == "" or not together or is_taken:
            topics |= {part.topic: [part] for part in parts}
        else:
            topics[parent] = parts
    return topics


def _open_channel(
    context: foxglove.Context, topic: str, parts: list[SignalGroup]
) -> foxglove.Channel:
    """Open an MCAP channel whose messages are protobuf messages of doubles. Field numbers follow
    the order of the signals."""
    spaced = re.sub(r"[\W_]", " ", topic)
    capitalised = [word[0].upper() + word[1:] for word in spaced.split()]
    message = "".join(capitalised)
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{message}.proto", package="ssm_study", syntax="proto3"
    )
    whole = file.message_type.add(name=message)
    kind = descriptor_pb2.FieldDescriptorProto
    about = {}
    for number, part in enumerate(parts, start=1):
        fields = whole.field
        prefix = "unit."
        if part.topic != topic:
            name = part.topic.rpartition("/")[2]
            inner = f"Part{number}"  # protobufjs: no type is called like a field
            of = {
                "number": number,
                "type": kind.TYPE_MESSAGE,
                "type_name": f".ssm_study.{message}.{inner}",
            }
            whole.field.add(name=name, label=kind.LABEL_OPTIONAL, **of)
            fields = whole.nested_type.add(name=inner).field
            prefix = f"unit.{name}."
        for order, channel in enumerate(part.channels, start=1):
            label = kind.LABEL_OPTIONAL
            fields.add(name=channel.name, number=order, type=kind.TYPE_DOUBLE, label=label)
            about[prefix + channel.name] = channel.unit
    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    schema = foxglove.Schema(name=f"ssm_study.{message}", encoding="protobuf", data=data)
    return foxglove.Channel(
        topic, schema=schema, message_encoding="protobuf", context=context, metadata=about
    )


def protobuf_layout(
    counts: list[int], is_nested: bool
) -> tuple[UInt8[np.ndarray, "b"], Int[np.ndarray, "k"]]:
    """Byte layout of a protobuf message of doubles: the message without values, and the byte
    positions of each double."""
    message = b""
    at = list[int]()
    for number, channels in enumerate(counts, start=1):
        tags = [TagBytes(order, DOUBLE) for order in range(1, channels + 1)]
        if is_nested:
            size = sum(map(len, tags)) + 8 * channels
            message += TagBytes(number, WITHIN) + _VarintBytes(size)
        for tag in tags:
            message += tag
            at += range(len(message), len(message) + 8)
            message += bytes(8)
    return np.frombuffer(message, np.uint8), np.array(at, dtype=np.int64)


def _encode_rows(parts: list[SignalGroup]) -> list[bytes]:
    """Encode the samples of several signals as protobuf messages, one message per sampling time."""
    values = np.hstack([part.values for part in parts])
    counts = [len(part.channels) for part in parts]
    message, at = protobuf_layout(counts, is_nested=len(parts) > 1)
    rows = np.tile(message, (len(values), 1))
    doubles = np.ascontiguousarray(values, dtype="<f8")
    rows[:, at] = doubles.view(np.uint8)
    whole = rows.tobytes()
    size = len(message)
    return [whole[k : k + size] for k in range(0, len(whole), size)]


def read_mcap(path: Path, field: str = "path") -> tuple[tuple[SignalGroup, ...], dict[str, str]]:
    """Read the groups of signals and the metadata of an MCAP recording.

    Raises `BadRequest` for a file that is missing, truncated, damaged or too large, or that holds
    no numbers; `field` is the setting that names the file.
    """
    remedy = "check the spelling"
    require(path.is_file(), field, path, "no such file", remedy)
    try:
        return _read_groups(path, field)
    except BadRequest:
        raise
    except DAMAGE as error:
        problem = f"not a complete MCAP recording ({type(error).__name__}: {error})"
        remedy = "record it again"
        raise BadRequest(field, path, problem, remedy) from error


def _read_groups(path: Path, field: str) -> tuple[tuple[SignalGroup, ...], dict[str, str]]:
    """Read the groups of signals and the metadata of an MCAP file, after checking that the file is
    complete."""
    records_by_type: dict[type, list[Any]] = defaultdict(list)
    for record in iterate_mcap_records(path, field=field):
        records_by_type[type(record)].append(record)
    schemas = {schema.id: schema for schema in records_by_type[records.Schema]}
    channels = {channel.id: channel for channel in records_by_type[records.Channel]}
    messages: dict[int, list[records.Message]] = {number: [] for number in channels}
    for message in records_by_type[records.Message]:
        messages[message.channel_id].append(message)
    metadata = dict[str, str]()
    for record in records_by_type[records.Metadata]:
        if record.name == METADATA_NAME:
            metadata |= record.metadata
    remedy = "record it again"
    ends = records_by_type[records.DataEnd]
    require(ends, field, path, "the data section has no end", remedy)
    counted = len(records_by_type[records.Message])
    promised = {one.message_count for one in records_by_type[records.Statistics]}
    problem = f"{max(promised, default=0)} messages are announced, and {counted} were found"
    remedy = "record it again"
    require(promised <= {counted}, field, path, problem, remedy)
    groups: list[SignalGroup] = []
    for number, channel in channels.items():
        if messages[number]:
            groups += _decode_groups(channel, messages[number], schemas.get(channel.schema_id))
    numeric = tuple(groups)
    remedy = "record the signals as numbers"
    require(len(numeric) > 0, field, path, "holds no topic with number fields", remedy)
    return numeric, metadata


def _decode_groups(
    channel: records.Channel, messages: list[records.Message], schema: records.Schema | None
) -> Iterator[SignalGroup]:
    """Decode the messages of one MCAP topic to groups of signals."""
    contents = [message.data for message in messages]
    decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
    names: list[Names] = []
    if decode is not None:
        names, values = _decode_protobuf(decode, contents)
    elif channel.message_encoding == "json":
        objects = [_require_fields(json.loads(content)) for content in contents]
        fields: list[dict[Names, Any]] = []
        for one in objects:
            fields.append({(name,): value for name, value in one.items()})
        names, values = collect_number_columns(fields)
    for part in dict.fromkeys(name[:-1] for name in names):
        at = [k for k, name in enumerate(names) if name[:-1] == part]
        units = [channel.metadata.get(f"unit.{'.'.join(names[k])}", "") for k in at]
        topic = "/".join((channel.topic, *part))
        log_times = [message.log_time for message in messages]
        nanoseconds = np.array(log_times, dtype=np.int64)
        channels = []
        for k, unit in zip(at, units, strict=True):
            *_, name = names[k]
            channels.append(Channel(name=name, unit=unit))
        yield SignalGroup(
            topic=topic,
            time_s=nanoseconds / NANOSECONDS,
            channels=tuple(channels),
            values=values[:, at],
        )


def _require_fields(message: Any) -> dict[str, Any]:
    """Raise `BadRequest` for a JSON message that is not an object with named fields."""
    problem = "not an object with fields"
    remedy = "log each message as an object with named fields"
    require(isinstance(message, dict), "path", "message", problem, remedy)
    return dict(message)


def _decode_protobuf(
    decode: Any, contents: list[bytes]
) -> tuple[list[Names], Float[np.ndarray, "T c"]]:
    """Decode the protobuf messages of an MCAP topic to columns of numbers. All rows are decoded at
    once if this project wrote them, otherwise one by one."""
    fields = decode(contents[0]).DESCRIPTOR.fields
    nested = all(one.message_type is not None for one in fields)
    parts = [list(fields)]
    prefixes: list[Names] = [()]
    if nested:
        parts = [list(one.message_type.fields) for one in fields]
        prefixes = [(one.name,) for one in fields]
    names: list[Names] = []
    for prefix, part in zip(prefixes, parts, strict=True):
        names += [(*prefix, one.name) for one in part]
    message, at = protobuf_layout([len(part) for part in parts], nested)
    doubles = names and all(one.type == one.TYPE_DOUBLE for part in parts for one in part)
    if doubles and {len(content) for content in contents} == {len(message)}:
        whole = np.frombuffer(b"".join(contents), np.uint8)
        rows = whole.reshape(len(contents), -1)
        other_bytes = np.delete(rows, at, axis=1)
        is_own = other_bytes == np.delete(message, at)
        if is_own.all():
            number_bytes = np.ascontiguousarray(rows[:, at])
            numbers = number_bytes.view("<f8")
            return names, numbers.astype(np.float64)
    # A field that repeats, such as a list of points, has none of the fields of its messages: no
    # number.
    value = partial(reduce, lambda whole, field: getattr(whole, field, None))
    messages = [{name: value(name, one) for name in names} for one in map(decode, contents)]
    return collect_number_columns(messages)


def collect_number_columns(
    messages: list[dict[Names, Any]],
) -> tuple[list[Names], Float[np.ndarray, "T c"]]:
    """Collect the numeric fields of a sequence of messages as columns. A field that is a number in
    the first message must be one in all others."""
    first = messages[0].items()
    real = [(name, value) for name, value in first if isinstance(value, Real)]
    names = [name for name, value in real if not isinstance(value, bool)]
    for k, message in enumerate(messages):
        for name in names:
            value = message.get(name)
            problem = f"no number in message {k}"
            remedy = "log a number"
            require(isinstance(value, Real), ".".join(name), value, problem, remedy)
    rows = []
    for message in messages:
        rows.append([float(message[name]) for name in names])
    shape = (len(messages), len(names))
    numbers = np.array(rows).reshape(shape)
    return names, numbers
