"""MCAP recordings: one protobuf message per sample, one topic per signal group, log times from the sampling clock."""

from dataclasses import dataclass, field
from pathlib import Path

import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from google.protobuf import descriptor_pb2
from jaxtyping import Float, Shaped

from ssm_study.refusal import require
from ssm_study.signals import Channel

CHUNK_BYTES = 65536  # limits what a crash loses, see the measurements in docs/data.md
METADATA_NAME = "ssm-study"
NANOSECONDS = 1_000_000_000


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
        shape = (len(self.time_s), len(self.channels))
        require(
            self.values.shape == shape, f"{self.topic} (values)", self.values.shape, f"expected {shape}", "match them"
        )
        names = [channel.name for channel in self.channels]
        for name in names:
            require(
                name.isidentifier() and name.isascii() and names.count(name) == 1,
                f"{self.topic} (channel)",
                name,
                "must be a unique identifier of letters, digits and underscores",
                "rename it",
            )
        require(
            bool(np.isfinite(self.time_s).all())
            and bool((np.diff(self.time_s) > 0).all())
            and bool((self.time_s >= 0).all()),
            f"{self.topic} (time_s)",
            self.time_s,
            "times must be finite, increasing and not negative",
            "use the sampling clock",
        )


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
        chunk_size=CHUNK_BYTES,
        calculate_chunk_crcs=True,
        calculate_data_section_crc=True,
        calculate_summary_section_crc=True,
        compression_threads=0,
    )
    context = foxglove.Context()
    with foxglove.open_mcap(temporary, allow_overwrite=True, context=context, writer_options=options) as writer:
        writer.write_metadata(METADATA_NAME, metadata)
        _log(context, groups)
    temporary.replace(path)


def _log(context: foxglove.Context, groups: tuple[SignalGroup, ...]) -> None:
    """All messages in the order of their log times, as players expect."""
    queue: list[tuple[int, int, bytes]] = []
    channels = [_open_channel(context, group) for group in groups]
    for index, group in enumerate(groups):
        times = np.rint(group.time_s * NANOSECONDS).astype(np.int64).tolist()
        queue += [(time, index, message) for time, message in zip(times, _encode(group.values), strict=True)]
    for time, index, message in sorted(queue, key=lambda item: item[:2]):
        channels[index].log(message, log_time=time)


def _open_channel(context: foxglove.Context, group: SignalGroup) -> foxglove.Channel:
    about = {f"unit.{c.name}": c.unit for c in group.channels} | group.metadata
    schema = foxglove.Schema(name=_schema_name(group), encoding="protobuf", data=_descriptor(group))
    return foxglove.Channel(group.topic, schema=schema, message_encoding="protobuf", context=context, metadata=about)


def _schema_name(group: SignalGroup) -> str:
    words = "".join(ch if ch.isalnum() else " " for ch in group.topic).split()
    return "ssm_study." + "".join(word[0].upper() + word[1:] for word in words)


def _descriptor(group: SignalGroup) -> bytes:
    """A file descriptor set with one message of doubles, field numbers in channel order."""
    package, message = _schema_name(group).split(".")
    file = descriptor_pb2.FileDescriptorProto(name=f"{message}.proto", package=package, syntax="proto3")
    fields = file.message_type.add(name=message).field
    for number, channel in enumerate(group.channels, start=1):
        fields.add(
            name=channel.name,
            number=number,
            type=descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
            label=descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL,
        )
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def message_layout(channels: int) -> np.dtype:
    """Each double behind its protobuf tag (`number << 3 | 1` as a varint), so a message is one record of fixed size."""
    parts: list[tuple[str, str]] = []
    for number in range(1, channels + 1):
        parts += [(f"tag_{number}", f"V{len(_tag(number))}"), (f"value_{number}", "<f8")]
    return np.dtype(parts)


def _tag(number: int) -> bytes:
    key, out = number << 3 | 1, b""
    while key > 0x7F:
        out += bytes([key & 0x7F | 0x80])
        key >>= 7
    return out + bytes([key])


def message_template(channels: int) -> Shaped[np.ndarray, "1"]:
    """One message of zeros: the tags in place."""
    layout = message_layout(channels)
    record = np.zeros(1, dtype=layout)
    for number in range(1, channels + 1):
        record[f"tag_{number}"] = np.void(_tag(number))
    return record


def _encode(values: Float[np.ndarray, "T c"]) -> list[bytes]:
    """The protobuf messages of all rows, encoded at once."""
    channels = values.shape[1]
    records = np.repeat(message_template(channels), len(values))
    for number in range(1, channels + 1):
        records[f"value_{number}"] = values[:, number - 1]
    raw, size = records.tobytes(), records.dtype.itemsize
    return [raw[k : k + size] for k in range(0, len(raw), size)]
