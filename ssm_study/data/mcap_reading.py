"""Reading MCAP back to the same numbers: every checksum is verified, so a flipped bit is an error and not a number."""

import json
import struct
import zlib
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from jaxtyping import Float
from mcap import records
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from ssm_study.data.mcap import METADATA_NAME, NANOSECONDS, SignalGroup, message_layout, message_template
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel

# What the MCAP, compression and protobuf libraries were seen to raise on damaged files.
DAMAGE = (McapError, DecodeError, zstandard.ZstdError, zlib.error, struct.error, ValueError, EOFError, RuntimeError,
          KeyError, TypeError, OverflowError, MemoryError)  # fmt: skip


@dataclass
class _Topic:
    channel: records.Channel
    times_ns: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)


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
        raise BadRequest(
            "path", path, f"not a complete MCAP recording ({type(error).__name__}: {error})", "record it again"
        ) from error


def _read(path: Path) -> tuple[tuple[SignalGroup, ...], dict[str, str]]:
    schemas: dict[int, records.Schema] = {}
    topics: dict[int, _Topic] = {}
    metadata: dict[str, str] = {}
    ended, counted, promised = False, 0, None
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True, record_size_limit=path.stat().st_size).records:
            if isinstance(record, records.Message):
                counted += 1
                topics[record.channel_id].times_ns.append(record.log_time)
                topics[record.channel_id].messages.append(record.data)
            elif isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel) and record.id not in topics:
                topics[record.id] = _Topic(record)
            elif isinstance(record, records.Metadata) and record.name == METADATA_NAME:
                metadata |= record.metadata
            elif isinstance(record, records.Statistics):
                promised = record.message_count
            ended |= isinstance(record, records.DataEnd)
    require(ended, "path", path, "the data section has no end", "record it again")
    require(
        promised in (None, counted), "path", path, f"{promised} messages promised, {counted} found", "record it again"
    )
    groups = [_group(topic, schemas.get(topic.channel.schema_id)) for topic in topics.values() if topic.messages]
    numeric = tuple(group for group in groups if group is not None)
    require(len(numeric) > 0, "path", path, "holds no topic with number fields", "record the signals as numbers")
    return numeric, metadata


def _group(topic: _Topic, schema: records.Schema | None) -> SignalGroup | None:
    """The number fields of one topic; None if it has none."""
    if topic.channel.message_encoding == "protobuf" and schema is not None:
        names, values = _protobuf(topic, schema)
    elif topic.channel.message_encoding == "json":
        names, values = _columns([json.loads(message) for message in topic.messages])
    else:
        return None
    if not names:
        return None
    units = topic.channel.metadata
    return SignalGroup(
        topic=topic.channel.topic,
        time_s=np.array(topic.times_ns, dtype=np.int64) / NANOSECONDS,
        channels=tuple(Channel(name=name, unit=units.get(f"unit.{name}", "")) for name in names),
        values=values,
        metadata={k: v for k, v in units.items() if not k.startswith("unit.")},
    )


def _protobuf(topic: _Topic, schema: records.Schema) -> tuple[list[str], Float[np.ndarray, "T c"]]:
    decode = DecoderFactory().decoder_for("protobuf", schema)
    if decode is None:
        return [], np.empty((len(topic.messages), 0))
    names = [f.name for f in decode(topic.messages[0]).DESCRIPTOR.fields]
    layout = message_layout(len(names))
    if {len(message) for message in topic.messages} == {layout.itemsize}:
        rows = np.frombuffer(b"".join(topic.messages), dtype=layout)
        if _only_doubles(rows, len(names)):
            return names, np.stack([rows[f"value_{k + 1}"] for k in range(len(names))], axis=1)
    return _columns([{name: getattr(message, name) for name in names} for message in map(decode, topic.messages)])


def _only_doubles(rows: np.ndarray, channels: int) -> bool:
    """Whether every message is laid out as this project writes it: tags 1..c in order, a double behind each."""
    wanted = message_template(channels)
    return all((rows[f"tag_{k}"] == wanted[f"tag_{k}"]).all() for k in range(1, channels + 1))


def _columns(messages: list[dict[str, Any]]) -> tuple[list[str], Float[np.ndarray, "T c"]]:
    """Fields that are a number in the first message, and must be in all others."""
    require(all(isinstance(m, dict) for m in messages), "path", "message", "not an object with fields", "log fields")
    names = [name for name, value in messages[0].items() if isinstance(value, Real) and not isinstance(value, bool)]
    for k, message in enumerate(messages):
        for name in names:
            require(
                isinstance(message.get(name), Real),
                name,
                message.get(name),
                f"no number in message {k}",
                "log a number",
            )
    return names, np.array([[float(m[name]) for name in names] for m in messages]).reshape(len(messages), len(names))
