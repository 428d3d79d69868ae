"""Conversion of column titles to the plain names that recordings and tables can store."""

import re
import unicodedata

FIRST_UNDRAWN = 0x530  # Latin, Greek and Cyrillic letters come before
DRAWN_SIGNS = "–—‘’“”•…′″€Ω℃−√∞≤≥ΔΣ"
# Cyrillic letters, each followed by its spelling; a dash stands for none.
CYRILLIC_TEXT = """
    а a б b в v г g д d е e ж zh з z и i к k л l м m н n о o п p р r с s т t у u ф f х kh ц ts ч ch
    ш sh щ shch ъ - ы y ь - э e ю yu я ya є ye і i ґ g
"""
CYRILLIC_WORDS = CYRILLIC_TEXT.split()
CYRILLIC = dict(zip(CYRILLIC_WORDS[::2], CYRILLIC_WORDS[1::2], strict=True))
# Letters that have no plain form of their own in Unicode.
LETTERS = {"\N{DEGREE SIGN}": "deg", "ß": "ss", "æ": "ae", "Æ": "Ae", "ø": "o", "Ø": "O", "ł": "l"}


def plain_name(column: str) -> str:
    """Convert a column title to a name of ASCII letters, digits and underscores. `Motor voltage
    (V)` becomes `Motor_voltage_V`, `ω` becomes `omega`, `Ток` becomes `Tok`."""
    letters = unicodedata.normalize("NFKD", column)
    spelled = "".join(_spell_in_ascii(letter) for letter in letters)
    return re.sub(r"[^0-9A-Za-z]+", "_", spelled).strip("_") or "signal"


def drawable_title(title: str) -> str:
    """Column title for a figure, spelled in ASCII letters if the figure's font lacks its script."""
    is_drawn = all(ord(letter) < FIRST_UNDRAWN or letter in DRAWN_SIGNS for letter in title)
    return title if is_drawn else plain_name(title)


def _spell_in_ascii(letter: str) -> str:
    """Spell a letter outside ASCII in ASCII letters. `ω` -> `omega`, `Ω` -> `Omega`, `°` -> `deg`,
    `ß` -> `ss`; a letter of other scripts by its number, `压` -> `u538b`."""
    if letter.isascii():
        return letter
    if letter in LETTERS:
        return LETTERS[letter]
    if letter.lower() in CYRILLIC:
        spelled = CYRILLIC[letter.lower()].strip("-")
        return spelled if letter.islower() else spelled.capitalize()
    name = re.match(r"GREEK (SMALL|CAPITAL) LETTER (FINAL )?([A-Z]+)", unicodedata.name(letter, ""))
    if name is None:
        return f"u{ord(letter):x}" if letter.isalpha() else letter
    word = name[3].lower()
    return word if name[1] == "SMALL" else word.title()
