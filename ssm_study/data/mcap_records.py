"""Records of an MCAP file, with every checksum verified.

The library's own stream reader takes over twice as long for the recordings of a run: it unpacks
each number of each message by itself, and the index of messages, which nothing here needs.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.opcode import Opcode
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream

from ssm_study.data.whole_files import read_whole_file
from ssm_study.refusal import require

LARGEST = 2**28  # bytes of a recording, unpacked: what a reader may ask of the memory
MESSAGE = int(Opcode.MESSAGE)  # compared with each record's: a plain number is quicker
MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # operation code, length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time
# Records besides messages that say something about a recording, in the file or in its chunks.
KINDS: dict[int, Any] = {
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK: records.Chunk,
    Opcode.DATA_END: records.DataEnd,
    Opcode.FOOTER: records.Footer,
    Opcode.METADATA: records.Metadata,
    Opcode.SCHEMA: records.Schema,
    Opcode.STATISTICS: records.Statistics,
}


def iterate_mcap_records(
    path: Path, with_messages: bool = True, field: str = "path"
) -> Iterator[records.McapRecord]:
    """Iterate over the records of an MCAP file, including those in compressed chunks. Raises
    `BadRequest` about `field` before more than `LARGEST` bytes are read or unpacked."""
    with path.open("rb") as file:
        _require_magic(file.read(len(MAGIC)), 0)
    content = read_whole_file(path, LARGEST, field, "split the recording")
    unpacked = 0
    for start, end, record in _split_records(content, len(MAGIC), with_messages):
        if isinstance(record, records.Chunk):
            unpacked += _unpacked_size(record)
            remedy = "split the recording"
            problem = f"unpacks to more than {LARGEST >> 20} MiB"
            require(unpacked <= LARGEST, field, path, problem, remedy)
            stream, size = get_chunk_data_stream(record, validate_crc=True)
            for _, _, inner in _split_records(stream.read(size), 0, with_messages):
                yield inner
            continue
        if isinstance(record, records.DataEnd):
            _require_checksum(record, content[:start])
        yield record
        if isinstance(record, records.Footer):
            _require_magic(content, end)
            return
    raise EndOfFile()


def _split_records(
    content: bytes, start: int, with_messages: bool
) -> Iterator[tuple[int, int, records.McapRecord]]:
    """Iterate over the records in a byte string, each with its start and its end."""
    while start < len(content):
        code, length = RECORD_HEAD.unpack_from(content, start)
        first = start + RECORD_HEAD.size
        end = first + length
        if end > len(content):
            raise EndOfFile()
        if code == MESSAGE:
            if with_messages:
                channel, sequence, log_time, published = MESSAGE_HEAD.unpack_from(content, first)
                data = content[first + MESSAGE_HEAD.size : end]
                message = records.Message(channel, log_time, data, published, sequence)
                yield start, end, message
        elif code in KINDS:
            body = BytesIO(content[first:end])
            yield start, end, KINDS[code].read(ReadDataStream(body))
        start = end


def _unpacked_size(chunk: records.Chunk) -> int:
    """Size in bytes of a chunk after unpacking: the larger of what the chunk claims and what its
    compressed frame says."""
    if chunk.compression != "zstd":
        return chunk.uncompressed_size
    return max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data))


def _require_magic(content: bytes, start: int) -> None:
    """Raise `InvalidMagic` unless a byte string has the marker of MCAP files at a given
    position."""
    found = content[start : start + len(MAGIC)]
    if found != MAGIC:
        raise InvalidMagic(found)


def _require_checksum(end: records.DataEnd, data_section: bytes) -> None:
    """Raise `CRCValidationError` unless a data section has the checksum that is stored behind
    it."""
    calculated = zlib.crc32(data_section)
    if end.data_section_crc not in (0, calculated):
        raise CRCValidationError(expected=end.data_section_crc, actual=calculated, record=end)
