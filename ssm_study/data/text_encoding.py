"""Decoding of text files: which code page their bytes are written in."""

import codecs
import re
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

FOREIGN_WORD = re.compile(rb"[\x80-\xff]{3,}")  # European words have no three accents in a row
FIRST_BYTES = 2**16  # of a text, in which its foreign words are looked for
CYRILLIC = re.compile("[А-Яа-яЁёІіЇїЄєҐґЎў]+")
GB_FIRST = 0xA1  # lowest byte of a pair
GB_MARKS = range(0xA1, 0xAA)  # lead bytes of marks and letters
GB_CHARACTERS = range(0xB0, 0xF8)
GB_FREQUENT = range(0xB0, 0xD8)
GB_MOSTLY = 0.75
KOREAN_SYLLABLES = range(0xB0, 0xC9)


def decode_text(path: Path, content: bytes) -> tuple[str, str]:
    """Decode the bytes of a text file, and name the encoding that was detected. Raises `BadRequest`
    for bytes that are no text."""
    for mark, encoding in BYTE_ORDER_MARKS:
        if content.startswith(mark):
            try:
                return content.decode(encoding), encoding
            except UnicodeDecodeError as error:
                problem = "has no readable text"
                remedy = "export it as UTF-8 CSV"
                raise BadRequest("data.path", path, problem, remedy) from error
    for mark, packer in PACKED.items():
        is_packed = content.startswith(mark)
        require(not is_packed, "data.path", path, f"is packed ({packer})", "unpack it first")
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
        page = detect_code_page(content)
        return content.decode(page, errors="replace"), page


def detect_code_page(content: bytes) -> str:
    """Detect the code page of a text that is not UTF-8, as the one in which its non-ASCII words are
    plausible.

    Western European where there are no such words, or where two pages fit. Detectors that count
    letters need more text than the names of a few columns (`docs/data.md`).
    """
    words = FOREIGN_WORD.findall(content[:FIRST_BYTES])
    readings = {
        "cp1251": all(is_cyrillic_word(word, "cp1251") for word in words),
        "cp866": all(is_cyrillic_word(word, "cp866") for word in words),
        "gb18030": are_chinese_words(words) and not can_be_korean_words(words),
    }
    pages = [page for page, fits in readings.items() if fits]
    return pages[0] if words and len(pages) == 1 else "cp1252"


def is_cyrillic_word(word: bytes, page: str) -> bool:
    """Whether bytes are a Cyrillic word in a given code page, with plausible upper and lower
    case."""
    text = word.decode(page, errors="replace")
    tail = text[1:]
    is_natural = tail in (tail.lower(), tail.upper())
    return bool(CYRILLIC.fullmatch(text)) and is_natural


def are_chinese_words(words: list[bytes]) -> bool:
    """Whether byte pairs are Chinese characters in the encoding GB2312, most of them frequent
    ones."""
    leads = b"".join(word[::2] for word in words)
    trails = b"".join(word[1::2] for word in words)
    is_even = all(len(word) % 2 == 0 for word in words)
    is_paired = is_even and min(trails, default=0) >= GB_FIRST
    is_known = all(lead in GB_MARKS or lead in GB_CHARACTERS for lead in leads)
    frequent = sum(lead in GB_FREQUENT for lead in leads)
    return is_paired and is_known and frequent >= GB_MOSTLY * len(leads)


def can_be_korean_words(words: list[bytes]) -> bool:
    """Whether byte pairs could be Korean syllables in the encoding EUC-KR."""
    return all(lead in KOREAN_SYLLABLES for word in words for lead in word[::2])


def detect_wide_encoding(content: bytes) -> str:
    """Detect the encoding of a text with two bytes per letter and no byte order mark; empty for any
    other text."""
    halves = {"utf-16-le": content[1::2], "utf-16-be": content[::2]}
    zero_shares = {}
    for name, half in halves.items():
        zero_shares[name] = half.count(0) / max(len(half), 1)
    wide = [name for name, share in zero_shares.items() if share > MOSTLY_ZERO]
    has_rows = content.count(b"\n") > 1
    has_full_half = min(zero_shares.values()) == 0
    is_wide = len(wide) == 1 and has_full_half
    return wide[0] if is_wide and has_rows else ""
