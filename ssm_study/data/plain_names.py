"""Conversion of column titles to the plain names that recordings and tables can store."""

import re
import unicodedata

# Letters that have no plain form of their own in Unicode.
LETTERS = {"\N{DEGREE SIGN}": "deg", "ß": "ss", "æ": "ae", "Æ": "Ae", "ø": "o", "Ø": "O", "ł": "l"}


def plain_name(column: str) -> str:
    """Convert a column's title to a name of ASCII letters, digits and underscores. `Motor voltage
    (V)` becomes `Motor_voltage_V`, `ω` becomes `omega`."""
    letters = unicodedata.normalize("NFKD", column)
    spelled = "".join(_spell_in_ascii(letter) for letter in letters)
    return re.sub(r"[^0-9A-Za-z]+", "_", spelled).strip("_") or "signal"


def _spell_in_ascii(letter: str) -> str:
    """Spell a letter in ASCII letters where a spelling is known. `ω` -> `omega`, `Ω` -> `Omega`,
    `°` -> `deg`, `ß` -> `ss`; another letter stays."""
    if letter in LETTERS:
        return LETTERS[letter]
    name = re.match(r"GREEK (SMALL|CAPITAL) LETTER (FINAL )?([A-Z]+)", unicodedata.name(letter, ""))
    if name is None:
        return letter
    word = name[3].lower()
    return word if name[1] == "SMALL" else word.title()
