"""Decoding of text files: which code page their bytes are written in."""

import codecs
from pathlib import Path

from ssm_study.refusal import BadRequest, require

BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"BZh": "bzip2", b"\xfd7zXZ": "xz",
          b"7z\xbc\xaf": "7z", b"Rar!": "rar", b"(\xb5/\xfd": "zstd"}  # fmt: skip
MOSTLY_ZERO = 0.4  # share of every second byte, from which on a text is one of two bytes a letter


def decode_text(path: Path, content: bytes) -> tuple[str, str]:
    """Decode the bytes of a text file, and name the encoding. The text and the name of its
    encoding; refuses bytes that are no text."""
    for mark, encoding in BYTE_ORDER_MARKS:
        if content.startswith(mark):
            try:
                return content.decode(encoding), encoding
            except UnicodeDecodeError as error:
                problem = "has no readable text"
                remedy = "export it as UTF-8 CSV"
                raise BadRequest("data.path", path, problem, remedy) from error
    packed = next((word for mark, word in PACKED.items() if content.startswith(mark)), "")
    require(not packed, "data.path", path, f"is packed ({packed})", "unpack it first")
    content = content.rstrip(b"\0\x1a")  # a logger's unwritten end, and that of old DOS
    encoding = detect_wide_encoding(content)
    if encoding:
        whole = content + b"\0" * (len(content) % 2)
        return whole.decode(encoding, errors="replace"), encoding
    is_text = b"\0" not in content
    problem = "contains NUL bytes, so it is no text"
    require(is_text, "data.path", path, problem, "export it as CSV")
    try:
        return content.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        # Numbers are ASCII; the code page only spells the names.
        return content.decode("cp1252", errors="replace"), "cp1252"


def detect_wide_encoding(content: bytes) -> str:
    """Encoding of a text with two bytes for each letter and no byte order mark; empty for another
    text."""
    halves = {"utf-16-le": content[1::2], "utf-16-be": content[::2]}
    zeros = {name: half.count(0) / max(len(half), 1) for name, half in halves.items()}
    wide = [name for name, share in zeros.items() if share > MOSTLY_ZERO]
    has_rows = content.count(b"\n") > 1
    return wide[0] if len(wide) == 1 and min(zeros.values()) == 0 and has_rows else ""
