"""Guess at which columns of a log are input and output, by their titles and by their levels."""

import re
import unicodedata
from collections.abc import Sequence

from ssm_study.data.column_facts import ColumnFacts
from ssm_study.data.written_numbers import AMBIGUOUS

HOLDS_COUNT = 0.4  # weight, against a word of the name, of how long a column holds its levels
FEW_LEVELS_COUNT = 0.2  # the same of how few levels it has
LIKE_AN_INPUT = 0.55  # score by levels of a column that holds few of them nearly always
STEADY_COUNTS = 0.3  # the same, against an input, of a column that hardly moves from its mean
# Reasons why a column of numbers was skipped; a column of other texts has none of them.
HAS_NUMBERS = re.compile(rf" in line \d+: |{AMBIGUOUS}")
WORD_STARTS = r"(?<=[a-z]{2})(?=[A-Z][a-z])|(?<=\b[uy])(?=[A-Z])"  # leftSpeed, yTi
STEADY = 0.1  # range over the largest magnitude, below which a column hardly moves
INPUT_WORDS_TEXT = """
    u in input command cmd pwm duty valve heater voltage power signal inputsignal servo
    torque force rudder flow current us setting inputdata throttle pump ph q
"""
INPUT_WORDS = tuple(INPUT_WORDS_TEXT.split())
OUTPUT_WORDS_TEXT = """
    y t out output speed temperature temp position level angle rate rpm velocity encoder
    enconder pos measured ti pressure height outputdata acidity
"""
OUTPUT_WORDS = tuple(OUTPUT_WORDS_TEXT.split())
# Of what the weather does: such a column is measured and neither commanded nor controlled.
SURROUNDINGS_WORDS_TEXT = """
    outdoor outdoors outside ambient surroundings weather aussen draussen umgebung wetter
    exterieur exterior esterna
"""
SURROUNDINGS_WORDS = tuple(SURROUNDINGS_WORDS_TEXT.split())
ACIDITY = re.compile(r"(?<![A-Za-z])pH(?![a-z])")  # `Ph` is a power in other logs
SET_POINT_WORDS_TEXT = """
    sp setpoint set ref reference target desired wanted r tsp soll sollwert goal demand
"""
SET_POINT_WORDS = tuple(SET_POINT_WORDS_TEXT.split())


def guess_input_and_output(
    facts: Sequence[ColumnFacts], clock: str | None
) -> tuple[str | None, str | None]:
    """Guess which columns of a log are the input and the output, from words in their titles and
    their numbers of distinct values."""
    moving = [column for column in facts if column.name != clock and column.levels > 1]
    if len(moving) < 2:
        return None, None
    free = [column for column in moving if not is_set_point_title(column.name)]
    moving = free if len(free) > 1 else moving
    u = max(moving, key=input_score)
    others = [column for column in moving if column is not u]
    y = max(others, key=lambda column: output_score(column, u.name))
    return u.name, y.name


def output_score(column: ColumnFacts, input_name: str) -> tuple[float, bool, bool]:
    """Score of how much a column looks like the output: by its title, a word shared with the
    input's title, and the number of distinct values."""
    by_words = title_word_score(column.name, OUTPUT_WORDS)
    is_input_title = by_words < title_word_score(column.name, INPUT_WORDS)
    if is_input_title or title_word_score(column.name, SURROUNDINGS_WORDS):
        by_words = -1.0
    has_same_place = not distinguishing_words(input_name).isdisjoint(
        distinguishing_words(column.name)
    )
    return by_words, has_same_place, level_score(column) < LIKE_AN_INPUT


def distinguishing_words(name: str) -> set[str]:
    """Numbers and words in a column title that distinguish similar signals, such as 2 in `Heater
    2`."""
    numbers = re.findall(r"[A-Za-z]\W?(\d+)\b", name)
    own_words = [
        word
        for word in title_words_without_digits(name)
        if word not in (*INPUT_WORDS, *OUTPUT_WORDS)
    ]
    return {*numbers, *(word for word in own_words if len(word) > 1)}


def title_words_without_digits(name: str) -> list[str]:
    """Words in a column title, in lower case, without accents and with all digits removed."""
    spaced = re.sub(WORD_STARTS, " ", ACIDITY.sub(" acidity ", name))
    decomposed = unicodedata.normalize("NFKD", spaced.lower().replace("ß", "ss"))
    plain = "".join(letter for letter in decomposed if not unicodedata.combining(letter))
    return [part for part in re.split(r"[^a-z]+", plain) if part]


def is_set_point_title(name: str) -> bool:
    """Whether a column title suggests a set point, such as `r`, `ref`, `T1 setpoint` or
    `speed_target`."""
    return title_word_score(name, SET_POINT_WORDS) == 1.0


def input_score(column: ColumnFacts) -> float:
    """Score of how much a column looks like an input of the plant, from its title, number of
    distinct values and range. Columns with equal scores are taken in their order."""
    magnitude = max(abs(column.low), abs(column.high))
    is_steady = column.high - column.low < STEADY * magnitude
    by_words = title_word_score(column.name, INPUT_WORDS)
    is_surroundings = title_word_score(column.name, SURROUNDINGS_WORDS)
    return by_words + level_score(column) - STEADY_COUNTS * is_steady - is_surroundings


def level_score(column: ColumnFacts) -> float:
    """Score of a log column, high if the column has few distinct values and holds each of them for
    long."""
    few_levels = max(0.0, 1.0 - 2.0 * column.levels / column.rows)
    return HOLDS_COUNT * round(column.held, 1) + FEW_LEVELS_COUNT * round(few_levels, 1)


def title_word_score(name: str, words: tuple[str, ...]) -> float:
    """Score of how well a column title matches a list of words: 1 for a whole word, 0.5 for the
    beginning of a word. One if a word of the title is in the list, a half if one begins with a word
    in the list."""
    parts = title_words_without_digits(name)
    if any(part in words for part in parts):
        return 1.0
    long_words = tuple(word for word in words if len(word) > 3)
    begins_with_word = any(part.startswith(long_words) for part in parts)
    return 0.5 if begins_with_word else 0.0


def is_numbered(title: str) -> bool:
    """Whether a column title is only a column number, such as `3` and `data:3`."""
    return title.rpartition(":")[2].isdigit()


def doubtful_guess_sentences(
    facts: Sequence[ColumnFacts],
    skipped: dict[str, str],
    signals: tuple[str | None, str | None],
    are_named: tuple[bool, bool],
) -> list[str]:
    """Sentences on columns whose titles suggest an input or output but which cannot be read or are
    constant. The guess would pass over them.

    `are_named` says of input and output whether the user named them, so that nothing is guessed.
    """
    unusable = {name: why for name, why in skipped.items() if HAS_NUMBERS.search(why)}
    for column in facts:
        if column.levels == 1 and not is_set_point_title(column.name):
            unusable[column.name] = f"it is {column.low:g} throughout"
    sides = [
        ("input", signals[0], are_named[0], INPUT_WORDS, OUTPUT_WORDS),
        ("output", signals[1], are_named[1], OUTPUT_WORDS, INPUT_WORDS),
    ]
    sentences = []
    for side, guess, is_named, words, other_words in sides:
        if is_named or guess is None:
            continue
        score = title_word_score(guess, words)
        for title, why in unusable.items():
            own = title_word_score(title, words)
            is_other_side = own < title_word_score(title, other_words)
            counts_if_equal = title in skipped or (score == 0.0 and not is_numbered(title))
            is_better = own > score or (own == score and counts_if_equal)
            if is_better and not is_other_side:
                sentences.append(f"no guess: {title} may be the {side}, but {why}")
    return list(dict.fromkeys(sentences))
